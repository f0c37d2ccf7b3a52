"""Minimises B independent energies at once by L-BFGS: memory, direction and line search belong to each clip alone.

One evaluation (closure) serves all clips, each of which is a generator (``_descent``): while one still searches along
its line, another is iterations ahead. What a clip does is what ``torch.optim.LBFGS`` with strong Wolfe would do to it
alone.

Source: Nocedal and Wright, Numerical Optimization, algorithms 7.4, 3.5 and 3.6; constants of ``torch.optim.LBFGS``.
Differs: torch evaluates the start of each outer step once more and cuts its last line search short; here neither. A
trial that is not finite is taken back towards the last finite one. A search without a lower energy forgets its memory
and tries steepest descent once. torch ignores pairs with a curvature below 1e-10 in the energy's own unit.
"""

import itertools
import math
import sys
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab.errors import NotConverged, ShapeError, check_shape

_C1, _C2 = 1e-4, 0.9  # sufficient decrease, curvature
_LONGEST, _SHRINK, _RETREATS = 25, 0.1, 8  # evaluations of a line search; what follows a trial that is not finite


class Trial(NamedTuple):
    """A point of a line search: step, energy, directional derivative, the gradient (N,) there and its largest entry."""

    step: float
    energy: float
    slope: float
    steepest: float
    gradient: Tensor

    @property
    def finite(self) -> bool:
        """No NaN and no infinity: the search may use it."""
        return math.isfinite(self.energy) and math.isfinite(self.slope)


class Turn(NamedTuple):
    """Where a clip goes on from in a new direction, and whether its memory did not help it to get there."""

    at: Trial
    in_vain: bool


def _descent(
    iterations: int, tolerance_grad: float, tolerance_change: float, unit: bool
) -> Generator[float | Turn, Trial | list[float], str]:
    """The way of one clip down: yields steps, and is sent what was found there; or a turn, and is sent of the direction
    the slope, the largest entry, the sum of the gradient's and how many pairs made it. Returns why it stopped."""
    energy, pairs, trial = math.inf, 1, (yield 0.0)
    for count in itertools.count():
        if trial is None or not trial.finite:
            return "non-finite"
        if trial.steepest <= tolerance_grad:
            return "gradient"
        in_vain = not trial.energy < energy - tolerance_change
        if in_vain and not pairs:  # down the gradient, without memory
            return "no decrease"
        if count >= iterations:
            return "steps"
        slope, size, total, pairs = yield Turn(trial, in_vain)
        energy, first = trial.energy, 1.0 if pairs or unit else min(1.0, 1.0 / total)
        trial = yield from _strong_wolfe(trial._replace(step=0.0, slope=slope), first, size)


def _strong_wolfe(start: Trial, step: float, size: float) -> Generator[float, Trial, Trial | None]:
    """Yields steps, is sent what was found there, returns the trial to go on from: ``start`` if none is lower, None
    where numbers stopped being finite.

    size: largest entry of the direction. Ends early where the bracket is below 1e-9 of the variables' unit, as torch's,
    or where all that is still to be won is below the energy's rounding.
    """

    def too_high(trial: Trial) -> bool:
        return trial.energy > start.energy + _C1 * trial.step * start.slope

    def flat(trial: Trial) -> bool:
        return abs(trial.slope) <= -_C2 * start.slope

    before, now = start, (yield from _finite(step, start))
    spent = 0
    while now is not None:
        if too_high(now) or (spent > 1 and now.energy >= before.energy) or (now.slope >= 0 and not flat(now)):
            break
        if flat(now):
            return now
        if (spent := spent + 1) > _LONGEST:
            break
        further = _cubic(before, now, now.step + 0.01 * (now.step - before.step), 10 * now.step)
        before, now = now, (yield from _finite(further, now))
    if now is None:
        return None
    low, high = (before, now) if before.energy <= now.energy else (now, before)
    stuck = False
    while spent < _LONGEST:
        left, right = sorted((low.step, high.step))
        gain = (right - left) * max(abs(low.slope), abs(high.slope))
        if (right - left) * size < 1e-9 or gain <= torch.finfo(start.gradient.dtype).eps * abs(low.energy):
            break
        step, margin = _cubic(low, high, left, right), 0.1 * (right - left)
        at_edge = min(right - step, step - left) < margin
        if at_edge and (stuck or not left < step < right):
            step, at_edge = (right - margin if right - step < step - left else left + margin), False
        stuck, spent = at_edge, spent + 1
        now = yield from _finite(step, low)
        if now is None:
            return None
        if too_high(now) or now.energy >= low.energy:
            low, high = (low, now) if low.energy <= now.energy else (now, low)
            continue
        if flat(now):
            return now
        low, high = now, (low if now.slope * (high.step - low.step) >= 0 else high)
    return low


