"""A contest: every solver that notebook 08 compares, on the same clips, and contests beside one another on many cores.

What is timed is one process with one thread, by its own processor time. Others beside it take a share of the memory's
bandwidth, from all contenders alike.
"""

from __future__ import annotations

import pickle
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import active_children, get_context
from typing import TypeVar

import torch
from torch import Tensor

from motionlab.humor import multiple, multiple_trials, shooting, solver_costs
from motionlab.humor.solver_trials import Run, Single, Task, shot, single_shooting
from motionlab.humor.windowed import Windows, windowed

T = TypeVar("T")
NO_LEAPS = "shooting, no leaps"


@dataclass(frozen=True)
class Contest:
    """How the contenders of one task play.

    single, eager: single shooting's search and its start (``transitions.start``). windows, soft: those of windows and
    of multiple shooting. plan: of shooting, which finishes multiple shooting too.
    """

    single: Single
    eager: float
    windows: Windows
    soft: multiple.Plan
    plan: shooting.Plan

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

    def together(self, task: Task, seconds: float, further: shooting.Plan) -> tuple[dict[str, Run], Tensor]:
        """Those that play in batches, and the lowest energy (B,) that anybody found on each clip: they, multiple
        shooting, or shooting carried on by ``further`` from where single shooting and shooting end."""
        runs = {
            "single shooting": self.patient(task, seconds),
            "shooting": shot(task, self.plan),
            NO_LEAPS: shot(task, replace(self.plan, leaps=0)),
        }
        more = [shot(task, further, runs[who].unknown) for who in ("single shooting", "shooting")]
        more.append(multiple_trials.shot(task, self.soft, self.plan))
        return runs, solver_costs.lowest([*runs.values(), *more])


def groups(clips: int, size: int) -> list[range]:
    """Clips in batches of ``size``; the last may be smaller."""
    return [range(k, min(k + size, clips)) for k in range(0, clips, size)]


def beside(
    jobs: Sequence[Callable[[], T]], workers: int, done: Callable[[int, T], object] = lambda k, found: None
) -> list[T]:
    """What the jobs return, in their order: so many at a time, each in a process of its own with one thread; with one
    worker here, one after the other. One that fails, or Ctrl-C, ends them all.

    done: called here with the number of a job and what it returned, as soon as it has."""
    found = {}
    if workers == 1:
        for k, job in enumerate(jobs):
            found[k] = job()
            done(k, found[k])
        return list(found.values())
    others = set(active_children())
    with ProcessPoolExecutor(workers, get_context("spawn"), _worker) as pool:
        futures = {pool.submit(_called, pickle.dumps(job)): k for k, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                k = futures[future]
                found[k] = pickle.loads(future.result())
                done(k, found[k])
            return [found[k] for k in range(len(jobs))]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(active_children()) - others:
                worker.terminate()
            raise


def _worker() -> None:
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a fit would take it for "stop at your best"; who waits ends it


def _called(job: bytes) -> bytes:
    """Bytes, since tensors between processes would keep a file open each."""
    return pickle.dumps(pickle.loads(job)())
