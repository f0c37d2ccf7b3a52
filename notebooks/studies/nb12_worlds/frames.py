"""World space or stuck root: do root and body of a motion belong together, and how large is the space of windows?

Source: thesis 4.1.2 (the two frames) and 4.2.3, which explains the sliding of its world-space model by the second.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.contact import resting_heights
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.model import Trained
from motionlab.diffusion.sampling import noise_like
from motionlab.errors import ShapeError
from motionlab.heading import Frame, local_to_world, stuck_root, world_to_local
from motionlab.metrics import gait, pose
from motionlab.motion import Motion
from motionlab.skeleton import FEET

TRAVELS = 0.2  # m/s over the floor, from which the root of a clip counts as moving


# ---------------------------------------------------------------------------------------------- place and heading
def somewhere(count: int, metres: float, generator: torch.Generator) -> Frame:
    """Moves (count, 1): any turn about the vertical, then a shift over the floor of up to ``metres`` in x and y."""
    turn = 2 * torch.pi * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    shift = metres * (2 * torch.rand(count, 1, 3, generator=generator, dtype=torch.float64) - 1)
    return _move(turn, shift)


def away(count: int, metres: float, generator: torch.Generator) -> Frame:
    """Moves (count, 1): a shift of exactly so many metres over the floor, in a random direction; no turn."""
    turn = 2 * torch.pi * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    shift = metres * torch.stack((turn.cos(), turn.sin(), torch.zeros_like(turn)), -1)
    return _move(torch.zeros_like(turn), shift)


def as_others(motion: Motion, others: Motion, generator: torch.Generator) -> Frame:
    """Moves (B, 1) that put each clip (B, T) where a random one of others begins, facing the same way."""
    pick = torch.randint(len(others.root), (len(motion.root),), generator=generator)
    there, here = stuck_root(others.clip(pick))[1], stuck_root(motion)[1]
    # x -> here.turn (x + here.shift) -> there.turn^T (.) - there.shift
    turn = there.turn.mT @ here.turn
    back = (turn.mT @ there.shift[..., None])[..., 0]
    return Frame(turn, here.shift - back)


def moved(motion: Motion, move: Frame) -> Motion:
    """The same motion (B, T) elsewhere."""
    return world_to_local(_like(move, motion), motion)


def moved_back(motion: Motion, move: Frame) -> Motion:
    """The inverse of :func:`moved`."""
    return local_to_world(_like(move, motion), motion)


def _like(move: Frame, motion: Motion) -> Frame:
    return Frame(move.turn.to(motion.root), move.shift.to(motion.root))


def _move(turn: Tensor, shift: Tensor) -> Frame:
    """x -> R x + shift, with no change of height."""
    matrix = rotation.rotation_about("z", turn)
    flat = shift * shift.new_tensor([1.0, 1.0, 0.0])
    return Frame(matrix, (matrix.mT @ flat[..., None])[..., 0])


def turned_noise(noise: Tensor, move: Frame, layout: Layout) -> Tensor:
    """Noise (B, T, D) on windows as it lies on the same windows moved: turned with root place and orientation.

    Exact as a group has one scale for all its numbers. For layouts without velocities, in world space.
    """
    if layout.velocities:
        raise ShapeError("turned_noise: expected a layout without velocities")
    out, turn = noise.clone(), move.turn.to(noise)
    for name in ("root", "orient"):
        part = noise[..., layout.slices[name]].unflatten(-1, (-1, 3))  # 6-D: two columns of a matrix
        out[..., layout.slices[name]] = (part @ turn.mT).flatten(-2)
    return out


# -------------------------------------------------------------------------------------------- root and body together
def driven(motion: Motion, *, least: float = TRAVELS) -> Tensor:
    """How well the legs account for where the root goes, (...): the cosine, over all frames and both axes of the floor,
    between the root's velocity and the velocity that its lower foot pushes it with, were it to stand.

    1: the lower foot stands or the root moves in its direction; 0: root and legs know nothing of each other. NaN where
    the root's mean speed is below ``least`` m/s. The lower foot: the joint of the feet nearest to its resting height.
    """
    feet = motion.skeleton.indices(list(FEET))
    about = motion.positions[..., feet, :] - motion.root[..., None, :]
    columns = [motion.skeleton.contact_names.index(name) for name in FEET]
    clear = motion.positions[..., feet, 2] - resting_heights(motion.skeleton)[..., columns]
    lower = (clear[..., 1:, :] + clear[..., :-1, :]).argmin(-1)[..., None, None]
    push = -about[..., :2].diff(dim=-3).gather(-2, lower.expand(*lower.shape[:-1], 2))[..., 0, :] * motion.fps
    way = motion.root[..., :2].diff(dim=-2) * motion.fps
    size = way.square().sum((-1, -2)).sqrt() * push.square().sum((-1, -2)).sqrt()
    found = (way * push).sum((-1, -2)) / size.clamp_min(1e-12)
    return torch.where(torch.linalg.vector_norm(way, dim=-1).mean(-1) >= least, found, torch.nan)


def speeds(motion: Motion) -> tuple[Tensor, Tensor]:
    """Mean speed (...) of the root over the floor, and of the balls of the feet about the pelvis, m/s."""
    feet = motion.skeleton.indices(["left_foot", "right_foot"])
    about = motion.positions[..., feet, :] - motion.root[..., None, :]
    seated = (motion.rot[..., None, 0, :, :].mT @ about[..., None])[..., 0]
    legs = torch.linalg.vector_norm(seated.diff(dim=-3), dim=-1).mean((-1, -2)) * motion.fps
    return torch.linalg.vector_norm(motion.root[..., :2].diff(dim=-2), dim=-1).mean(-1) * motion.fps, legs


def correlation(a: Tensor, b: Tensor) -> Tensor:
    """Pearson's, over the last axis."""
    a, b = (x - x.mean(-1, keepdim=True) for x in (a.double(), b.double()))
    return (a * b).sum(-1) / (a.square().sum(-1) * b.square().sum(-1)).sqrt()


