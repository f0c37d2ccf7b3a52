"""The pieces of L-BFGS: a line search that asks for one evaluation at a time, and the memory of many clips.

Source: Nocedal and Wright, Numerical Optimization, algorithms 7.4, 3.5 and 3.6; constants of ``torch.optim.LBFGS``.
Differs: torch ignores pairs with a curvature below 1e-10 in the energy's own unit, and so crawls where energies are
small.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

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


def strong_wolfe(start: Trial, step: float, size: float, eps: float) -> Generator[float, Trial, Trial]:
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
    if root < 0:
        return (low + high) / 2
    bottom = b.slope - a.slope + 2 * math.sqrt(root)
    if bottom == 0:
        return (low + high) / 2
    return min(max(b.step - (b.step - a.step) * ((b.slope + math.sqrt(root) - d) / bottom), low), high)


class Memory:
    """The newest pairs (way, change of gradient) of every clip, in rings of slots (slots, B, N)."""

    def __init__(self, like: Tensor, size: int) -> None:
        self.size = max(size, 1)
        self.ways = self.changes = like.new_zeros(0, *like.shape)
        self.rho = like.new_zeros(0, len(like))
        self.pairs = torch.zeros(len(like), dtype=torch.long, device=like.device)  # pushed since last forgotten
        self.scale = like.new_ones(len(like))

    def forget(self, rows: Tensor) -> None:
        """Start anew for clips (n,)."""
        self.pairs[rows], self.scale[rows] = 0, 1.0

    def push(self, rows: Tensor, way: Tensor, change: Tensor) -> None:
        """Remember pairs (n, N) of clips (n,), those whose curvature is positive beyond rounding."""
        curvature = (way * change).sum(-1)
        good = curvature > torch.finfo(way.dtype).eps * way.norm(dim=-1) * change.norm(dim=-1)
        rows, way, change, curvature = rows[good], way[good], change[good], curvature[good]
        if not len(rows):
            return
        slot = self.pairs[rows] % self.size
        while len(self.rho) <= int(slot.max()):
            more = min(max(len(self.rho), 8), self.size - len(self.rho))
            grown = (F.pad(x, (0, 0) * (x.ndim - 1) + (0, more)) for x in (self.ways, self.changes, self.rho))
            self.ways, self.changes, self.rho = grown
        self.ways[slot, rows], self.changes[slot, rows], self.rho[slot, rows] = way, change, 1 / curvature
        self.scale[rows] = curvature / change.square().sum(-1)
        self.pairs[rows] += 1

    def direction(self, rows: Tensor, gradient: Tensor) -> Tensor:
        """Minus the approximate inverse Hessian times the gradients (n, N): the two-loop recursion."""
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
