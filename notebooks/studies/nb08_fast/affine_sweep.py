"""Computes the best step along linear dynamics from a quadratic energy with a gradient, by one Riccati sweep.

As ``shooting.gauss_newton``. With a gradient, of changes g_t and of controls h_t, the least that frames t.. can cost
also has a slope p_t, and the best control an offset k_t:

    q = [A B]^T p_{t+1} + (0, h_t),   k_t = -Q_zz^-1 q_z,   p_t = q_y + Q_yz k_t + g_t.

Source: the discrete Riccati equation, e.g. Rao, Wright and Rawlings 1998.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.humor.shooting.gauss_newton import factorised


class Affine(NamedTuple):
    """gains K (B, T - 1, Z, n), offsets k (B, T - 1, Z), and of the first change P_0 (B, n, n) and p_0 (B, n)."""

    gains: Tensor
    offsets: Tensor
    first: Tensor
    slope: Tensor

    def walked(self, a: Tensor, b: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Computes the best changes (B, T, n) and controls (B, T - 1, Z) from a first change (B, n)."""
        changes, controls = [y], []
        for t in range(a.shape[1]):
            controls.append(torch.baddbmm(self.offsets[:, t, :, None], self.gains[:, t], y[..., None])[..., 0])
            y = (a[:, t] @ y[..., None] + b[:, t] @ controls[-1][..., None])[..., 0]
            changes.append(y)
        return torch.stack(changes, 1), torch.stack(controls, 1)


def affine_sweep(
    of_frame: Tensor, a: Tensor, b: Tensor, rows: Tensor, of_control: Tensor, slope: Tensor, control_slope: Tensor
) -> Affine:
    """Computes gains and offsets from costs with gradients, backwards through T frames.

    of_frame, a, b: as in ``riccati_sweep``. rows (B, T - 1, k, n + Z): N. of_control (B, T - 1, Z, Z): added to Q_zz.
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
