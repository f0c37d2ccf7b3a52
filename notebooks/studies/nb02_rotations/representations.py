"""One rotation, several parameter vectors: where they jump, and what smoothing and averaging make of it.

The thesis meets two symptoms of one cause, the branch cut of the rotation vector at angle pi: a smoothness term that
turns a body by 360 degrees (3.2.3, Fig. 3.4), and a consistency term that averages two opposite vectors of one rotation
(3.3.2). The energies of both stand in the notebook; what they are made of is here.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab import rotation


@dataclass(frozen=True)
class Representation:
    """A parameterisation of rotations: encode (..., 3, 3) -> (..., P) and back.

    tidy: takes the freedom out of parameters that is not rotation (the lengths of 6D vectors and quaternions) without
    choosing a branch. A smoothness term on raw 6D numbers shrinks them to nothing, where each small change is any
    rotation at all; on tidy numbers it cannot.
    """

    name: str
    encode: Callable[[Tensor], Tensor]
    decode: Callable[[Tensor], Tensor]
    tidy: Callable[[Tensor], Tensor] = lambda theta: theta


AXIS_ANGLE = Representation("axis-angle", rotation.matrix_to_axis_angle, rotation.axis_angle_to_matrix)
#: Axis-angle whose branch is made continuous along time (the frame axis, second from the right) beforehand.
UNROLLED = replace(AXIS_ANGLE, name="axis-angle, unrolled",
                   encode=lambda r: rotation.unroll_axis_angle(rotation.matrix_to_axis_angle(r)))  # fmt: skip
QUATERNION = Representation(
    "quaternion, w ≥ 0", rotation.matrix_to_quaternion, rotation.quaternion_to_matrix,
    tidy=lambda q: torch.nn.functional.normalize(q, dim=-1),
)  # fmt: skip
EULER = Representation(
    "Euler ZXY", lambda r: rotation.matrix_to_euler(r, "ZXY"), lambda e: rotation.euler_to_matrix(e, "ZXY")
)
RAW_SIXD = Representation("6D, lengths free", rotation.matrix_to_sixd, rotation.sixd_to_matrix)
SIXD = replace(RAW_SIXD, name="6D", tidy=lambda d: rotation.matrix_to_sixd(rotation.sixd_to_matrix(d)))
#: The five descriptions of the first experiment, and the five that fill gaps.
DESCRIPTIONS = (AXIS_ANGLE, UNROLLED, QUATERNION, EULER, SIXD)
FILLERS = (AXIS_ANGLE, QUATERNION, UNROLLED, RAW_SIXD, SIXD)


def jumps(representation: Representation, path: Tensor) -> Tensor:
    """Computes the change of the parameters per radian of rotation (..., T-1) along rotations (..., T, 3, 3).

    A continuous representation stays below a constant; one with a branch cut grows without bound as the
    steps get smaller.
    """
    step = representation.encode(path).diff(dim=-2).norm(dim=-1)
    return step / rotation.geodesic(path[..., :-1, :, :], path[..., 1:, :, :]).clamp_min(1e-9)


def hide(theta: Tensor, gap: int) -> tuple[Tensor, Tensor]:
    """Hides the middle ``gap`` frames of parameters (..., T, P): which frames are seen (T,), and a start.

    The start is the parameters, the last seen ones held through the gap.
    """
    first = (theta.shape[-2] - gap) // 2
    frames = torch.arange(theta.shape[-2])
    hidden = (frames >= first) & (frames < first + gap)
    return ~hidden, theta[..., torch.where(hidden, first - 1, frames), :].clone()


def across_gap(path: Tensor, gap: int) -> Tensor:
    """Cuts out the hidden frames with one seen frame on either side: (..., gap + 2, 3, 3) of (..., T, 3, 3)."""
    first = (path.shape[-3] - gap) // 2
    return path[..., first - 1 : first + gap + 1, :, :]


def turned(path: Tensor) -> Tensor:
    """Computes degrees turned across a path (..., T, 3, 3), along it, from frame to frame."""
    return torch.rad2deg(rotation.geodesic(path[..., :-1, :, :], path[..., 1:, :, :]).sum(-1))


def excess_rotation(filled: Tensor, gap: int) -> Tensor:
    """Computes degrees (...) that the filled middle of paths (..., T, 3, 3) turns beyond the shortest way across."""
    middle = across_gap(filled, gap)
    return turned(middle) - torch.rad2deg(rotation.geodesic(middle[..., 0, :, :], middle[..., -1, :, :]))


def carried_and_decoded(root: Tensor) -> tuple[Tensor, Tensor]:
    """Computes the two rotation vectors of one root (..., T, 3, 3) that the thesis compares, both (..., T, 3). carried:
    continuous in time, as an optimiser holds it in the world frame. decoded: the same rotation turned into the
    root-local heading frame, and back, and only then written as a vector."""
    heading = rotation.rotation_about("z", -rotation.yaw(root))
    world = heading.mT @ (heading @ root)
    return rotation.unroll_axis_angle(rotation.matrix_to_axis_angle(root)), rotation.matrix_to_axis_angle(world)


def nearest_vector(decoded: Tensor, carried: Tensor) -> Tensor:
    """Computes, of all vectors (..., 3) of the decoded rotations, the ones nearest to the carried vectors.

    They are (|d| + 2 pi k) d / |d|, k any whole number.
    """
    angle = decoded.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    axis = decoded / angle
    turns = (((axis * carried).sum(-1, keepdim=True) - angle) / math.tau).round()
    return axis * (angle + math.tau * turns)


def flipped(first: Tensor, second: Tensor) -> Tensor:
    """Tells where (...) two vectors (..., 3) of the same rotation differ by more than pi."""
    return (first - second).norm(dim=-1) > math.pi


def off_by(how: Representation, theta: Tensor, truth: Tensor) -> Tensor:
    """Computes degrees (...) between the rotation of parameters (..., P) and the true one (..., 3, 3)."""
    return torch.rad2deg(rotation.geodesic(how.decode(theta).to(truth), truth))
