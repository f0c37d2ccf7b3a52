"""HumanML3D's two forms of a motion: places of 22 joints (T, 22, 3), and 263 numbers a frame that do not know where the
person is or looks. Metres, y up, facing +z, 20 frames per second.

Of the 263: half the turn about y to the next frame (radians, to the right); how far the root moves to it (x and z, as
the next frame faces); the root's height; places of joints 1 to 21 from the floor below the root, as this frame faces
(63); how the bone to each is turned (126, two columns of a matrix each); how far all joints move to the next frame, as
this one faces (66); and whether ankle and ball of the left foot, then of the right, stand still (4).

Source: HumanML3D (Guo et al. 2022), motion_representation.ipynb and common/skeleton.py; as there, the facing counts
shoulders against hips and is smoothed over 20 frames. Differs: bones keep their lengths (there those of clip 000021),
and a turn through straight back keeps its sign.
"""

import io
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.files import write_whole
from motionlab.motion import Motion, resample
from motionlab.skeleton import STANDARD, UPRIGHT

FPS, SIZE, JOINTS = 20.0, 263, 22
_STILL = 0.002  # m^2: a foot that moves less between frames stands still
#: Where a bone points in the pose of no turn, and the chains in which they are counted: arms begin anew at the root's.
_LETTERS = {"l": (1, 0, 0), "r": (-1, 0, 0), "u": (0, 1, 0), "d": (0, -1, 0), "f": (0, 0, 1), " ": (0, 0, 0)}
_AXES = [_LETTERS[letter] for letter in " lruddudduffulrfdddddd"]
_CHAINS = ((0, 2, 5, 8, 11), (0, 1, 4, 7, 10), (0, 3, 6, 9, 12, 15), (9, 14, 17, 19, 21), (9, 13, 16, 18, 20))


def features(joints: Tensor) -> Tensor:
    """Computes the 263 numbers (T - 1, 263) of joints (T, 22, 3) that begin as :func:`begun` puts them."""
    from scipy.ndimage import gaussian_filter1d

    check_shape(joints, f"T {JOINTS} 3", "joints")
    joints = joints.double()
    root, step = joints[:, 0], joints[1:] - joints[:-1]
    across = torch.nn.functional.normalize(joints[:, 1] - joints[:, 2] + joints[:, 17] - joints[:, 16], dim=-1)
    forward = torch.linalg.cross(torch.tensor([[0.0, 1.0, 0.0]]).double(), across, dim=-1).numpy()
    forward = gaussian_filter1d(forward, 20.0, axis=0, mode="nearest")
    turn = torch.from_numpy(-np.arctan2(forward[:, 0], forward[:, 2]))  # to face +z, but for the first frame
    turn[0] = 0
    face = rotation.rotation_about("y", turn)
    moved = (face[1:] @ step[:, 0, :, None])[..., 0]
    level = joints - root[:, None] * torch.tensor([1.0, 0.0, 1.0])
    local = (face[:, None] @ level[..., None])[..., 0]
    turned = torch.zeros(len(joints), JOINTS, 3, 3, dtype=torch.float64)
    for chain in _CHAINS:
        above = face
        for a, b in pairwise(chain):
            bone = rotation.rotation_between(torch.tensor(_AXES[b], dtype=torch.float64), joints[:, b] - joints[:, a])
            turned[:, b], above = above.mT @ bone, bone
    still = (step[:, [7, 10, 8, 11]].square().sum(-1) < _STILL).double()
    half = torch.remainder(turn[1:] - turn[:-1] + torch.pi, 2 * torch.pi) - torch.pi
    parts = [half[:, None] / 2, moved[:, [0, 2]], root[:-1, 1:2], local[:-1, 1:].flatten(1)]
    parts += [rotation.matrix_to_sixd(turned[:-1, 1:]).flatten(1)]
    parts += [(face[:-1, None] @ step[..., None])[..., 0].flatten(1), still]
    return torch.cat(parts, dim=1)


