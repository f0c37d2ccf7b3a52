"""AniDance: npz files of 24 unnamed marker-like positions per frame.

The files name their points ``center, bone_0 .. bone_22`` and nothing else. The tree and the names below were
worked out from 29,364 frames of 38 dances:

- *Tree*: the spanning tree of the smallest spread of distance through time (root mean square over dances)
  joins ankle, heel and toe (1.5 to 2.0 cm), knee and ankle (1.4 to 2.5), elbow, forearm, wrist and hand (0.7 to
  2.4), and the trunk points 3, 4, 8, 13, 17 with the head points 1 and 2 (1.2 to 1.9). Hip to knee and shoulder
  to elbow vary more (3.4 to 4.3): these points sit on the skin, not in the joint.
- *Sides*: read as a right-handed y-up world, knees bend forward, elbows bend backward and the longer foot
  segment points forward only when points 4 to 12 are the right side.

Distances vary by centimetres and the floor drifts by tens of centimetres: good for poses relative to the
centre, not for contacts or bone lengths.
"""

from __future__ import annotations

from pathlib import Path

import torch

from motionlab.io.positions import Positions, axes_to_matrix
from motionlab.io.reading import frame_rate, numbers, read_npz, reading

#: Names in the file's order, as worked out above; wrist and hand are two markers at the end of the forearm.
NAMES = (
    "centre", "right_head", "left_head", "spine", "right_shoulder", "right_elbow", "right_forearm", "right_wrist",
    "right_hip", "right_knee", "right_ankle", "right_heel", "right_toe", "left_shoulder", "left_elbow", "left_wrist",
    "left_hand", "left_hip", "left_knee", "left_ankle", "left_heel", "left_toe", "left_forearm", "right_hand",
)  # fmt: skip
#: Pairs of points for drawing: the measured tree, with shoulders, hips and thighs joined as in a body.
BONES = (
    (3, 0), (3, 4), (3, 13), (3, 8), (3, 17), (8, 17), (4, 13), (4, 1), (13, 2), (1, 2), (4, 5), (5, 6), (6, 7),
    (7, 23), (13, 14), (14, 22), (22, 15), (15, 16), (8, 9), (9, 10), (10, 11), (10, 12), (17, 18), (18, 19),
    (19, 20), (19, 21),
)  # fmt: skip


def load(path: str | Path) -> Positions:
    """One dance as 24 points in metres, z up: world point = centre + offset.

    Needs the keys ``positions_cm`` (T, 24, 3), y up, every point but the first relative to the first, and ``fps``.

    Raises:
        DataError: a key is missing or holds something else.
    """
    with reading(path, 'save "positions_cm" (T, 24, 3) and "fps" with numpy.savez') as at:
        arrays = read_npz(at, ("positions_cm", "fps"))
        for key in ("positions_cm", "fps"):
            if key not in arrays:
                raise at.error("this key is missing", place=key)
        points = torch.from_numpy(numbers(at, arrays["positions_cm"], f"T {len(NAMES)} 3", "positions_cm")) / 100
        points[:, 1:] += points[:, :1]
        world = (points @ axes_to_matrix("x-zy").T).float()
        fps = frame_rate(at, arrays["fps"], "fps")
        return Positions(NAMES, world, torch.ones(world.shape[:2], dtype=torch.bool), fps, at.path.stem, BONES)