def _finite(step: float, inside: Trial) -> Generator[float, Trial, Trial | None]:
    """The trial at a step, or nearer to the finite one ``inside`` until numbers are finite; None if they never are."""
    for _ in range(_RETREATS):
        trial = yield step
        if trial.finite:
            return trial
        step = inside.step + _SHRINK * (step - inside.step)
    return None


def _cubic(a: Trial, b: Trial, low: float, high: float) -> float:
    """Where the cubic through two trials and their slopes is lowest, within [low, high]."""
    a, b = (a, b) if a.step <= b.step else (b, a)
    if a.step == b.step:
        return (low + high) / 2
    d = a.slope + b.slope - 3 * (a.energy - b.energy) / (a.step - b.step)
    root = d * d - a.slope * b.slope
    if root < 0 or not (bottom := b.slope - a.slope + 2 * math.sqrt(root)):
        return (low + high) / 2
    return min(max(b.step - (b.step - a.step) * ((b.slope + math.sqrt(root) - d) / bottom), low), high)


class Memory:
    """The newest pairs (way, change of gradient) of every clip, in rings of slots (slots, B, N)."""

    def __init__(self, like: Tensor, size: int) -> None:
        self.size = size
        self.ways, self.changes = like.new_zeros(2, size, *like.shape)
        self.rho = like.new_zeros(size, len(like))
        self.pairs = torch.zeros(len(like), dtype=torch.long, device=like.device)  # pushed since last forgotten
        self.scale = like.new_ones(len(like))

    def forget(self, rows: Tensor) -> None:
        """Starts anew for clips (n,)."""
        self.pairs[rows], self.scale[rows] = 0, 1.0

    def push(self, rows: Tensor, way: Tensor, change: Tensor) -> None:
        """Remembers pairs (n, N) of clips (n,), those whose curvature is positive beyond rounding."""
        curvature = (way * change).sum(-1)
        good = curvature > torch.finfo(way.dtype).eps * way.norm(dim=-1) * change.norm(dim=-1)
        rows, way, change, curvature = rows[good], way[good], change[good], curvature[good]
        slot = self.pairs[rows] % self.size
        self.ways[slot, rows], self.changes[slot, rows], self.rho[slot, rows] = way, change, 1 / curvature
        self.scale[rows] = curvature / change.square().sum(-1)
        self.pairs[rows] += 1

    def direction(self, rows: Tensor, gradient: Tensor) -> Tensor:
        """Computes minus the approximate inverse Hessian times the gradients (n, N): the two-loop recursion."""
        pairs = self.pairs[rows]
        kept = pairs.clamp(max=self.size)
        ages = torch.arange(int(kept.max()), device=rows.device)[:, None]
        known = ages < kept  # (ages, n), 0 the newest
        slots = torch.where(known, (pairs - 1 - ages) % self.size, 0)
        rho = torch.where(known, self.rho[slots, rows], 0.0)[..., None].unbind(0) if len(ages) else ()
        if len(rows) == len(self.pairs) and bool((slots == slots[:, :1]).all()):  # in step: nothing to gather
            ways, changes = ([ring[slot] for slot in slots[:, 0].tolist()] for ring in (self.ways, self.changes))
        else:
            ways, changes = (ring[slots, rows].unbind(0) if len(ages) else () for ring in (self.ways, self.changes))
        q, alphas = -gradient, []
        for way, change, r in zip(ways, changes, rho, strict=True):
            alphas.append((way * q).sum(-1, keepdim=True).mul_(r))
            q.addcmul_(alphas[-1], change, value=-1)
        q *= self.scale[rows, None]
        for way, change, r in zip(reversed(ways), reversed(changes), reversed(rho), strict=True):
            q.addcmul_(alphas.pop().addcmul((change * q).sum(-1, keepdim=True), r, value=-1), way)
        return q


