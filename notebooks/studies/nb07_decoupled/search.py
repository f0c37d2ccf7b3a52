"""How the decoupled unknowns are looked for: Adam, jointly, one of them alone, in turns; copying, blending.

Every clip of a batch is a search of its own, so that settings are compared in one batch, one row each.

Source: thesis 3.3.1 (copy, blend, loss), 3.3.3 (x or z alone; "flip flop", which it names and does not try).
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from motionlab.humor.stages import Problem
from studies.nb07_decoupled.energy import Form, Sequences, Unknown, terms, to_persistent

X, Z, BOTH = ("x", "betas"), ("z",), ("x", "betas", "z")
_BETAS = (0.9, 0.999)  # Adam's, as everywhere
Number = float | Tensor  # one, or one per clip (B,)


@dataclass(frozen=True)
class Plan:
    """What moves and how.

    form: the energy; its weight is 0 where ``share`` says that x is overwritten. moving: ``X``, ``Z`` or ``BOTH``.
    rate: Adam's steps, of z in the latent's units, of x in metres, metres per second and entries of 6D.
    share: after every step x_t becomes (1 - share) x_t + share x^1_t for t > 0: 1 copies, between 0 and 1 blends.
    held: the first state does not move. turns: z alone, then x alone, so often.
    """

    form: Form = field(default_factory=Form)
    moving: tuple[str, ...] = BOTH
    rate: Number = 0.01
    share: Number = 0.0
    held: bool = False
    turns: int = 0


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found: x (B, T, 273), z (B, T - 1, 48), betas (B, 8).

    seconds: processor time of the search alone. watched: what ``watch`` returned, by evaluations before it.
    """

    unknown: dict[str, Tensor]
    seconds: float
    watched: dict[int, dict[str, Tensor]] = field(default_factory=dict)


def descend(hessian: np.ndarray, pull: np.ndarray, most: int = 100_000) -> tuple[np.ndarray, int]:
    """The toy: minimises x'Hx/2 - b'x from 0 by conjugate gradients, until a millionth of the fall in energy is left or
    for ``most`` iterations; returns where that ends, and after how many."""
    x, left, least = 0 * pull, pull, pull @ np.linalg.solve(hessian, pull) / 2
    way, done = left, 0
    while least - x @ (pull + left) / 2 > 1e-6 * least and done < most:
        size = left @ left / (way @ hessian @ way)
        x, new = x + size * way, left - size * (hessian @ way)
        way, left, done = new + new @ new / (left @ left) * way, new, done + 1
    return x, done


def search(
    problem: Problem, start: Unknown, plan: Plan, evaluations: int, *,
    watch: Callable[[Unknown], dict[str, Tensor]] | None = None, at: Sequence[int] = (),
) -> Found:  # fmt: skip
    """Adam, clip by clip, with steps that shrink to nothing along half a cosine; or in turns of it.

    watch: called with the unknowns after ``at`` evaluations; it is not timed. A clip that is not finite stays.
    """
    if plan.turns:
        return _in_turns(problem, start, plan, evaluations)
    now = {n: x.detach().clone() for n, x in start.items()}
    first = {n: torch.zeros_like(now[n]) for n in plan.moving}
    second = {n: torch.zeros_like(now[n]) for n in plan.moving}
    watched, spent = {}, 0.0
    for i in range(evaluations + 1):
        if watch and i in at:
            watched[i] = watch(now)
        if i == evaluations:
            break
        began = time.process_time()
        gradient, good, decoded = _evaluated(problem, now, plan)
        pace = 0.5 * (1 + math.cos(math.pi * i / evaluations))
        for n, g in gradient.items():
            first[n].lerp_(g, 1 - _BETAS[0])
            second[n].lerp_(g.square(), 1 - _BETAS[1])
            size = (second[n] / (1 - _BETAS[1] ** (i + 1))).sqrt_().add_(1e-8)
            step = _like(plan.rate, g) * pace / (1 - _BETAS[0] ** (i + 1))
            now[n] = now[n] - torch.where(_like(good, g), step * first[n] / size, 0.0)
        if bool((torch.as_tensor(plan.share) > 0).any()):
            after, x = to_persistent(decoded.states[:, 0, 1:].detach()), now["x"]
            now["x"] = torch.cat((x[:, :1], torch.lerp(x[:, 1:], after, _like(plan.share, after).to(x))), 1)
        spent += time.process_time() - began
    return Found(now, spent, watched)


def _evaluated(problem: Problem, now: Unknown, plan: Plan) -> tuple[dict[str, Tensor], Tensor, Sequences]:
    """The gradients of what moves, 0 where they are not finite, which clips' are (B,), and the decoded sequences."""
    point = {n: x.detach().requires_grad_(n in plan.moving) for n, x in now.items()}
    found, decoded = terms(problem, point, plan.form)
    value = sum(found.values())
    gradient = dict(zip(plan.moving, torch.autograd.grad(value.sum(), [point[n] for n in plan.moving]), strict=True))
    if plan.held and "x" in gradient:
        gradient["x"][:, 0] = 0.0
    good = torch.stack([g.flatten(1).isfinite().all(1) for g in (value[:, None], *gradient.values())]).all(0)
    return {n: torch.where(_like(good, g), g, 0.0) for n, g in gradient.items()}, good, decoded


def _like(value: Number, x: Tensor) -> Tensor:
    """One number per clip (B,), or a single one, in as many axes as x has."""
    value = torch.as_tensor(value)
    return value.reshape(-1, *(1,) * (x.ndim - 1)) if value.ndim else value


def _in_turns(problem: Problem, start: Unknown, plan: Plan, evaluations: int) -> Found:
    """Flip-flop: a block of evaluations with x fixed, as many with z fixed, and so on. A clip whose energy a block has
    not lowered goes back to where it was."""
    now, spent = {n: x.detach().clone() for n, x in start.items()}, 0.0
    before = _energy(problem, now, plan.form)
    for turn in range(2 * plan.turns):
        part = replace(plan, moving=(Z, X)[turn % 2], turns=0)
        found = search(problem, now, part, evaluations // (2 * plan.turns))
        after = _energy(problem, found.unknown, plan.form)
        lower = after < before
        now = {n: torch.where(_like(lower, x), found.unknown[n], x) for n, x in now.items()}
        before, spent = torch.where(lower, after, before), spent + found.seconds
    return Found(now, spent)


def _energy(problem: Problem, unknown: Unknown, form: Form) -> Tensor:
    with torch.no_grad():
        return sum(terms(problem, unknown, form)[0].values())
