"""Curves with continuous acceleration: superposed minimum-jerk moves, quintic pieces, band-limited noise.

A channel is an initial value plus a sum of quintic pieces. A piece contributes nothing before it starts
and a constant after it ends, so pieces may overlap: human movements are well described as superposed
minimum-jerk submovements.
Source: Flash & Hogan 1985 (minimum jerk); Flash & Henis 1991 (superposition).
"""

import math

import torch
from torch import Tensor

#: 10 s^3 - 15 s^4 + 6 s^5: from 0 to 1 with zero velocity and acceleration at both ends.
MINIMUM_JERK = (0.0, 0.0, 10.0, -15.0, 6.0)


def quintic(start: tuple[float, float, float], stop: tuple[float, float, float], duration: float) -> tuple[float, ...]:
    """Coefficients of s, s^2, .. s^5 of the quintic between two (position, velocity, acceleration) states.

    s = t / duration in [0, 1]; the value is relative to the start. Between two states of one parabola it is
    that parabola, so free flight stays exactly ballistic.
    """
    (x0, v0, a0), (x1, v1, a1) = start, stop
    b, c = v0 * duration, a0 * duration**2 / 2
    p, q, r = x1 - x0 - b - c, v1 * duration - b - 2 * c, a1 * duration**2 - 2 * c
    return b, c, 10 * p - 4 * q + r / 2, -15 * p + 7 * q - r, 6 * p - 3 * q + r / 2


def evaluate(initial: Tensor, channel: Tensor, start: Tensor, duration: Tensor, pieces: Tensor, t: Tensor) -> Tensor:
    """Sum of pieces at times t (T,), in order: (C, T) float64.

    initial (C,): value before every piece. channel (N,): which row a piece belongs to. start, duration (N,):
    seconds. pieces (N, 5): coefficients of s .. s^5. Only the frames inside a piece are visited.
    """
    first = torch.searchsorted(t, start)
    last = torch.searchsorted(t, start + duration)  # frames from here on see the whole piece
    count = last - first
    piece = torch.repeat_interleave(torch.arange(len(start)), count)
    frame = torch.arange(len(piece)) - (count.cumsum(0) - count)[piece] + first[piece]
    s = (t[frame] - start[piece]) / duration[piece]
    powers = torch.stack([s**k for k in range(1, 6)], -1)
    total = torch.zeros(len(initial), len(t) + 1, dtype=torch.float64)
    total.index_put_((channel, last), pieces.sum(-1), accumulate=True)
    total = total.cumsum(-1)[:, :-1] + initial[:, None]
    return total.index_put_((channel[piece], frame), (pieces[piece] * powers).sum(-1), accumulate=True)


def noise(t: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Smooth random curves (count, T) of unit variance, band-limited to 0.1 to 1.5 hertz. A sum of eight sinusoids
    whose amplitude falls as 1/f: defined in continuous time, so another frame rate samples the same curve."""
    draw = torch.rand(2, count, 8, generator=generator, dtype=torch.float64)
    frequency = 0.1 * (1.5 / 0.1) ** draw[0]
    amplitude = 1 / frequency
    amplitude = amplitude / (amplitude.square().sum(-1, keepdim=True) / 2).sqrt()
    angle = 2 * math.pi * (frequency[..., None] * t + draw[1, ..., None])
    return (amplitude[..., None] * angle.sin()).sum(-2)


def soft_clip(x: Tensor, low: float | Tensor, high: float | Tensor, margin: float | Tensor) -> Tensor:
    """x inside [low + margin, high - margin]; beyond, it approaches the bounds smoothly (twice differentiable)."""
    top, bottom = high - margin, low + margin
    over, under = (x - top).clamp(min=0), (x - bottom).clamp(max=0)
    return x - over - under + margin * torch.tanh(over / margin) + margin * torch.tanh(under / margin)


def soft_min(values: Tensor, sharpness: float | Tensor) -> Tensor:
    """Smooth minimum over the last axis (n): never above the true one, at most ``sharpness * log(n)`` below it.

    sharpness: a number, or one for each minimum (...).
    """
    sharpness = torch.as_tensor(sharpness, dtype=values.dtype)
    return -sharpness * torch.logsumexp(-values / sharpness[..., None], -1)


def ramp(x: Tensor) -> Tensor:
    """Minimum-jerk step: 0 for x <= 0, 1 for x >= 1, acceleration continuous."""
    s = x.clamp(0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)