def correlated(motion: Motion, group: int = 32) -> Tensor:
    """Correlation of the two :func:`speeds` over the clips (B, T) of each whole group of so many, (B // group,)."""
    root, legs = speeds(motion)
    if len(root) < group:
        raise ShapeError(f"correlated: expected {group} clips or more, got {len(root)}")
    count = len(root) // group
    return correlation(*(x[: count * group].reshape(count, group) for x in (root, legs)))


def shuffled(motion: Motion, generator: torch.Generator) -> Motion:
    """A control: each clip (B, T) goes the way of another one, from its own first place and heading, and its legs know
    nothing of it."""
    local, frame = stuck_root(motion)
    count = len(local.root)
    order = torch.randperm(count, generator=generator)
    other = torch.empty_like(order)
    other[order] = order.roll(1)  # nobody keeps its own
    flat = torch.cat((local.root[other][..., :2], local.root[..., 2:]), -1)
    return local_to_world(frame, replace(local, root=flat))


def belongs(motion: Motion) -> dict[str, Tensor]:
    """What tells a root apart from its body, one number (B,) per clip.

    skate: share of frames with a sliding foot. slide: mm per frame of joints that the motion labels as touching; NaN
    where none does. driven: see above. acceleration: of the joints; root acceleration: of the root, m/s^2.
    """
    balls = motion.positions[..., motion.skeleton.indices(["left_foot", "right_foot"]), :]
    touching = motion.positions[..., motion.skeleton.contact_indices, :]
    return {
        "skate": gait.skating_ratio(balls, motion.fps),
        "slide": gait.slide_in_contact_mm(touching, motion.contacts),
        "driven": driven(motion),
        "acceleration": pose.mean_acceleration(motion.positions, motion.fps),
        "root acceleration": pose.mean_acceleration(motion.root[..., None, :], motion.fps),
    }


# ------------------------------------------------------------------------------------------------- size of the space
class Spread(NamedTuple):
    """Principal components of windows (N, T, D) as rows of T D numbers."""

    shares: Tensor  #: of the variance, falling; no more than N - 1
    needed: int  #: components that hold 95 % of it
    effective: float  #: (sum s)^2 / sum s^2, the participation ratio


