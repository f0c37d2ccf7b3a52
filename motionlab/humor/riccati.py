"""The Gauss-Newton matrix of a whole roll-out, factorised frame by frame from its end.

With y_t a small change of frame t (and of what all frames share), y_{t+1} = A_t y_t + B_t z_t, and an energy
1/2 sum_t |R_t y_t|^2 + |N_t (y_t, z_t)|^2, the least that frames t.. can cost is 1/2 y_t^T P_t y_t,

    Q = [A B]^T P_{t+1} [A B] + N^T N,   L L^T = Q_zz,   K_t = -Q_zz^-1 Q_zy,   P_t = Q_yy + Q_yz K_t + R_t^T R_t,

and in nu, z_t = K_t y_t + L^-T nu_t, the energy is 1/2 |nu|^2: the coordinates in which Newton's step is -gradient.
With a gradient, of changes g_t and of controls h_t, the least also has a slope p_t, and what is best an offset k_t:

    q = [A B]^T p_{t+1} + (0, h_t),   k_t = -Q_zz^-1 q_z,   p_t = q_y + Q_yz k_t + g_t.

Source: the discrete Riccati equation, e.g. Rao, Wright and Rawlings 1998.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Sweep(NamedTuple):
    """gains K (B, T - 1, Z, n), shapers L^-T (B, T - 1, Z, Z) and what the first change costs, P_0 (B, n, n)."""

    gains: Tensor
    shapers: Tensor
    first: Tensor


def sweep(of_frame: Tensor, a: Tensor, b: Tensor, of_pair: Tensor, ridge: float = 1e-6) -> Sweep:
    """Backwards through T frames.

    of_frame (B, T, n, n): R^T R. a (B, T - 1, n, n), b (B, T - 1, n, Z). of_pair (B, T - 1, n + Z, n + Z): N^T N.
    ridge: added to the diagonal of Q_zz.
    """
    n, size = b.shape[-2:]
    both = torch.cat((a, b), -1)
    cost = of_frame[:, -1]
    gains, shapers = [], []
    eye = torch.eye(size, dtype=b.dtype, device=b.device)
    for t in reversed(range(b.shape[1])):
        step = both[:, t]
        q = step.mT @ (cost @ step) + of_pair[:, t]
        factor = factorised(q[:, n:, n:] + ridge * eye)
        back = torch.linalg.solve_triangular(
            factor, torch.cat((q[:, n:, :n], eye.expand(len(q), -1, -1)), -1), upper=False
        )
        half, inverse = back.split((n, size), -1)  # L^-1 Q_zy, L^-1
        gains.append(-inverse.mT @ half)
        shapers.append(inverse.mT)
        cost = q[:, :n, :n] - half.mT @ half + of_frame[:, t]
        cost = (cost + cost.mT) / 2
    return Sweep(torch.stack(gains[::-1], 1), torch.stack(shapers[::-1], 1), cost)


class Affine(NamedTuple):
    """gains K (B, T - 1, Z, n), offsets k (B, T - 1, Z), and of the first change P_0 (B, n, n) and p_0 (B, n)."""

    gains: Tensor
    offsets: Tensor
    first: Tensor
    slope: Tensor

    def walked(self, a: Tensor, b: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Changes (B, T, n) and controls (B, T - 1, Z) that are best after a first change (B, n)."""
        changes, controls = [y], []
        for t in range(a.shape[1]):
            controls.append(torch.baddbmm(self.offsets[:, t, :, None], self.gains[:, t], y[..., None])[..., 0])
            y = (a[:, t] @ y[..., None] + b[:, t] @ controls[-1][..., None])[..., 0]
            changes.append(y)
        return torch.stack(changes, 1), torch.stack(controls, 1)


def affine_sweep(
    of_frame: Tensor, a: Tensor, b: Tensor, rows: Tensor, of_control: Tensor, slope: Tensor, control_slope: Tensor
) -> Affine:
    """:func:`sweep` of an energy with a gradient; what is needed to walk along its least.

    of_frame, a, b: as there. rows (B, T - 1, k, n + Z): N. of_control (B, T - 1, Z, Z): added to Q_zz.
    slope g (B, T, n), control_slope h (B, T - 1, Z).
    """
    n = b.shape[-2]
    both = torch.cat((a, b), -1)
    cost, pull = of_frame[:, -1], slope[:, -1]
    gains, offsets = [], []
    for t in reversed(range(b.shape[1])):
        step, row = both[:, t], rows[:, t]
        q = torch.baddbmm(row.mT @ row, step.mT, cost @ step)
        toward = (step.mT @ pull[..., None])[..., 0]
        factor = factorised(q[:, n:, n:] + of_control[:, t])
        aside = torch.cat((q[:, n:, :n], (toward[:, n:] + control_slope[:, t])[..., None]), -1)
        half = torch.linalg.solve_triangular(factor, aside, upper=False)  # L^-1 (Q_zy, q_z)
        best = -torch.linalg.solve_triangular(factor.mT, half, upper=True)
        gains.append(best[..., :n]), offsets.append(best[..., n])
        least = half[..., :n].mT @ half
        pull = toward[:, :n] - least[..., n] + slope[:, t]
        cost = q[:, :n, :n] - least[..., :n] + of_frame[:, t]
        cost = (cost + cost.mT) / 2
    return Affine(torch.stack(gains[::-1], 1), torch.stack(offsets[::-1], 1), cost, pull)


def factorised(h: Tensor) -> Tensor:
    """Cholesky factors (B, m, m). A matrix that rounding made indefinite gets more on its diagonal; one that is not
    finite gives the identity, so that one bad clip does not end the others."""
    factor, bad = torch.linalg.cholesky_ex(h)
    if not bad.any():
        return factor
    diagonal = h.diagonal(dim1=-2, dim2=-1)
    more = 1e-3 * diagonal.abs().amax(-1, keepdim=True) + 1e-3 * diagonal.abs()
    again, worse = torch.linalg.cholesky_ex(h + torch.diag_embed(more))
    factor = torch.where((bad > 0)[:, None, None], again, factor)
    eye = torch.eye(h.shape[-1], dtype=h.dtype, device=h.device)
    return torch.where(((worse > 0) & (bad > 0))[:, None, None], eye, factor)
