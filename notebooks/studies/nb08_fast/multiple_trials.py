"""Multiple shooting among the solvers of ``trials``: energies of exact roll-outs only, by the same clock."""

from __future__ import annotations

from dataclasses import replace

import torch

from motionlab.humor import state
from motionlab.humor.shooting import feedback_solver
from studies.nb08_fast import multiple_shooting
from studies.nb08_fast.trials import Run, Task, clock, so_far
from studies.nb08_fast.trials import shot as finished


def shot(task: Task, plan: multiple_shooting.Plan | None = None, finish: feedback_solver.Plan | None = None) -> Run:
    """Multiple shooting from stage 2's states, finished by closed-loop ``shooting`` from the roll-out that it ends in.

    Its free states have no energy to note: the first one, at the time that it was known, is that of this roll-out.
    """
    began, report = clock(), multiple_shooting.Report(clock=clock)
    unknown = multiple_shooting.start(task.problem, task.unknown, state.from_motion(task.rough), plan, report)
    spent = clock() - began
    run = finished(task, finish, unknown)
    energies = so_far(torch.cat((report.end[None].to(run.energies), run.energies)))
    seconds = torch.cat((run.seconds.new_tensor([spent]), spent + run.seconds))
    linearised = run.linearised + sum(report.linearised)
    return replace(run, energies=energies, seconds=seconds, spent=spent + run.spent, linearised=linearised)
