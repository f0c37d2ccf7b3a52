"""How tall somebody is: by what a camera saw of them where their feet stand, and a fit of people who are no adults.

A fit knows adults. A scene that is 1.7 times as large looks the same to a camera that stands 1.7 times as far off: so a
child of 1 m is fitted as an adult of 1.7 m, and everything is then made smaller again.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D
from motionlab.skeleton import STANDARD

STATURE = 1.84  # metres: the standard body from sole to crown, as ``body.BodyModel`` draws it
SMALL = 0.75  # from less of the standard's size on, a fit without ``height`` is doubtful
_FRAMES = 5  # in which a bone must be seen
_FEET = {"heel": 0.015, "big_toe": 0.015, "ankle": 0.08}  # metres above the floor
_BONES = [("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")]


def seen_size(seen: Observation2D, camera: Camera) -> list[float]:
    """Computes how large people (P, T, 25) are, as a share of the standard body; NaN where that cannot be told.

    Their lower foot is on the floor, z = 0. There the thighs, shins, upper arms and forearms have the length that the
    camera saw, but for what points towards it: of each the length that nine in ten frames do not exceed, of these
    the median.
    """
    heights = torch.full((len(BODY_25),), torch.nan)
    for name, height in _FEET.items():
        heights[[BODY_25.index(f"{side}_{name}") for side in ("left", "right")]] = height
    points = torch.where(seen.confidence[..., None] > 0, seen.keypoints, torch.nan).double()
    k = camera.intrinsics.double()
    plane = (points - k[:2, 2]) / k[[0, 1], [0, 1]]
    rays = torch.nn.functional.pad(plane, (0, 1), value=1.0) @ camera.rotation.double()
    depth = (heights - float(camera.centre[2])) / rays[..., 2]
    depth = torch.where((depth > 0) & (rays[..., 2] < 0), depth, torch.nan)
    lower = depth.nan_to_num(torch.inf).amin(-1)  # the foot that is on the floor is the nearer one
    level = (rays[..., :2].norm(dim=-1) / rays.norm(dim=-1)).nanmedian(-1).values.clamp(min=0.5)
    sizes = []
    for a, b in _BONES:
        for side in ("left", "right"):
            one, other = BODY_25.index(f"{side}_{a}"), BODY_25.index(f"{side}_{b}")
            length = float(STANDARD.offsets[STANDARD.index(f"{side}_{b}")].norm())
            sizes.append((plane[..., one, :] - plane[..., other, :]).norm(dim=-1) * lower / level / length)
    size = torch.stack(sizes, 1)  # (P, 8, T)
    told = size.isfinite() & (size.isfinite().sum(-1, keepdim=True) >= _FRAMES)
    return torch.where(told, size, torch.nan).nanquantile(0.9, dim=-1).nanmedian(-1).values.tolist()


def resized(motion: Motion, factor: float) -> Motion:
    """Returns a motion ``factor`` times as large, about the origin."""
    return replace(motion, skeleton=motion.skeleton.scaled(factor), root=motion.root * factor)


def moved(camera: Camera, factor: float) -> Camera:
    """Returns the camera that sees the same of a scene ``factor`` times as large."""
    return replace(camera, translation=camera.translation * factor)


def of(motion: Motion) -> float:
    """Computes a fitted person's height, metres, from their bones: as the standard's, where they stand."""
    return STATURE * float(motion.skeleton.standing_height() / STANDARD.standing_height())
