"""Where the default's time goes, and what it would be if it began at the truth."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.humor import stages, unknowns
from motionlab.humor import start as starts
from motionlab.humor.rollout import steered_rollout
from motionlab.humor.shooting import coordinates
from motionlab.humor.testops import Schedule
from motionlab.humor.unknowns import Unknowns
from studies.nb08_fast.trials import Run, Task, clock, shooting
from studies.shared.profiling import interleaved


def costs(task: Task, unknown: Unknowns, rounds: int) -> dict[str, Tensor]:
    """Processor seconds (rounds,) of what a search is made of, measured in turns around unknowns."""
    white, model = coordinates.linearised(task.problem, unknown, stride=4), task.problem.priors.motion
    first, base = unknowns.first_state(unknown, task.problem.priors).detach(), white.base.clone().requires_grad_()
    new = {"nu": torch.zeros_like(white.base), "first": torch.zeros_like(white.first[..., 0])}
    new = {name: x.requires_grad_() for name, x in new.items()}

    def closure() -> None:
        terms = stages.rolled_terms(task.problem, *coordinates.unwhiten(task.problem, unknown, white, new))
        torch.autograd.grad(sum(terms.values()).sum(), tuple(new.values()))

    def chain() -> None:
        torch.autograd.grad(steered_rollout(model, first, base, white.gains)[0].states.sum(), base)

    calls = {"closure": closure, "of it: chain of steps": chain}
    calls["linearisation"] = lambda: coordinates.linearised(task.problem, unknown, stride=4)
    calls["start that follows stage 2"] = lambda: task.begun(starts.DAMPING_SHOOTING)
    return interleaved(calls, n=rounds, clock=clock)


def from_truth(task: Task, work: Schedule) -> Run:
    """Our search with few rounds and no leaps, begun at the true motion: what a perfect start network would leave."""
    trust = torch.ones_like(task.problem.evidence.confidence_per_joint)
    start = task.posed_as(task.truth, trust).unknown
    plan = replace(work.shooting, rounds=3, closures=12, mode_jumps=0, halving_after=0, tolerance=0.0, min_gain=0.0)
    return shooting(task, replace(work, shooting=plan, guesses=False), start)


def compared(tasks: Sequence[Task], defaults: Sequence[Run], work: Schedule) -> list[dict[str, object]]:
    """A row per number of rounds begun at the truth: seconds, and nats a frame above the default's end (medians)."""
    found = [[(s, task.energy(u).item() / task.nat) for s, u in from_truth(task, work).kept[1:]] for task in tasks]
    rows = []
    for k in range(min(len(each) for each in found)):
        seconds = torch.tensor([each[k][0] for each in found])
        over = torch.tensor([e[k][1] - run.end / t.nat for e, t, run in zip(found, tasks, defaults, strict=True)])
        rows.append(
            {"rounds from the truth": k + 1, "clips": len(found), "s (median)": seconds.median().item(),
             "of the default's time, %": 100 * (seconds / torch.tensor([r.spent for r in defaults])).median().item(),
             "above the default's end, nats a frame (median)": over.median().item(),
             "middle half": " to ".join(f"{x:.2f}" for x in over.quantile(torch.tensor([0.25, 0.75])).tolist())}
        )  # fmt: skip
    return rows
