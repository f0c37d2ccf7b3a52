"""How the decoupled unknowns are looked for: Adam or L-BFGS, jointly, one of them alone, in turns; copying, blending.

Every clip of a batch is a search of its own: energies are sums per clip, Adam's steps are taken number by number, and
L-BFGS is the batched one. So settings are compared in one batch, one row each.

Source: thesis 3.3.1 (copy, blend, loss), 3.3.3 (x or z alone; "flip flop", which it names and does not try).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab.humor.stages import Problem, interrupted
from motionlab.optimise import minimise_batch
from studies.nb07_decoupled.energy import Form, Sequences, Unknown, terms, to_persistent

X, Z, BOTH = ("x", "betas"), ("z",), ("x", "betas", "z")
_BETAS = (0.9, 0.999)  # Adam's, as everywhere
Number = float | Tensor  # one, or one per clip (B,)


@dataclass(frozen=True)
class Plan:
    """What moves and how.

    form: the energy; its weight is 0 where ``share`` says that x is overwritten. moving: ``X``, ``Z`` or ``BOTH``.
    rate_x, rate_z: Adam's steps, of z in the latent's units, of x in metres, metres per second and entries of 6D.
    share: after every step x_t becomes (1 - share) x_t + share x^1_t for t > 0: 1 copies, between 0 and 1 blends.
    settle: the steps shrink to nothing along half a cosine; otherwise they stay.
    """

    form: Form = field(default_factory=Form)
    moving: tuple[str, ...] = BOTH
    rate_x: Number = 0.01
    rate_z: Number = 0.01
    share: Number = 0.0
    settle: bool = True


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found: x (B, T, 273), z (B, T - 1, 48), betas (B, 8).

    history (n, B): the decoupled energy at every evaluation. seconds: processor time of the search alone.
    watched: what ``watch`` returned, by the number of evaluations before it.
    """

    unknown: dict[str, Tensor]
    history: Tensor
    seconds: float
    watched: dict[int, dict[str, Tensor]] = field(default_factory=dict)

    @property
    def evaluations(self) -> int:
        """Of the energy and its gradient, all clips at once."""
        return len(self.history)


Watch = Callable[[Unknown], dict[str, Tensor]]


def adam(
    problem: Problem,
    start: Unknown,
    plan: Plan,
    iterations: int,
    *,
    watch: Watch | None = None,
    at: Sequence[int] = (),
    progress: bool = False,
) -> Found:
    """Adam, clip by clip. watch: called with the unknowns after ``at`` evaluations (0: at the start); it is not timed.

    A clip whose energy or gradient is not finite stays where it is.
    """
    now = {n: x.detach().clone() for n, x in start.items()}
    first = {n: torch.zeros_like(now[n]) for n in plan.moving}
    second = {n: torch.zeros_like(now[n]) for n in plan.moving}
    rates = {n: plan.rate_z if n == "z" else plan.rate_x for n in plan.moving}
    history, watched, spent = [], {}, 0.0
    for i in tqdm(range(iterations + 1), disable=not progress, leave=False):
        if watch and i in at:
            watched[i] = watch(now)
        if i == iterations:
            break
        began = time.process_time()
        value, gradient, decoded = _evaluated(problem, now, plan)
        history.append(value)
        good = torch.stack([g.flatten(1).isfinite().all(1) for g in (value[:, None], *gradient.values())]).all(0)
        pace = 0.5 * (1 + math.cos(math.pi * i / iterations)) if plan.settle else 1.0
        for n, g in gradient.items():
            g = torch.where(_like(good, g), g, 0.0)
            first[n].lerp_(g, 1 - _BETAS[0])
            second[n].lerp_(g.square(), 1 - _BETAS[1])
            size = (second[n] / (1 - _BETAS[1] ** (i + 1))).sqrt_().add_(1e-8)
            step = _like(rates[n], g) * pace / (1 - _BETAS[0] ** (i + 1))
            now[n] = now[n] - torch.where(_like(good, g), step * first[n] / size, 0.0)
        if _overwrites(plan):
            now["x"] = _blended(now["x"], decoded, plan.share)
        spent += time.process_time() - began
    return Found(now, torch.stack(history), spent, watched)


def _evaluated(problem: Problem, now: Unknown, plan: Plan) -> tuple[Tensor, dict[str, Tensor], Sequences]:
    point = {n: x.detach().requires_grad_(n in plan.moving) for n, x in now.items()}
    found, decoded = terms(problem, point, plan.form)
    value = sum(found.values())
    gradient = torch.autograd.grad(value.sum(), [point[n] for n in plan.moving])
    return value.detach(), dict(zip(plan.moving, gradient, strict=True)), decoded


