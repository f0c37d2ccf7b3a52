"""Minimises B independent energies at once by L-BFGS: memory, direction and line search belong to each clip alone.

One evaluation (closure) serves all clips, each of which is a state machine: while one still searches along its line,
another is iterations ahead. What a clip does is what ``torch.optim.LBFGS`` with strong Wolfe would do to it alone.

Source: Nocedal and Wright, Numerical Optimization, algorithms 7.4, 3.5 and 3.6; constants of ``torch.optim.LBFGS``.
Differs: torch evaluates the start of each outer step once more and cuts its last line search short; here neither. A
trial that is not finite is taken back towards the last finite one. A search without a lower energy forgets its memory
and tries steepest descent once. torch ignores pairs with a curvature below 1e-10 in the energy's own unit.
"""

import math
import sys
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab.errors import NotConverged, ShapeError

_C1, _C2 = 1e-4, 0.9  # sufficient decrease, curvature
_LONGEST, _SHRINK, _RETREATS = 25, 0.1, 8  # evaluations of a line search; what follows a trial that is not finite


class Trial(NamedTuple):
    """A point of a line search: step, energy, directional derivative, gradient (N,) there."""

    step: float
    energy: float
    slope: float
    gradient: Tensor

    @property
    def finite(self) -> bool:
        """No NaN and no infinity: the search may use it."""
        return math.isfinite(self.energy) and math.isfinite(self.slope)


