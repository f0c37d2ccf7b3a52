"""Gaps in dances, filled by interpolation, by a linear model of other dances, and by diffusion; judged as LAFAN1 does.

Windows on the standard body: ten frames of past, the gap, one target frame. Methods see nothing else.

Source: the protocol of the LAFAN1 benchmark (``lafan_benchmark``) on other data. Differs: windows are turned by the
body's heading at the last past frame (the benchmark turns by LAFAN1's own root axis), so the numbers do not compare
with published ones, only with each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.contact import with_contacts
from motionlab.diffusion.features import Layout
from motionlab.diffusion.inpainting import Way, repair
from motionlab.diffusion.model import Trained
from motionlab.errors import ShapeError
from motionlab.heading import local_to_world, stuck_root
from motionlab.metrics.pose import joint_errors
from motionlab.motion import Motion
from studies.shared import lafan_benchmark
from studies.shared.lafan_benchmark import PAST, Fill, Statistics, hidden, interpolation, zero_velocity

#: Baselines that need no training.
BASELINES: dict[str, Fill] = {"zero velocity": zero_velocity, "interpolation": interpolation}
NEAR = (PAST - 3, PAST - 2, PAST - 1)  # frames of the past that the linear model looks at
_LAYOUT = Layout(contacts=False)


def canonical(cuts: Motion, past: int = PAST, truth: Motion | None = None) -> Motion:
    """Windows (N, T): mean root over the origin, the last past frame heading along +y; of ``truth``, where given, so
    that what was filled in is moved as what it is compared with."""
    truth = cuts if truth is None else truth
    on_floor = cuts.root.new_tensor([1.0, 1.0, 0.0])
    root = cuts.root - truth.root.mean(-2, keepdim=True) * on_floor
    turn = rotation.rotation_about("z", -rotation.yaw(truth.rot[..., past - 1, 0, :, :]))[..., None, :, :]
    rot = torch.cat(((turn @ cuts.rot[..., 0, :, :])[..., None, :, :], cuts.rot[..., 1:, :, :]), -3)
    return replace(cuts, root=(turn @ root[..., None])[..., 0], rot=rot, contacts=None)


def statistics(train: Motion) -> Statistics:
    """Mean and deviation of every coordinate over training windows (N, T), as L2P divides by."""
    return lafan_benchmark.statistics([canonical(train)])


# ------------------------------------------------------------------------------------------------ linear model
@dataclass(frozen=True, eq=False)
class Linear:
    """What interpolation leaves over, as a linear function of the last past frames and the target; for one gap.

    weights (3 + 1 frames x D + 1, gap x D): of numbers in the frame of the window's first frame, as the denoiser's.
    """

    gap: int
    weights: Tensor

    def __call__(self, seen: Motion, gap: int) -> Motion:
        """The windows filled; a ``Fill``."""
        if gap != self.gap:
            raise ShapeError(f"trained for gaps of {self.gap} frames, not {gap}")
        straight = interpolation(seen, gap)
        local, frame = stuck_root(straight)
        x = _LAYOUT.encode(straight).double()
        said = (_inputs(x, gap) @ self.weights).unflatten(-1, (gap, _LAYOUT.size))
        x[:, PAST : PAST + gap] += said
        made = local_to_world(frame, _LAYOUT.decode(x.to(seen.root), seen.fps, local.skeleton))
        keep = torch.zeros(made.frames, dtype=torch.bool)
        keep[PAST : PAST + gap] = True
        rot = torch.where(keep[:, None, None, None], made.rot, straight.rot)
        return replace(straight, root=torch.where(keep[:, None], made.root, straight.root), rot=rot)


def _inputs(x: Tensor, gap: int) -> Tensor:
    known = x[:, [*NEAR, PAST + gap]].flatten(1)
    return torch.cat((known, torch.ones_like(known[:, :1])), -1)


def linear(train: Motion, choose: Motion, gap: int, penalties: Sequence[float] = (1e-2, 1e-1, 1, 10, 100)) -> Linear:
    """Ridge regression on windows of training dances; its penalty is the one with the least error on ``choose``.

    Args:
        train: (N, >= PAST + gap + 1). choose: windows of training dances that the regression is not made from.
        penalties: on the squared weights, per window; the constant is free.

    Source: the delta to the interpolation, as Oreshkin et al. 2023, with a linear map in place of their network.
    """
    last = PAST + gap
    straight, truth = (_LAYOUT.encode(m).double() for m in (interpolation(train, gap), train.cut(0, last + 1)))
    inputs, wanted = _inputs(straight, gap), (truth - straight)[:, PAST:last].flatten(1)
    centre, aim = inputs.mean(0), wanted.mean(0)
    a, b = inputs - centre, wanted - aim
    values, vectors = torch.linalg.eigh(a.T @ a)
    against = vectors.T @ (a.T @ b)
    tried = []
    for penalty in penalties:
        weights = vectors @ (against / (values.clamp(min=0) + penalty * len(a))[:, None])
        weights[-1] = aim - (centre @ weights - centre[-1] * weights[-1])
        model = Linear(gap, weights)
        tried.append((errors(model(hidden(choose, gap), gap), choose, gap).mean().item(), model))
    return min(tried, key=lambda pair: pair[0])[1]


# --------------------------------------------------------------------------------------------------- diffusion
def by_diffusion(model: Trained, generator: torch.Generator, way: Way, floor: bool = False) -> Fill:
    """A ``Fill`` by a model: what it may see is known to it, contacts with the floor only where ``floor`` is one."""

    def fill(seen: Motion, gap: int) -> Motion:
        seen, frames = hidden(seen, gap), model.recipe.frames
        if seen.frames > frames:
            raise ShapeError(f"{PAST} frames, a gap of {gap} and a target do not fit into {frames} frames")
        index = torch.arange(frames).clamp(max=seen.frames - 1)
        whole = replace(seen, root=seen.root[:, index], rot=seen.rot[:, index])
        frame_numbers = [*range(PAST), PAST + gap]
        groups = None if floor else ("root", "orient", "pose")
        known = model.layout.mask(frames, only=frame_numbers, groups=groups)
        made = repair(model, with_contacts(whole), known, generator, way).cut(0, seen.frames)
        return replace(made, contacts=None)

    return fill


# ---------------------------------------------------------------------------------------------------- measures
def errors(filled: Motion, truth: Motion, gap: int) -> Tensor:
    """Mean joint error (N, gap) in metres of each frame of the gap, in the world."""
    inside = (m.cut(PAST, PAST + gap).positions for m in (filled, truth))
    return joint_errors(*inside, align="none").mean(-1)


@dataclass(frozen=True, eq=False)
class Gap:
    """One method's gaps of one length. errors (N, gap) metres. l2p, l2q (N,), npss: see ``inbetween_measures``."""

    errors: Tensor
    l2p: Tensor
    l2q: Tensor
    npss: float


def judge(windows: Motion, methods: Mapping[str, Fill], gap: int, stats: Statistics) -> dict[str, Gap]:
    """Every method on windows (N, >= PAST + gap + 1)."""
    truth = canonical(windows)
    found = {}
    for name, fill in methods.items():
        filled = fill(hidden(truth, gap), gap)
        scores = lafan_benchmark.score(filled, truth, stats, gap)
        found[name] = Gap(errors(filled, truth, gap), scores.l2p, scores.l2q, scores.npss)
    return found
