"""A roll-out of given latents by Newton's method on the whole trajectory instead of one step after the other.

With x_0 and z given, the trajectory is the root of c_t(x) = f(x_{t-1}, z_t) - x_t, t = 1..T. Newton's method linearises
all T steps at once and solves a linear recursion, which is a scan:

    d_t = A_t d_{t-1} + c_t,    A_t = df/dx (x_{t-1}, z_t),    d_0 = 0        (DEER)

After k iterations the first k states are exact, so that T iterations always suffice and only far fewer are worth it.
Where steps amplify, d grows with their product, and the damped form keeps it small:

    d = argmin sum_t |d_t - A_t d_{t-1} - c_t|^2 + lambda |d_t|^2              (ELK)

States are in their own heading frames; a change is the 207 numbers xi of ``shooting.derivatives``.

Source: Lim et al. 2024 (DEER); Gonzalez et al. 2024 (ELK).
Differs: ELK's Kalman smoother is the block-tridiagonal solve of the same least squares; lambda follows Levenberg.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.humor import state
from motionlab.humor.cvae import Cvae
from motionlab.humor.shooting import derivatives
from motionlab.humor.shooting.derivatives import XI
from motionlab.humor.state import ADDED
from motionlab.humor.transition import DecoderLayers, Stepper


@dataclass(frozen=True, eq=False)
class Newton:
    """misses (n + 1,): largest |c_t| before the first and after every iteration; nan once not finite. errors (n + 1,):
    the same of the joints' distance to the exact roll-out, metres. seconds (n + 1,): of processor time, errors not
    counted. states (T, 339)."""

    misses: Tensor
    errors: Tensor
    seconds: Tensor
    states: Tensor

    def until(self, limit: float) -> int | None:
        """Iterations until all joints are within ``limit`` metres of the exact roll-out for good; None: never."""
        good = (self.errors <= limit).tolist()
        last_bad = max((k for k, fine in enumerate(good) if not fine), default=-1)
        return None if last_bad == len(good) - 1 else last_bad + 1


def lean(states: Tensor) -> Tensor:
    """World states (..., 339), each in its own heading frame."""
    return state.localise(states, state.heading(states))


def stepped(model: Cvae, x: Tensor, z: Tensor) -> Tensor:
    """f: the next states (N, 339) in their own frames, of N states and latents (N, 48), all at once."""
    decoder = DecoderLayers.of(model)
    return Stepper(decoder)(x, decoder.shares(z)).moved


def chained(model: Cvae, first: Tensor, z: Tensor) -> Tensor:
    """The plain roll-out: states (T, 339) after a first (339,), by latents (T, 48), one after the other."""
    decoder = DecoderLayers.of(model)
    step, shares, x, found = Stepper(decoder), decoder.shares(z[:, None]), first[None], []
    for now in zip(*(share.unbind(0) for share in shares), strict=True):
        x = step(x, list(now)).moved
        found.append(x)
    return torch.cat(found)


def missing(to: Tensor, x: Tensor) -> Tensor:
    """The change (N, 207) that takes states x (N, 339) to others, first order in the rotations' angles."""
    m, aim = (each[:, ADDED:].unflatten(1, (22, 3, 3)) for each in (x, to))
    omega = rotation.log(aim.mT @ m)  # exp(omega) R = R', M = R^T
    return torch.cat((to[:, :ADDED] - x[:, :ADDED], omega.flatten(1)), 1)


def changed(x: Tensor, d: Tensor) -> Tensor:
    """States (N, 339) after changes (N, 207)."""
    m = x[:, ADDED:].unflatten(1, (22, 3, 3)) @ rotation.exp(d[:, ADDED:].unflatten(1, (22, 3))).mT
    return torch.cat((x[:, :ADDED] + d[:, :ADDED], m.flatten(1)), 1)


def recursed(a: Tensor, c: Tensor) -> Tensor:
    """d_t = A_t d_{t-1} + c_t (T, n) from d_0 = 0, one step after the other; a (T, n, n)."""
    d, found = torch.zeros_like(c[0]), []
    for step, miss in zip(a, c, strict=True):
        d = torch.addmv(miss, step, d)
        found.append(d)
    return torch.stack(found)


def damped(a: Tensor, c: Tensor, weight: float) -> Tensor:
    """The least-squares form (T, n) with weight lambda, by block-tridiagonal elimination."""
    eye = torch.eye(c.shape[1], dtype=a.dtype, device=a.device)
    later = torch.cat((a[1:], torch.zeros_like(a[:1])))
    diagonal = (1 + weight) * eye + later.mT @ later
    right = c - (later.mT @ torch.cat((c[1:], torch.zeros_like(c[:1])))[..., None])[..., 0]
    factors, half = [], []
    block, now = diagonal[0], right[0]
    for t in range(len(c)):
        factors.append(torch.linalg.cholesky(block))
        half.append(now)
        if t + 1 < len(c):  # off-diagonal block (t + 1, t) is -A_{t+1}
            both = torch.cholesky_solve(torch.cat((a[t + 1].mT, now[:, None]), 1), factors[-1])
            block = diagonal[t + 1] - a[t + 1] @ both[:, :-1]
            now = right[t + 1] + a[t + 1] @ both[:, -1]
    d = [torch.cholesky_solve(half[-1][:, None], factors[-1])[:, 0]]
    for t in reversed(range(len(c) - 1)):
        d.append(torch.cholesky_solve((half[t] + a[t + 1].mT @ d[-1])[:, None], factors[t])[:, 0])
    return torch.stack(d[::-1])


@torch.no_grad()
def newton(
    model: Cvae,
    first: Tensor,
    z: Tensor,
    guess: Tensor,
    *,
    iterations: int,
    damping: float | None = None,
    solve: Callable[[Tensor, Tensor], Tensor] = recursed,
) -> Newton:
    """Newton's method from a guessed trajectory (T, 339), heading frames; first (339,) and z (T, 48) are given.

    damping: lambda of the first damped iteration (ELK); None: the plain form (DEER).
    """
    decoder, truth = DecoderLayers.of(model), chained(model, first, z)
    x, weight, spent, before = guess, damping, 0.0, None
    misses, errors, seconds = [], [], []
    while True:
        began = time.process_time()
        past = torch.cat((first[None], x[:-1]))
        miss = missing(stepped(model, past, z), x)
        merit = float(miss.square().sum())
        if damping is not None and before is not None and not merit < before[0]:  # reject, and try a smaller step
            weight, (_, x, past, miss, a) = 10 * weight, before
        else:
            spent += time.process_time() - began
            began = time.process_time()
            a = (
                derivatives.transition_slopes(decoder, past, z).of_change[:, :XI, :XI].contiguous()
                if miss.isfinite().all()
                else None
            )
            weight = None if weight is None else weight / 3
        misses.append(float(miss.abs().max()))
        errors.append(float((x[:, 9:75] - truth[:, 9:75]).unflatten(1, (22, 3)).norm(dim=-1).max()))
        if len(misses) > iterations or a is None:
            seconds.append(spent)
            break
        seconds.append(spent)
        before = (float(miss.square().sum()), x, past, miss, a)
        x = changed(x, solve(a, miss) if weight is None else damped(a, miss, weight))
        spent += time.process_time() - began
    return Newton(*(torch.tensor(each, dtype=torch.float64) for each in (misses, errors, seconds)), x)