@dataclass(frozen=True, eq=False)
class BatchFit:
    """What a batched minimisation found.

    variables: the point of lowest energy that each clip saw. energy: (B,), inf where a clip never was finite.
    history: (closures, B) energies in order; a clip that has stopped stays at its lowest. seconds: wall time.
    reasons: per clip "gradient" or "no decrease" (converged), "steps", "closures", "non-finite" or "interrupted".
    """

    variables: dict[str, Tensor]
    energy: Tensor
    history: Tensor
    seconds: float
    reasons: list[str]

    @property
    def closures(self) -> int:
        """Evaluations of all energies and gradients that were paid for."""
        return len(self.history)


def begins(what: str, progress: bool | str) -> str | bool:
    """Says what begins, in a line on stderr where ``progress`` is "lines"; returns the name of its bars, or False."""
    if progress == "lines":
        print(f"{what} ...", file=sys.stderr, flush=True)
    return what if progress is True else False


def minimise_batch(
    energy: Callable[..., Tensor], variables: dict[str, Tensor], *, steps: int = 100, max_closures: int | None = None,
    inner: int = 20, memory: int = 100, tolerance_grad: float = 1e-7, tolerance_change: float | Tensor = 0.0,
    unit: bool = False, progress: bool | str = False,
) -> BatchFit:  # fmt: skip
    """Lowers B energies by moving the variables (B, ...).

    The tensors passed in are copied, never moved. Ctrl-C, a spent budget or numbers that are not finite end a
    clip's search at its best point.

    Args:
        energy: row by row (n,) from the variables (n, ...) of the clips that still run, by name, and their numbers.
        variables: the start, all (B, ...), of one type and device.
        steps, inner: at most steps x inner iterations per clip.
        max_closures: never evaluate more often; None: 5/4 of the iterations, as torch's L-BFGS.
        memory: pairs that L-BFGS remembers, per clip.
        tolerance_grad: a clip stops when the largest entry of its gradient is at most this.
        tolerance_change: an iteration that lowers the energy by no more than this counts as none; (B,) for one
            number per clip.
        unit: a first search begins with a whole step down the gradient, not one that moves nothing by more than 1.
        progress: show a bar with the mean energy and the number of clips that still run; or its name.

    Raises:
        NotConverged: no clip has a finite energy and gradient at the start.
        ShapeError: the energy is not (n,), or ``tolerance_change`` not (B,).
    """
    tolerance, each = torch.as_tensor(tolerance_change, dtype=torch.float64), (len(next(iter(variables.values()))),)
    if tolerance.ndim and tolerance.shape != each:
        raise ShapeError(f"tolerance_change: expected one number or {each}, got {tuple(tolerance.shape)}")
    clips = [_descent(steps * inner, tolerance_grad, float(most), unit) for most in tolerance.expand(each)]
    batch = _Batch(energy, variables, clips, max(min(memory, steps * inner), 1))
    budget = steps * inner * 5 // 4 if max_closures is None else max_closures
    began, rest = time.perf_counter(), "closures"
    bar = tqdm(total=budget, desc=progress if isinstance(progress, str) else None, disable=not progress, leave=False)
    try:
        while batch.steps and len(batch.history) < budget:
            batch.advance()
            bar.update()
            if progress:
                bar.set_postfix(energy=f"{batch.best_energy.mean():.4g}", clips=len(batch.steps))
    except KeyboardInterrupt:
        if not batch.history:
            raise
        rest = "interrupted"
    finally:
        bar.close()
    history = torch.stack(batch.history) if batch.history else batch.best_energy.new_zeros(0, len(batch.x))
    found = {name: value.clone() for name, value in batch.named(batch.best).items()}
    reasons = [batch.reasons.get(b, rest) for b in range(len(clips))]
    return BatchFit(found, batch.best_energy, history, time.perf_counter() - began, reasons)