def _strong_wolfe(start: Trial, step: float, size: float, eps: float) -> Generator[float, Trial, Trial]:
    """Yields steps, is sent what was found there, returns the trial to go on from: ``start`` if none is lower.

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
        return before
    low, high = (before, now) if before.energy <= now.energy else (now, before)
    stuck = False
    while spent < _LONGEST:
        left, right = sorted((low.step, high.step))
        gain = (right - left) * max(abs(low.slope), abs(high.slope))
        if (right - left) * size < 1e-9 or gain <= eps * abs(low.energy):
            break
        step, margin = _cubic(low, high, left, right), 0.1 * (right - left)
        at_edge = min(right - step, step - left) < margin
        if at_edge and (stuck or not left < step < right):
            step, at_edge = (right - margin if right - step < step - left else left + margin), False
        stuck, spent = at_edge, spent + 1
        now = yield from _finite(step, low)
        if now is None:
            break
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
    machine = _Machine(energy, variables, memory, steps * inner, tolerance_grad, unit)
    tolerance, each = torch.as_tensor(tolerance_change, dtype=torch.float64), (len(machine.clips),)
    if tolerance.ndim and tolerance.shape != each:
        raise ShapeError(f"tolerance_change: expected one number or {each}, got {tuple(tolerance.shape)}")
    machine.tolerance_change = tolerance.expand(each).tolist()
    budget = steps * inner * 5 // 4 if max_closures is None else max_closures
    began, rest = time.perf_counter(), "closures"
    bar = tqdm(total=budget, desc=progress if isinstance(progress, str) else None, disable=not progress, leave=False)
    try:
        while machine.running() and len(machine.history) < budget:
            machine.advance()
            bar.update()
            if progress:
                bar.set_postfix(energy=f"{machine.best_energy.mean():.4g}", clips=len(machine.running()))
    except KeyboardInterrupt:
        if not machine.history:
            raise
        rest = "interrupted"
    finally:
        bar.close()
    history = torch.stack(machine.history) if machine.history else machine.best_energy.new_zeros(0, len(machine.x))
    found = {name: value.clone() for name, value in machine.named(machine.best).items()}
    reasons = [clip.reason or rest for clip in machine.clips]
    return BatchFit(found, machine.best_energy, history, time.perf_counter() - began, reasons)


@dataclass
class _Clip:
    """Where one clip stands: its running search, the step it asks for, and what the search began with."""

    search: Generator[float, Trial, Trial] | None = None
    step: float = 0.0
    energy: float = math.inf
    steepest: bool = False  # the search goes down the gradient, without memory
    iterations: int = 0
    reason: str | None = None


class _Machine:
    """All clips: points x, directions d and gradients g as rows of (B, N) tensors; one state machine each."""

    tolerance_change: list[float]  # of each clip

    def __init__(
        self, energy, variables: dict[str, Tensor], memory: int, iterations: int, tolerance_grad, unit
    ) -> None:
        self.iterations, self.tolerance_grad, self.unit = iterations, tolerance_grad, unit
        self.energy, self.shapes = energy, {name: value.shape[1:] for name, value in variables.items()}
        self.x = torch.cat([value.detach().reshape(len(value), -1) for value in variables.values()], dim=1)
        self.d, self.g = torch.zeros_like(self.x), torch.zeros_like(self.x)
        self.best, self.best_energy = self.x.clone(), self.x.new_full((len(self.x),), math.inf)
        self.clips = [_Clip() for _ in self.x]
        self.memory = Memory(self.x, max(min(memory, iterations), 1))
        self.history: list[Tensor] = []

    def running(self) -> list[int]:
        return [b for b, clip in enumerate(self.clips) if clip.reason is None]

    def named(self, flat: Tensor) -> dict[str, Tensor]:
        """The variables by name, from rows (n, N)."""
        parts = flat.split([shape.numel() for shape in self.shapes.values()], dim=1)
        return {n: part.reshape(-1, *shape) for (n, shape), part in zip(self.shapes.items(), parts, strict=True)}

    def evaluate(self, at: Tensor, live: list[int]) -> tuple[Tensor, Tensor]:
        """Energies (B,) and gradients (B, N) at points (B, N), of those that live anew."""
        rows = torch.tensor(live, device=at.device)
        leaf = at[rows].requires_grad_()
        with torch.enable_grad():
            value = self.energy(self.named(leaf), rows)
            if value.shape != leaf.shape[:1]:
                raise ShapeError(f"energy: expected shape ({len(leaf)},), got {tuple(value.shape)}")
            (gradient,) = torch.autograd.grad(value.sum(), leaf)
        value = value.detach().to(at.dtype)
        return self.best_energy.index_copy(0, rows, value), torch.zeros_like(self.g).index_copy(0, rows, gradient)

    @torch.no_grad()
    def advance(self) -> None:
        """One closure, and what every clip makes of it."""
        live = self.running()
        at = self.x + self.x.new_tensor([clip.step for clip in self.clips])[:, None] * self.d
        value, gradient = self.evaluate(at, live)
        usable = value.isfinite() & gradient.isfinite().all(-1)
        if not self.history and not usable.any():
            raise NotConverged("no clip has a finite energy and gradient at the start")
        self.history.append(value)
        better = usable & (value < self.best_energy)
        self.best_energy = torch.where(better, value, self.best_energy)
        self.best = torch.where(better[:, None], at, self.best)
        seen = torch.stack((torch.where(usable, value, math.nan), (gradient * self.d).sum(-1)), -1).tolist()
        ended: dict[int, Trial] = {}
        for b in live:
            clip, trial = self.clips[b], Trial(self.clips[b].step, *seen[b], gradient[b])
            try:
                if clip.search is None:
                    ended[b] = trial
                else:
                    clip.step = clip.search.send(trial)
            except StopIteration as end:
                ended[b] = end.value
            if b in ended and not trial.finite:
                clip.reason = "non-finite"
        if ended:
            self.turn(ended)

    def turn(self, ended: dict[int, Trial]) -> None:
        """Move the clips whose searches have ended, and start their next searches or freeze them."""
        trials, clips = list(ended.values()), [self.clips[b] for b in ended]
        rows = torch.tensor(list(ended), device=self.x.device)
        way = self.x.new_tensor([trial.step for trial in trials])[:, None] * self.d[rows]
        gradient = torch.stack([trial.gradient for trial in trials])
        self.memory.push(rows, way, gradient - self.g[rows])
        self.x[rows] += way
        self.g[rows] = gradient
        for b, clip, trial, steepest in zip(ended, clips, trials, gradient.abs().amax(-1).tolist(), strict=True):
            in_vain = clip.search is not None and not trial.energy < clip.energy - self.tolerance_change[b]
            clip.iterations += clip.search is not None
            if clip.reason is None and steepest <= self.tolerance_grad:
                clip.reason = "gradient"
            elif clip.reason is None and in_vain and clip.steepest:
                clip.reason = "no decrease"
            elif clip.reason is None and clip.iterations >= self.iterations:
                clip.reason = "steps"
            elif in_vain:  # once more, down the gradient
                self.memory.forget(torch.tensor([b], device=self.x.device))
        direction = self.memory.direction(rows, gradient)
        slope = (direction * gradient).sum(-1)
        uphill = ~(slope < 0)  # by rounding only
        self.memory.forget(rows[uphill])
        direction = torch.where(uphill[:, None], -gradient, direction)
        slope = torch.where(uphill, -gradient.square().sum(-1), slope)
        numbers = torch.stack((slope, direction.abs().amax(-1), gradient.abs().sum(-1), self.memory.pairs[rows]), -1)
        eps = torch.finfo(self.x.dtype).eps
        for k, (clip, trial, found) in enumerate(zip(clips, trials, numbers.tolist(), strict=True)):
            slant, size, total, pairs = found
            if clip.reason:
                self.x[rows[k]], direction[k], clip.step = self.best[rows[k]], 0.0, 0.0
                continue
            clip.energy, clip.steepest = trial.energy, pairs == 0
            first = 1.0 if pairs or self.unit else min(1.0, 1.0 / total)
            clip.search = _strong_wolfe(Trial(0.0, trial.energy, slant, trial.gradient), first, size, eps)
            clip.step = next(clip.search)
        self.d[rows] = direction