def joints_of(numbers: Tensor) -> Tensor:
    """Computes joints (T, 22, 3) of the 263 numbers (T, 263), from the origin and facing +z."""
    check_shape(numbers, f"T {SIZE}", "features")
    numbers = numbers.double()
    turn = torch.cat((numbers.new_zeros(1), 2 * numbers[:-1, 0].cumsum(0)))
    back = rotation.rotation_about("y", -turn)
    step = torch.stack((numbers[:-1, 1], torch.zeros(len(numbers) - 1, dtype=torch.float64), numbers[:-1, 2]), dim=-1)
    root = torch.cat((numbers.new_zeros(1, 3), (back[1:] @ step[..., None])[..., 0].cumsum(0)))
    root[:, 1] = numbers[:, 3]
    below = (back[:, None] @ numbers[:, 4 : 4 + 3 * (JOINTS - 1)].reshape(-1, JOINTS - 1, 3, 1))[..., 0]
    return torch.cat((root[:, None], below + root[:, None] * torch.tensor([1.0, 0.0, 1.0])), dim=1)


def begun(joints: Tensor) -> Tensor:
    """Puts joints (T, 22, 3) on the floor, the first root over the origin and facing +z, as HumanML3D has them."""
    check_shape(joints, f"T {JOINTS} 3", "joints")
    joints = joints.double()
    across = joints[0, 2] - joints[0, 1] + joints[0, 17] - joints[0, 16]
    turn = rotation.rotation_about("y", -torch.atan2(across[2], -across[0]))
    shift = torch.stack((joints[0, 0, 0], joints[..., 1].min(), joints[0, 0, 2]))
    return (joints - shift) @ turn.T


def motion_of(joints: Tensor, fps: float = FPS, name: str = "") -> Motion:
    """Finds a motion on the 22 joints that stands at ``joints`` (T, 22, 3), in their axes, with bones of mean length.

    Where several bones leave a joint, its rotation is the best for all of them; where one does, the nearest to the
    joint above, for how a limb is twisted cannot be seen from places.
    """
    check_shape(joints, f"T {JOINTS} 3", "joints")
    joints = joints.double()
    tree, bones = STANDARD.parents, [joints[:, j] - joints[:, max(STANDARD.parents[j], 0)] for j in range(JOINTS)]
    offsets = torch.nn.functional.normalize(STANDARD.offsets.double(), dim=-1)
    offsets = offsets * torch.stack([bone.norm(dim=-1).mean() for bone in bones])[:, None]
    below = {j: [k for k in range(1, JOINTS) if tree[k] == j] for j in range(JOINTS)}
    world = torch.eye(3, dtype=torch.float64).repeat(len(joints), JOINTS, 1, 1)
    for j in range(JOINTS):
        world[:, j] = above = world[:, max(tree[j], 0)].clone()
        if len(below[j]) == 1:
            (k,) = below[j]
            world[:, j] = rotation.rotation_between((above @ offsets[k, :, None])[..., 0], bones[k]) @ above
        for _ in range(4 * (len(below[j]) > 1)):  # rotations by the offsets, then the offsets by the rotations
            world[:, j] = rotation.nearest(sum(bones[k][..., None] * offsets[k] for k in below[j]))
            for k in below[j]:
                offsets[k] = (world[:, j].mT @ bones[k][..., None])[..., 0].mean(0)
    skeleton = replace(STANDARD, offsets=offsets)
    note = "rotations are worked out from the places of the joints: how limbs are twisted is not in the file"
    return Motion(skeleton, joints[:, 0], skeleton.local(world), fps, name=name, notes=(note,))


def save(path: str | Path, motion: Motion, *, as_features: bool = False) -> None:
    """Writes a motion on the standard joints as a .npy of joints (T, 22, 3), or of their 263 numbers (T - 1, 263).

    Raises:
        ShapeError: other joints, batch axes, or too few frames. DataError: NaN, or the file cannot be written.
    """
    if motion.skeleton.names != STANDARD.names:
        raise ShapeError(f"expected the {JOINTS} standard joints, got {len(motion.skeleton)}: retarget first")
    joints = begun(resample(motion, FPS).positions.double() @ UPRIGHT.double())
    if as_features and len(joints) < 2:
        raise ShapeError("expected two frames or more at 20 per second")
    if not joints.isfinite().all():
        raise DataError("numbers that are not finite", path=path, remedy="cut or fill those frames")
    stream = io.BytesIO()
    np.save(stream, (features(joints) if as_features else joints).float().numpy())
    write_whole(path, stream.getvalue())
