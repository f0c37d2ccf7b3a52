"""One rotation, several parameter vectors: where they jump, and what smoothing and averaging make of it.

The thesis meets two symptoms of one cause, the branch cut of the rotation vector at angle pi: a smoothness
term that turns a body by 360 degrees (3.2.3, Fig. 3.4), and a consistency term that averages two opposite
vectors of one rotation (3.3.2). Both experiments run here with the representation as an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab import rotation
from studies.shared.torch_search import FitResult, minimise


@dataclass(frozen=True)
class Representation:
    """A parameterisation of rotations: encode (..., 3, 3) -> (..., P) and back.

    tidy: takes the freedom out of parameters that is not rotation (the lengths of 6D vectors and quaternions)
    without choosing a branch. A smoothness term on raw 6D numbers shrinks them to nothing, where each small
    change is any rotation at all; on tidy numbers it cannot.
    """

    name: str
    encode: Callable[[Tensor], Tensor]
    decode: Callable[[Tensor], Tensor]
    tidy: Callable[[Tensor], Tensor] = lambda theta: theta


def _unrolled(matrix: Tensor) -> Tensor:
    return rotation.unroll_axis_angle(rotation.matrix_to_axis_angle(matrix))


AXIS_ANGLE = Representation("axis-angle", rotation.matrix_to_axis_angle, rotation.axis_angle_to_matrix)
#: Axis-angle whose branch is made continuous along time (the frame axis, second from the right) beforehand.
UNROLLED = Representation("axis-angle, unrolled", _unrolled, rotation.axis_angle_to_matrix)
QUATERNION = Representation(
    "quaternion",
    rotation.matrix_to_quaternion,
    rotation.quaternion_to_matrix,
    tidy=lambda q: torch.nn.functional.normalize(q, dim=-1),
)
EULER = Representation(
    "Euler ZXY", lambda r: rotation.matrix_to_euler(r, "ZXY"), lambda e: rotation.euler_to_matrix(e, "ZXY")
)
RAW_SIXD = Representation("6D, lengths free", rotation.matrix_to_sixd, rotation.sixd_to_matrix)
SIXD = Representation(
    "6D",
    rotation.matrix_to_sixd,
    rotation.sixd_to_matrix,
    tidy=lambda d: rotation.matrix_to_sixd(rotation.sixd_to_matrix(d)),
)


def jumps(representation: Representation, path: Tensor) -> Tensor:
    """Change of the parameter vector per radian of rotation (..., T-1) along a path of rotations (..., T, 3, 3).

    A continuous representation stays below a constant; one with a branch cut grows without bound as the
    steps get smaller.
    """
    step = representation.encode(path).diff(dim=-2).norm(dim=-1)
    return step / rotation.geodesic(path[..., :-1, :, :], path[..., 1:, :, :]).clamp_min(1e-9)


def carried_and_decoded(root: Tensor) -> tuple[Tensor, Tensor]:
    """The two rotation vectors of one root (..., T, 3, 3) that the thesis compares, both (..., T, 3).

    carried: continuous in time, as an optimiser holds it in the world frame. decoded: the same rotation
    turned into the root-local heading frame, and back, and only then written as a vector.
    Source: thesis 3.3.2, first issue.
    """
    heading = rotation.rotation_about("z", -rotation.yaw(root))
    world = heading.mT @ (heading @ root)
    return rotation.unroll_axis_angle(rotation.matrix_to_axis_angle(root)), rotation.matrix_to_axis_angle(world)


def flipped(first: Tensor, second: Tensor) -> Tensor:
    """Where (...) two vectors (..., 3) of the same rotation differ by more than pi."""
    return (first - second).norm(dim=-1) > math.pi


def flips_per_minute(mask: Tensor, fps: float) -> Tensor:
    """How often (...) a mask (..., T) changes between frames, per minute."""
    changes = (mask[..., 1:] != mask[..., :-1]).sum(-1)
    return changes * 60.0 * fps / mask.shape[-1]


def midpoint_error(representation: Representation, first: Tensor, second: Tensor, truth: Tensor) -> Tensor:
    """Degrees (...) from the truth (..., 3, 3) after averaging two parameter vectors of it (..., P)."""
    return torch.rad2deg(rotation.geodesic(representation.decode((first + second) / 2), truth))


def crosses_branch(path: Tensor, *, context: int) -> Tensor:
    """Where (N,) the principal rotation vector changes branch inside the gap of paths (N, T, 3, 3)."""
    middle = path[:, context - 1 : path.shape[1] - context + 1]
    return (rotation.matrix_to_axis_angle(middle).diff(dim=-2).norm(dim=-1) > math.pi).any(-1)


def fill(
    path: Tensor, representation: Representation, *, context: int, closures: int, smoothness: float = 0.1
) -> tuple[Tensor, FitResult]:
    """Hide the middle of each path (N, T, 3, 3) and let data and smoothness terms fill it.

    E(theta) = sum over seen frames |R(theta_t) - R_t|^2 + smoothness sum_t |tidy(theta)_{t+1} - tidy(theta)_t|^2

    The data term compares rotations, so only the smoothness term sees the representation; the start is the
    per-frame estimate, held constant through the gap. Solved by L-BFGS for all paths at once.

    Source: thesis 3.2.3 and Fig. 3.4.
    Differs: TestOps smooths joints and roots of a whole body; one rotation shows the effect alone.

    Returns:
        filled rotations (N, T, 3, 3) and the fit.
    """
    path = path.double()
    seen = torch.ones(path.shape[1], dtype=torch.bool)
    seen[context:-context] = False
    start = representation.encode(path).clone()
    start[:, context:-context] = start[:, context - 1 : context]

    def energy(variables: dict[str, Tensor]) -> Tensor:
        theta = variables["theta"]
        data = (representation.decode(theta[:, seen]) - path[:, seen]).square().sum()
        return data + smoothness * representation.tidy(theta).diff(dim=1).square().sum()

    fit = minimise(
        energy, {"theta": start.requires_grad_()}, steps=closures, max_closures=closures, tolerance_grad=1e-6
    )
    return representation.decode(fit.variables["theta"]).detach(), fit


def excess_rotation(filled: Tensor, *, context: int) -> Tensor:
    """Degrees (N,) that the filled middle of paths (N, T, 3, 3) turns beyond the shortest way across.

    Geodesic path length from the last frame before the gap to the first after it, less the geodesic distance
    between those two.
    """
    middle = filled[:, context - 1 : filled.shape[1] - context + 1]
    length = rotation.geodesic(middle[:, :-1], middle[:, 1:]).sum(-1)
    return torch.rad2deg(length - rotation.geodesic(middle[:, 0], middle[:, -1]))


def path_over_shortest(filled: Tensor, *, context: int) -> Tensor:
    """Rotation (N,) of the filled middle over the shortest way across, 1 or more; see :func:`excess_rotation`."""
    before, after = filled[:, context - 1], filled[:, filled.shape[1] - context]
    return 1 + excess_rotation(filled, context=context) / torch.rad2deg(rotation.geodesic(before, after))


def consistency(
    root: Tensor,
    representation: Representation,
    generator: torch.Generator,
    *,
    steps: int,
    lr: float = 0.05,
    smoothness: float = 1.0,
    noise_deg: float = 2.0,
) -> tuple[Tensor, FitResult]:
    """Pull carried parameters towards decoded ones of the same rotations, as the decoupled TestOps does.

    E(x) = sum_t |x_t - d_t|_1 + smoothness sum_t |x_{t+1} - x_t|^2

    x starts at the carried vector (continuous in time). d is the decoded one, off by a random rotation of about
    ``noise_deg`` per axis in every frame, since no decoder is perfect and an arm that starts at its optimum
    proves nothing.

    Args:
        root: (N, T, 3, 3) true root rotations.

    Returns:
        degrees from the truth (N, T) after ``steps`` Adam steps, and the fit.
    Source: thesis 3.3.1 (loss term) and 3.3.2.
    """
    noise = math.radians(noise_deg) * torch.randn(*root.shape[:-2], 3, generator=generator).to(root)
    carried, _ = carried_and_decoded(root)
    _, decoded = carried_and_decoded(root @ rotation.axis_angle_to_matrix(noise))
    if representation is not AXIS_ANGLE:
        carried = representation.encode(rotation.axis_angle_to_matrix(carried))
        decoded = representation.encode(rotation.axis_angle_to_matrix(decoded))

    def energy(variables: dict[str, Tensor]) -> Tensor:
        x = variables["x"]
        return (x - decoded).abs().sum() + smoothness * x.diff(dim=1).square().sum()

    fit = minimise(energy, {"x": carried.clone().requires_grad_()}, method="adam", steps=steps, lr=lr, patience=None)
    error = rotation.geodesic(representation.decode(fit.variables["x"]).detach(), root)
    return torch.rad2deg(error), fit
