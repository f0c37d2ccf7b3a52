"""A contest: every solver that notebook 08 compares, on the same clips, and contests beside one another on many cores.

What is timed is one process with one thread, by its own processor time. Others beside it take a share of the memory's
bandwidth, from all contenders alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from motionlab.humor.shooting import feedback_solver
from studies.nb08_fast import costs, multiple_shooting, multiple_trials
from studies.nb08_fast.trials import Run, Single, Task, shot, single_shooting
from studies.nb08_fast.windowed import Windows, windowed

NO_LEAPS = "shooting, no leaps"


@dataclass(frozen=True)
class Contest:
    """How the contenders of one task play.

    single, eager: single shooting's search and its start (``start.start_stage_3``). windows, soft: those of windows and
    of multiple shooting. plan: of shooting, which finishes multiple shooting too.
    """

    single: Single
    eager: float
    windows: Windows
    soft: multiple_shooting.Plan
    plan: feedback_solver.Plan

    def patient(self, task: Task, seconds: float) -> Run:
        """Single shooting until the time is up, or nothing is gained."""
        return single_shooting(task.begun(self.eager), self.single.patient, seconds=seconds)

    def alone(self, task: Task, seconds: float) -> dict[str, Run]:
        """All contenders in turn, single shooting with so many seconds."""
        return {
            "single shooting": self.patient(task, seconds),
            "shooting": shot(task, self.plan),
            "windows": windowed(task, self.windows),
            "multiple shooting": multiple_trials.shot(task, self.soft, self.plan),
        }

    def together(self, task: Task, seconds: float, further: feedback_solver.Plan) -> tuple[dict[str, Run], Tensor]:
        """Those that play in batches, and the lowest energy (B,) that anybody found on each clip: they, multiple
        shooting, or shooting carried on by ``further`` from where single shooting and shooting end."""
        runs = {
            "single shooting": self.patient(task, seconds),
            "shooting": shot(task, self.plan),
            NO_LEAPS: shot(task, replace(self.plan, leaps=0)),
        }
        more = [shot(task, further, runs[who].unknown) for who in ("single shooting", "shooting")]
        more.append(multiple_trials.shot(task, self.soft, self.plan))
        return runs, costs.lowest([*runs.values(), *more])


def groups(clips: int, size: int) -> list[range]:
    """Clips in batches of ``size``; the last may be smaller."""
    return [range(k, min(k + size, clips)) for k in range(0, clips, size)]
