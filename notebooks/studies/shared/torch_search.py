"""Minimise an energy over named tensors: L-BFGS or Adam, a budget in evaluations, and the best point seen."""

import math
from collections.abc import Callable, Mapping
from contextlib import suppress

import torch
from torch import Tensor

from motionlab.errors import NotConverged


class _Stop(Exception):
    """Leaves the optimiser from inside a closure."""


def minimise(
    energy: Callable[[dict[str, Tensor]], Tensor], variables: Mapping[str, Tensor], *, method: str = "lbfgs",
    steps: int = 100, max_closures: float = math.inf, lr: float = 1.0, inner: int = 20, memory: int = 100,
    tolerance_grad: float = 1e-7,
) -> tuple[dict[str, Tensor], list[float]]:  # fmt: skip
    """Lowers an energy, a scalar from all variables by name, by moving those that require gradients: the point with the
    lowest energy that was evaluated, and the energies of all closures (evaluations of energy and gradient), in order.

    The tensors passed in are copied, never moved. A spent budget (max_closures) or a number that is not finite ends the
    search; NaN is never returned. method: "lbfgs" (strong Wolfe line search) or "adam". steps: outer ones, each up to
    ``inner`` iterations (5/4 as many closures) of L-BFGS, which remembers ``memory`` pairs, or one of Adam.
    tolerance_grad: of the largest entry of the gradient, where the search stops.

    Raises:
        NotConverged: the energy or its gradient is not finite at the start.
    """
    point = {name: value.detach().clone(memory_format=torch.contiguous_format) for name, value in variables.items()}
    moving = [point[name].requires_grad_() for name, value in variables.items() if value.requires_grad]
    how = {"max_iter": inner, "history_size": memory, "line_search_fn": "strong_wolfe"}
    how |= {"tolerance_grad": tolerance_grad, "tolerance_change": 0.0}  # torch stops at 1e-9 of any unit
    optimiser = torch.optim.LBFGS(moving, lr=lr, **how) if method == "lbfgs" else torch.optim.Adam(moving, lr=lr)
    lowest, best, history = math.inf, [value.detach().clone() for value in moving], []

    def closure() -> Tensor:
        nonlocal lowest, best
        if len(history) >= max_closures:
            raise _Stop
        optimiser.zero_grad()
        loss = energy(point)
        loss.backward()
        history.append(loss.item())
        steepest = max((x.grad.abs().max().item() if x.grad is not None else 0.0) for x in moving)
        if not math.isfinite(history[-1]) or not math.isfinite(steepest):
            raise _Stop
        if history[-1] < lowest:
            lowest, best = history[-1], [value.detach().clone() for value in moving]
        if steepest <= tolerance_grad:
            raise _Stop
        return loss

    with suppress(_Stop):
        for _ in range(steps):
            before = lowest
            optimiser.step(closure)
            if method == "lbfgs" and lowest >= before:
                break
    if history and lowest == math.inf:
        raise NotConverged("the energy or its gradient is not finite at the start")
    with torch.no_grad():
        for value, kept in zip(moving, best, strict=True):
            value.copy_(kept)
    return {name: value.detach() for name, value in point.items()}, history
