"""What an evaluation costs: the roll-out against K steps from all states at once, and the whole decoupled energy.

Source: thesis 3.3.1. Times are processor time.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.humor.priors import Cvae
from motionlab.humor.rollout import infer, rollout
from studies.nb07_decoupled.energy import prior_of, terms
from studies.nb07_decoupled.search import Plan
from studies.nb07_decoupled.trials import Case
from studies.shared import profiling, savings
from studies.shared.profiling import Name

FORMS = {"official": savings.Savings(frozen=True), "lean": savings.LEAN}


def decodes(model: Cvae, states: Tensor, z: Tensor, steps: int | None, on: savings.Savings) -> Callable[[], Tensor]:
    """One evaluation: forwards, to the sum of the squares of what is decoded and the prior's nats, without the body.

    states (B, T, 339), z (B, T - 1, 48). steps: K from every state at once; None: the roll-out of all T - 1. In
    official form the prior is asked at every step, as that code does; in lean form once for each transition.
    """
    x, z = states.detach().requires_grad_(), z.detach().requires_grad_()
    frames = x.shape[1]
    at = (torch.arange(frames - 1)[:, None] + torch.arange(steps or 1)).clamp(max=frames - 2)

    def value() -> Tensor:
        if steps is None:
            found = savings.chain(model, x[:, 0], z, on)
        elif on.lean_layout:
            found = rollout(model, x[:, :-1].flatten(0, 1), z[:, at].flatten(0, 1), with_prior=False)
            found = found._replace(prior=prior_of(model, x), z=z)
        else:
            found = savings.chain(model, x[:, :-1].flatten(0, 1), z[:, at].flatten(0, 1), on)
        return found.states.square().sum() + found.contact_logits.square().sum() + found.prior.nll(found.z).sum()

    return value


@dataclass(frozen=True, eq=False)
class Costs:
    """seconds: processor time of evaluations with their gradients (n,), nodes: steps of autograd; both by
    (form, clips, K or None)."""

    seconds: dict[tuple[str, int, int | None], Tensor]
    nodes: dict[tuple[str, int, int | None], int]

    def gain(self, form: str, clips: int, steps: int) -> Tensor:
        """Time of the roll-out over that of K steps from all states at once, round by round (n,)."""
        return self.seconds[form, clips, None] / self.seconds[form, clips, steps]


def costs(model: Cvae, states: Tensor, batches: Sequence[int], steps: Sequence[int], rounds: int) -> Costs:
    """Times of the roll-out and of K steps, both forms, all in turns. states (1, T, 339) of any motion."""
    with torch.no_grad():
        z = infer(model, states)[0].mean
    calls = {
        (form, b, k): decodes(model, states.expand(b, -1, -1), z.expand(b, -1, -1), k, on)
        for form, on in FORMS.items()
        for b in batches
        for k in (None, *steps)
    }
    nodes = {key: profiling.graph_nodes(value()) for key, value in calls.items()}
    timed = {key: (lambda value=value: value().backward()) for key, value in calls.items()}
    return Costs(profiling.interleaved(timed, n=rounds, clock=time.process_time), nodes)


def closures(known: Case, plans: Mapping[Name, Plan], rounds: int) -> dict[Name, Tensor]:
    """Processor time in seconds (rounds,) of the energy with the gradients of what moves, plans in turns."""

    def closure(plan: Plan) -> Callable[[], object]:
        point = {n: x.clone().requires_grad_(n in plan.moving) for n, x in known.start.items()}
        moving = [point[n] for n in plan.moving]
        return lambda: torch.autograd.grad(sum(terms(known.problem, point, plan.form)[0].values()).sum(), moving)

    return profiling.interleaved({n: closure(p) for n, p in plans.items()}, n=rounds, clock=time.process_time)
