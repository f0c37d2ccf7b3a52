"""Minimise an energy over named tensors: L-BFGS or Adam, a budget in evaluations, and the best point seen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab.errors import NotConverged, ShapeError

#: The inner settings of every stage of HuMoR's TestOps; ``steps`` are 30, 70 and 70 there.
#: Source: HuMoR (Rempe et al. 2021), official fitting code: torch L-BFGS, strong Wolfe, default tolerances.
HUMOR = {"method": "lbfgs", "lr": 1.0, "inner": 20, "memory": 100, "tolerance_change": 1e-9, "patience": None}


@dataclass(frozen=True, eq=False)
class FitResult:
    """What a minimisation found.

    variables: the point with the lowest energy that was evaluated, not merely the last one. energy: its
    energy. history: energy per closure (one evaluation of energy and gradient), in order.
    seconds: wall time. reason: why it stopped: "gradient" (below tolerance), "no decrease", "steps",
    "closures" (budget spent), "non-finite" or "interrupted".
    """

    variables: dict[str, Tensor]
    energy: float
    history: list[float]
    seconds: float
    reason: str

    @property
    def closures(self) -> int:
        """Evaluations of energy and gradient that were paid for."""
        return len(self.history)

    @property
    def converged(self) -> bool:
        """True where a tolerance stopped it rather than a budget, a number or a person."""
        return self.reason in ("gradient", "no decrease")


class _Stop(Exception):
    """Leaves the optimiser from inside a closure."""


def minimise(
    energy: Callable[[dict[str, Tensor]], Tensor],
    variables: dict[str, Tensor],
    *,
    method: str = "lbfgs",
    steps: int = 100,
    max_closures: int | None = None,
    lr: float = 1.0,
    inner: int = 20,
    memory: int = 100,
    tolerance_grad: float = 1e-7,
    tolerance_change: float = 0.0,
    patience: int | None = 1,
    progress: bool = False,
) -> FitResult:
    """Lower an energy by moving the variables that require gradients; the others are constants.

    The tensors passed in are copied, never moved. A Ctrl-C, a spent budget or a number that is not finite
    ends the search and returns the best point so far with the reason; NaN is never returned.

    Args:
        energy: a scalar from all variables, by name.
        variables: the start; freeze one by leaving its ``requires_grad`` False.
        method: "lbfgs" (strong Wolfe line search) or "adam".
        steps: outer steps; each is up to ``inner`` iterations (5/4 as many closures) of L-BFGS, or one of Adam.
        max_closures: never evaluate more often than this: equal budgets for methods that differ.
        lr: step length.
        memory: pairs that L-BFGS remembers.
        tolerance_grad: stop when the largest entry of the gradient is at most this.
        tolerance_change: torch's L-BFGS ends an outer step when energy or point change by less. Its default,
            1e-9 in the energy's own unit, stops an energy that is small by its scale before its minimum.
        patience: stop L-BFGS after so many outer steps in a row without a lower energy; None: never.
        progress: show a bar with the energy.

    Raises:
        NotConverged: the energy or its gradient is not finite at the start, so that there is no best point.
        ShapeError: the energy is not a scalar.
        ValueError: an unknown method, or no variable requires gradients.
    Source: torch.optim; thesis 3.1.2 (TestOps). ``HUMOR`` holds the settings of the official code.
    """
    point = {name: value.detach().clone(memory_format=torch.contiguous_format) for name, value in variables.items()}
    moving = [point[name].requires_grad_() for name, value in variables.items() if value.requires_grad]
    if not moving:
        raise ValueError(f"nothing to optimise: none of {', '.join(variables) or 'no variables'} requires gradients")
    optimiser = _optimiser(method, moving, lr, inner, memory, tolerance_grad, tolerance_change)

    history: list[float] = []
    best = {"energy": math.inf, "values": [value.detach().clone() for value in moving]}
    began = time.perf_counter()

    def closure() -> Tensor:
        if max_closures is not None and len(history) >= max_closures:
            raise _Stop("closures")
        optimiser.zero_grad()
        loss = energy(point)
        if loss.numel() != 1:
            raise ShapeError(f"energy: expected a scalar, got shape {tuple(loss.shape)}")
        loss.backward()
        history.append(loss.item())
        steepest = max((x.grad.abs().max().item() if x.grad is not None else 0.0) for x in moving)
        if not math.isfinite(history[-1]) or not math.isfinite(steepest):
            raise _Stop("non-finite")
        if history[-1] < best["energy"]:
            best.update(energy=history[-1], values=[value.detach().clone() for value in moving])
        if steepest <= tolerance_grad:
            raise _Stop("gradient")
        return loss

    reason, idle = "steps", 0
    bar = tqdm(range(steps), disable=not progress, leave=False)
    try:
        for _ in bar:
            before = best["energy"]
            optimiser.step(closure)
            bar.set_postfix(energy=f"{best['energy']:.4g}")
            idle = 0 if best["energy"] < before else idle + 1
            if method == "lbfgs" and patience is not None and idle >= patience:
                reason = "no decrease"
                break
    except _Stop as stop:
        reason = str(stop)
    except KeyboardInterrupt:
        if not math.isfinite(best["energy"]):
            raise
        reason = "interrupted"
    finally:
        bar.close()
    if reason == "non-finite" and not math.isfinite(best["energy"]):
        raise NotConverged("the energy or its gradient is not finite at the start", history)

    with torch.no_grad():
        for value, kept in zip(moving, best["values"], strict=True):
            value.copy_(kept)
    found = {name: value.detach() for name, value in point.items()}
    return FitResult(found, best["energy"], history, time.perf_counter() - began, reason)


def _optimiser(
    method: str, moving: list[Tensor], lr: float, inner: int, memory: int, tolerance_grad: float, change: float
) -> torch.optim.Optimizer:
    if method == "adam":
        return torch.optim.Adam(moving, lr=lr)
    if method != "lbfgs":
        raise ValueError(f"method: expected 'lbfgs' or 'adam', got {method!r}")
    return torch.optim.LBFGS(
        moving,
        lr=lr,
        max_iter=inner,
        history_size=memory,
        tolerance_grad=tolerance_grad,
        tolerance_change=change,
        line_search_fn="strong_wolfe",
    )
