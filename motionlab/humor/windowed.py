"""Single shooting in short windows, and what one exact roll-out makes of the stitched motion.

A window of 20 frames has a chain a third as long, and all windows run as one batch. Neighbours are asked to agree over
the frames that they share; what comes out of it is no roll-out yet. The judge is the same as for every other solver.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from motionlab.humor import stages, transitions, variables, windows
from motionlab.humor.solver_trials import Run, Task, clock
from motionlab.humor.testops import Schedule


def windowed(task: Task, *, window: int = 20, overlap: int = 5, steps: int = 36, inner: int = 20) -> Run:
    """Single shooting in short windows that are asked to agree, stitched, followed by one exact roll-out.

    The only energy that counts is that of the roll-out, so that there is one point in time: the end.
    """
    began, schedule = clock(), Schedule.lean()
    problem, frames = task.problem, task.rough.frames
    cuts, length = windows.plan(frames, window, overlap), min(window, frames)
    shared = {n: task.unknown[n] for n in variables.SHARED if n in task.unknown}
    how = (problem.priors, cuts, length, "lean", problem.weights.pull)
    unknown, factors = transitions.start(task.rough, task.latent, shared, problem.evidence.trust, *how)
    pieces = replace(problem, evidence=problem.evidence.pieces(torch.tensor(cuts), length), starts=cuts)
    unknown, _ = stages.stage_3(
        pieces, unknown, factors, steps=steps, short=schedule.short, refine=schedule.refine, inner=inner,
        tolerance=schedule.tolerance,
    )  # fmt: skip
    with torch.no_grad():
        body = variables.roll(unknown, problem.priors, pieces.evidence).body
    root, rot = (x.unflatten(0, (-1, len(cuts))) for x in (body.root, body.rot))
    whole = body._replace(
        root=windows.stitch(root, cuts), rot=windows.stitch(rot, cuts, turns=True), betas=unknown["betas"]
    )
    stitched = variables.motion_of(whole, problem.evidence.fps)
    shared = {n: unknown[n] for n in shared}
    latent = unknown["latent"][:, :1].flatten(0, 1)[:, None].expand(-1, frames, -1)
    sure = torch.ones_like(problem.evidence.trust)
    found, _ = transitions.start(stitched, latent, shared, sure, problem.priors, (0,), frames, "lean", how[-1])
    spent = clock() - began
    found = {n: x.detach() for n, x in found.items()}
    end = task.energy(found)
    return Run(end[None], torch.tensor([spent]).double(), found, end, spent)