class _Batch:
    """All clips: points x, directions d and gradients g as rows of (B, N) tensors; the step that each of those that
    still run asks for, and why the others stopped."""

    def __init__(self, energy, variables: dict[str, Tensor], clips: list[Generator], memory: int) -> None:
        self.energy, self.shapes = energy, {name: value.shape[1:] for name, value in variables.items()}
        self.x = torch.cat([value.detach().reshape(len(value), -1) for value in variables.values()], dim=1)
        self.d, self.g = torch.zeros_like(self.x), torch.zeros_like(self.x)
        self.best, self.best_energy = self.x.clone(), self.x.new_full((len(self.x),), math.inf)
        self.memory, self.history = Memory(self.x, memory), []
        self.clips, self.steps, self.reasons = clips, {}, {}
        self.answer(dict.fromkeys(range(len(clips))))

    def named(self, flat: Tensor) -> dict[str, Tensor]:
        """The variables by name, from rows (n, N)."""
        parts = flat.split([shape.numel() for shape in self.shapes.values()], dim=1)
        return {n: part.reshape(-1, *shape) for (n, shape), part in zip(self.shapes.items(), parts, strict=True)}

    def answer(self, answers: dict[int, object]) -> dict[int, Turn]:
        """Sends clips what they asked for, and returns the turns that some of them make then."""
        turns = {}
        for b, answer in answers.items():
            try:
                asked = self.clips[b].send(answer)
                (turns if isinstance(asked, Turn) else self.steps)[b] = asked
            except StopIteration as end:
                self.reasons[b] = end.value
                del self.steps[b]
        return turns

    @torch.no_grad()
    def advance(self) -> None:
        """One closure, and what every clip that still runs makes of it."""
        rows, steps = torch.tensor(list(self.steps), device=self.x.device), self.x.new_tensor(list(self.steps.values()))
        at = (self.x[rows] + steps[:, None] * self.d[rows]).requires_grad_()
        with torch.enable_grad():
            value = self.energy(self.named(at), rows)
            check_shape(value, rows.shape, "energy")
            (gradient,) = torch.autograd.grad(value.sum(), at)
        value = value.detach().to(at.dtype)
        usable = value.isfinite() & gradient.isfinite().all(-1)
        if not self.history and not usable.any():
            raise NotConverged("no clip has a finite energy and gradient at the start")
        self.history.append(self.best_energy.index_copy(0, rows, value))
        better = usable & (value < self.best_energy[rows])
        self.best_energy[rows[better]], self.best[rows[better]] = value[better], at[better]
        slope, steepest = (gradient * self.d[rows]).sum(-1), gradient.abs().amax(-1)
        seen = torch.stack((torch.where(usable, value, math.nan), slope, steepest), -1).tolist()
        found = zip(self.steps.items(), seen, gradient, strict=True)
        if turns := self.answer({b: Trial(step, *numbers, row) for (b, step), numbers, row in found}):
            self.turn(turns)

    def turn(self, turns: dict[int, Turn]) -> None:
        """Move the clips whose searches have ended, and tell them of their new directions."""
        rows = torch.tensor(list(turns), device=self.x.device)
        gradient = torch.stack([turn.at.gradient for turn in turns.values()])
        way = self.x.new_tensor([turn.at.step for turn in turns.values()])[:, None] * self.d[rows]
        self.memory.push(rows, way, gradient - self.g[rows])
        self.memory.forget(rows[[turn.in_vain for turn in turns.values()]])
        self.x[rows] += way
        self.g[rows] = gradient
        direction = self.memory.direction(rows, gradient)
        uphill = ~((direction * gradient).sum(-1) < 0)  # by rounding only
        self.memory.forget(rows[uphill])
        direction[uphill] = -gradient[uphill]
        self.d[rows], slope = direction, (direction * gradient).sum(-1)
        numbers = torch.stack((slope, direction.abs().amax(-1), gradient.abs().sum(-1), self.memory.pairs[rows]), -1)
        self.answer(dict(zip(turns, numbers.tolist(), strict=True)))