def spread(rows: Tensor, share: float = 0.95) -> Spread:
    """How many directions windows (N, T, D), in the numbers that a model sees, vary in."""
    flat = rows.double().flatten(1)
    flat = flat - flat.mean(0)
    values = torch.linalg.eigvalsh(flat @ flat.mT).flip(0)[: len(flat) - 1].clamp_min(0)
    shares = values / values.sum()
    needed = int((shares.cumsum(0) < share).sum()) + 1
    return Spread(shares, needed, float(1 / shares.square().sum()))


def between(rows: Tensor, part: slice) -> float:
    """Share in 0..1 of a group's variance over windows (N, T, D) that lies between their means: what says where a
    window is, not what happens in it."""
    x = rows[..., part].double()
    means = (x.mean(1) - x.mean((0, 1))).square().mean(0).sum()
    return float(means / (x - x.mean((0, 1))).square().mean((0, 1)).sum())


def as_rows(motion: Motion, frame: str) -> Tensor:
    """Joint positions of windows (N, T) as rows (N, T J 3), metres: as they lie ("world"), or "stuck"."""
    motion = stuck_root(motion)[0] if frame == "stuck" else motion
    return motion.positions.flatten(1)


# --------------------------------------------------------------------------------------------- there and back
def round_trip(layout: Layout, normaliser: Normaliser, motion: Motion) -> Tensor:
    """Largest difference (B,) of a root, metres, or a rotation, radians, of windows (B, T) from themselves, written as
    normalised rows, read back and put where they were."""
    rows = normaliser.undo(normaliser.apply(layout.encode(motion)))
    return differs(_put_back(layout, layout.decode(rows, motion.fps), motion), motion)


def differs(a: Motion, b: Motion) -> Tensor:
    """Largest difference (B,) of a root, metres, or a rotation, radians, between clips (B, T)."""
    place = torch.linalg.vector_norm(a.root - b.root, dim=-1).amax(-1)
    return torch.maximum(place, rotation.geodesic(a.rot, b.rot).amax((-1, -2)))


def _put_back(layout: Layout, made: Motion, motion: Motion) -> Motion:
    """What a layout decoded, where ``motion``, whose rows it comes from, is in the world."""
    return local_to_world(stuck_root(motion)[1], made) if layout.frame == "stuck" else made


# ------------------------------------------------------------------------------------------------------ one guess
@torch.no_grad()
def guess(model: Trained, motion: Motion, share: float, noise: Tensor) -> Motion:
    """The model's guess of windows (B, T) from x_t at a share of the noising steps, where the windows are."""
    x0 = model.encode(motion)
    t = torch.full((len(x0),), round(share * (len(model.schedule) - 1)))
    x = model.denoiser(model.schedule.noised(x0, t, noise), model.schedule.stamps[t])
    return _put_back(model.layout, model.decode(x, motion.skeleton), motion)


def noise_for(model: Trained, motion: Motion, generator: torch.Generator) -> Tensor:
    """Noise (B, T, D) for :func:`guess`."""
    return noise_like(model.encode(motion), generator)


def apart(a: Motion, b: Motion) -> Tensor:
    """Mean distance (B,) in metres of the joints of clips (B, T), the first root of one put on the other's."""
    p, q = (m.positions - m.root[..., :1, None, :] for m in (a, b))
    return torch.linalg.vector_norm(p - q, dim=-1).mean((-1, -2))


def errors(a: Motion, truth: Motion) -> tuple[Tensor, Tensor]:
    """Mean error (B,) in metres of the root's path about its start, and of the joints about the pelvis."""
    path = torch.linalg.vector_norm((a.root - a.root[..., :1, :]) - (truth.root - truth.root[..., :1, :]), dim=-1)
    body = pose.mpjpe(a.positions, truth.positions, align="root")
    return path.mean(-1), body


def both(a: Tensor, b: Tensor) -> Tensor:
    """a - b where both are numbers."""
    difference = a - b
    return difference[difference.isfinite()]
