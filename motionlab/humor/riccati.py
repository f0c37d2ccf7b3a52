"""The Gauss-Newton matrix of a whole roll-out, factorised frame by frame from its end.

With y_t a small change of frame t (and of what all frames share), y_{t+1} = A_t y_t + B_t z_t, and an energy
1/2 sum_t |R_t y_t|^2 + |N_t (y_t, z_t)|^2, the least that frames t.. can cost is 1/2 y_t^T P_t y_t,

    Q = [A B]^T P_{t+1} [A B] + N^T N,   L L^T = Q_zz,   K_t = -Q_zz^-1 Q_zy,   P_t = Q_yy + Q_yz K_t + R_t^T R_t,

and in nu, z_t = K_t y_t + L^-T nu_t, the energy is 1/2 |nu|^2: the coordinates in which Newton's step is -gradient.
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
