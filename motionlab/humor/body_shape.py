"""Body shape as eight numbers: how long each group of bones is, left and right alike; and what a detector sees of it.

    offset_j = exp(0.08 beta_g(j)) offset_j of the standard skeleton,   beta ~ N(0, 1)

so that betas are in standard deviations and nought is the standard body.

Differs: HuMoR uses 16 betas of SMPL, and vertices of its mesh for nose, eyes, ears, toes and heels. Those of the
default body hang on one bone each, so that here they are points fixed to head, ankle and foot: no mesh is needed.
"""

import torch
from torch import Tensor

from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.observation import BODY_25
from motionlab.skeleton import STANDARD, Skeleton

#: Joints whose way from their parent belongs to a group, in the order of the betas.
BONE_GROUPS = {
    "pelvis": ("left_hip", "right_hip"),
    "trunk": ("spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"),
    "head": ("head",),
    "shoulders": ("left_shoulder", "right_shoulder"),
    "upper arms": ("left_elbow", "right_elbow"),
    "forearms": ("left_wrist", "right_wrist"),
    "thighs": ("left_knee", "right_knee"),
    "lower legs": ("left_ankle", "right_ankle", "left_foot", "right_foot"),
}
BETAS = len(BONE_GROUPS)
SPREAD = 0.08  # standard deviation of the logarithm of a length
#: Carrier and place in its axes, metres, of the keypoints that are no joints (left and middle): vertices of anny's
#: average adult (see ``body.BodyModel.keypoint_vertices``).
MARKS = {
    "nose": ("head", (0.0, 0.0101, 0.1256)),
    "left_eye": ("head", (0.0318, 0.0442, 0.1026)),
    "left_ear": ("head", (0.0762, 0.0219, 0.0090)),
    "left_big_toe": ("left_foot", (-0.0227, 0.0103, 0.0747)),
    "left_small_toe": ("left_foot", (0.0397, 0.0073, 0.0343)),
    "left_heel": ("left_ankle", (0.0040, -0.0441, -0.0614)),
}


def _landmark(name: str) -> tuple[int, tuple[float, float, float]]:
    """Index of the carrying joint of a keypoint, and its place there."""
    if name not in MARKS and (mark := MARKS.get(name.replace("right_", "left_"))):
        carrier, (x, y, z) = mark
        return STANDARD.index(carrier.replace("left_", "right_")), (-x, y, z)
    carrier, place = MARKS.get(name, ("pelvis" if name == "mid_hip" else name, (0.0, 0.0, 0.0)))
    return STANDARD.index(carrier), place


#: Group of each joint's bone (the pelvis has none, and any will do).
GROUP_OF = [next((g for g, names in enumerate(BONE_GROUPS.values()) if n in names), 0) for n in STANDARD.names]
#: Of the keypoints that are no joints: their carriers, and their places there.
_SURFACE = [name for name in BODY_25 if any(_landmark(name)[1])]
CARRIERS = [_landmark(name)[0] for name in _SURFACE]
PLACE = torch.tensor([_landmark(name)[1] for name in _SURFACE])
#: Where each keypoint stands among the joints and the surface points behind them.
ORDER = [len(STANDARD) + _SURFACE.index(name) if name in _SURFACE else _landmark(name)[0] for name in BODY_25]


def scales(betas: Tensor) -> Tensor:
    """Computes from betas the factor (..., 22) on the bone that leads to each joint."""
    check_shape(betas, f"... {BETAS}", "betas")
    return (SPREAD * betas).exp()[..., GROUP_OF]


def offsets(betas: Tensor) -> Tensor:
    """Computes offsets (..., 22, 3) in metres from shapes (..., 8)."""
    return scales(betas)[..., None] * STANDARD.offsets.to(betas)


def landmarks(joints: Tensor, turns: Tensor, betas: Tensor) -> Tensor:
    """Computes the 25 keypoints of BODY_25 (..., T, 25, 3), world, from posed bodies.

    joints (..., T, 22, 3), turns (..., T, 22, 3, 3): positions and orientations as ``skeleton.fk`` gives them. betas
    (..., 8): one shape for all frames of a clip. Head and feet grow with their bones.
    """
    check_shape(joints, "... T 22 3", "joints")
    place = scales(betas)[..., None, CARRIERS, None] * PLACE.to(betas)
    surface = joints[..., CARRIERS, :] + (turns[..., CARRIERS, :, :] * place[..., None, :]).sum(-1)
    return torch.cat((joints, surface), dim=-2)[..., ORDER, :]


def from_skeleton(skeleton: Skeleton) -> Tensor:
    """Computes from a skeleton of the 22 standard joints the betas (..., 8) whose bone lengths are nearest to its own.

    In each group s = sum l l0 / sum l0^2, l0 the standard's lengths. Lengths that are not finite are left out; a group
    of which none is known is as the standard (beta 0).

    Raises:
        ShapeError: other joints than the standard's. DataError: a group without length.
    """
    if skeleton.names != STANDARD.names:
        raise ShapeError("from_skeleton: expected the 22 standard joints; retarget the motion first")
    lengths = skeleton.offsets.norm(dim=-1)
    standard = STANDARD.offsets.to(lengths).norm(dim=-1)
    member = torch.nn.functional.one_hot(torch.tensor(GROUP_OF), BETAS).to(lengths) * (standard > 0)[:, None]
    known = lengths.isfinite()
    ours = torch.where(known, lengths, 0.0) * standard @ member
    theirs = known * standard.square() @ member
    if (ours.le(0) & theirs.gt(0)).any():
        raise DataError("a group of bones has no length", place="lengths", remedy="give metres above zero")
    return torch.where(theirs > 0, ours / theirs.clamp(min=1e-12), 1.0).log() / SPREAD