def _overwrites(plan: Plan) -> bool:
    return bool((torch.as_tensor(plan.share) > 0).any())


def _blended(x: Tensor, decoded: Sequences, share: Number) -> Tensor:
    after = to_persistent(decoded.states[:, 0, 1:].detach())
    return torch.cat((x[:, :1], torch.lerp(x[:, 1:], after, _like(share, after).to(x))), 1)


def _like(value: Number, x: Tensor) -> Tensor:
    """One number per clip (B,), or a single one, in as many axes as x has."""
    value = torch.as_tensor(value)
    return value.reshape(-1, *(1,) * (x.ndim - 1)) if value.ndim else value


def lbfgs(
    problem: Problem,
    start: Unknown,
    plan: Plan,
    evaluations: int,
    *,
    watch: Watch | None = None,
    at: Sequence[int] = (),
) -> Found:
    """L-BFGS with strong Wolfe, clip by clip. Of a plan its form and what moves count; nothing is overwritten.

    watch: called with the lowest points so far after ``at`` evaluations (0: at the start) and at the end; not timed.

    Raises:
        KeyboardInterrupt: somebody stopped it; a search that was cut short is none to compare with.
    """
    leaves = {n: x.detach().clone().requires_grad_(n in plan.moving) for n, x in start.items()}

    def energy(point: Unknown, rows: Tensor) -> Tensor:
        weight = plan.form.weight
        form = replace(plan.form, weight=weight[rows]) if isinstance(weight, Tensor) and weight.ndim else plan.form
        return sum(terms(problem.rows(rows), point, form)[0].values())

    watched, began, away = {0: watch(start)} if watch and 0 in at else {}, time.process_time(), 0.0

    def look(n: int, lowest: Unknown) -> None:
        nonlocal away
        if watch and n in at:
            left = time.process_time()
            watched[n] = watch(lowest)
            away += time.process_time() - left

    how = {"steps": evaluations, "inner": 1, "max_closures": evaluations, "rows": True, "watch": look}
    fit = minimise_batch(energy, leaves, **how)
    spent = time.process_time() - began - away
    if interrupted(fit):
        raise KeyboardInterrupt
    if watch:
        watched[fit.closures] = watch(fit.variables)
    return Found(fit.variables, fit.history, spent, watched)


def alternate(
    problem: Problem,
    start: Unknown,
    plan: Plan,
    *,
    turns: int,
    inner: int,
    method: str = "adam",
    first: str = "z",
    watch: Watch | None = None,
) -> Found:
    """Flip-flop: ``inner`` evaluations with x fixed, as many with z fixed, and so on, ``turns`` of either.

    Every block lowers the same energy. A clip whose energy a block has not lowered goes back to where it was, so that
    the energy never rises from block to block. history holds the energies at the ends of the blocks, and at the start;
    watch is called at the same places.
    Source: thesis 3.3.3, "flip flop optimising z_{1:T} then x_{0:T}".
    """
    now = {n: x.detach().clone() for n, x in start.items()}
    spent, kept = 0.0, [energy_of(problem, now, plan.form)]
    watched = {0: watch(now)} if watch else {}
    blocks = (Z, X) if first == "z" else (X, Z)
    for turn in range(2 * turns):
        part = replace(plan, moving=blocks[turn % 2])
        run = adam if method == "adam" else lbfgs
        found = run(problem, now, part, inner)
        after = energy_of(problem, found.unknown, plan.form)
        lower = after < kept[-1]
        now = {n: torch.where(_like(lower, x), found.unknown[n], x) for n, x in now.items()}
        kept.append(torch.where(lower, after, kept[-1]))
        spent += found.seconds
        if watch:
            watched[(turn + 1) * inner] = watch(now)
    return Found(now, torch.stack(kept), spent, watched)


def energy_of(problem: Problem, unknown: Unknown, form: Form) -> Tensor:
    """E (B,), without gradients."""
    with torch.no_grad():
        return sum(terms(problem, unknown, form)[0].values())


def reach(problem: Problem, start: Unknown, plan: Plan, nudged: Unknown, iterations: int) -> Tensor:
    """How far x is moved by a change of its start, metres: (iterations + 1, T), the largest over clips and joints.

    0 exactly where nothing has arrived. Two searches that differ in their starts alone, compared after every step.
    """
    at = range(iterations + 1)

    def look(unknown: Unknown) -> dict[str, Tensor]:
        return {"x": unknown["x"].clone(), "z": unknown["z"].clone()}

    a, b = (adam(problem, u, plan, iterations, watch=look, at=at).watched for u in (start, nudged))
    return torch.stack([(a[i]["x"] - b[i]["x"]).abs().amax((0, 2)) for i in at])
