"""Single shooting in short windows, one exact roll-out of the stitched motion, and single shooting from there.

A window of 20 frames has a chain a third as long, and all windows run as one batch. Neighbours are asked to agree over
the frames that they share; what comes out of it is no roll-out yet. The judge is the same as for every other solver.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch

from motionlab.humor import start as starts
from motionlab.humor import unknowns
from studies.nb08_fast.trials import Run, Single, Task, clock, single_shooting, so_far


@dataclass(frozen=True)
class Windows:
    """How windows search: their frames, those that neighbours share at least, single shooting inside them, and its
    polish of the whole roll-out (None: none)."""

    window: int = 20
    overlap: int = 5
    inside: Single = field(default_factory=Single)
    polish: Single | None = None

    @classmethod
    def sharing(cls, iterations: int, polish: float = 0.0, *, window: int = 20, overlap: int = 5) -> Windows:
        """So many iterations in all, a share of them for the polish."""
        after = round(polish * iterations)
        parts = Single.budget(iterations - after)
        return cls(window, overlap, parts, Single(iterations=(0, 0, after)) if after else None)


def windowed(task: Task, how: Windows | None = None, *, seconds: float = torch.inf) -> Run:
    """Single shooting in short windows that are asked to agree, stitched, rolled out, and polished.

    The only energy that counts is that of a roll-out of the whole clip: the first point in time is the end of the
    windows. seconds: after which windows and polish stop.
    """
    began, how = clock(), how or Windows()
    problem, frames = task.problem, task.rough.frames
    cuts, length = unknowns.window_starts(frames, how.window, how.overlap), min(how.window, frames)
    rest = (problem.priors, cuts, length, "lean", problem.weights.pull)
    unknown, factors = starts.start_stage_3(
        task.rough, task.latent, task.unknown.shared(), problem.evidence.trust, *rest
    )
    pieces = replace(problem, evidence=problem.evidence.pieces(torch.tensor(cuts), length), starts=cuts)
    inner = replace(task, problem=pieces, unknown=unknown.detached(), factors=factors)
    unknown = single_shooting(inner, how.inside, seconds=seconds).unknown
    with torch.no_grad():
        body = unknowns.roll(unknown, problem.priors, pieces.evidence).body
    root, rot = (x.unflatten(0, (-1, len(cuts))) for x in (body.root, body.rot))
    whole = body._replace(
        root=unknowns.stitch_windows(root, cuts),
        rot=unknowns.stitch_windows(rot, cuts, turns=True),
        betas=unknown.betas,
    )
    stitched = unknowns.motion_of(whole, problem.evidence.fps)
    latent = unknown.latent[:, :1].flatten(0, 1)[:, None].expand(-1, frames, -1)
    sure = torch.ones_like(problem.evidence.trust)
    whole = (sure, problem.priors, (0,), frames, *rest[3:])
    found, factors = starts.start_stage_3(stitched, latent, unknown.shared(), *whole)
    found = found.detached()
    end = task.energy(found)
    spent = clock() - began
    if how.polish is None or spent > seconds:
        return Run(end[None], torch.tensor([spent]).double(), found, end, spent)
    after = single_shooting(replace(task, unknown=found, factors=factors), how.polish, seconds=seconds - spent)
    energies = so_far(torch.cat((end[None].to(after.energies), after.energies)))
    times = torch.cat((after.seconds.new_tensor([spent]), spent + after.seconds))
    return Run(energies, times, after.unknown, after.end, spent + after.spent)
