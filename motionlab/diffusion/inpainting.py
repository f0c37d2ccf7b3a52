"""Known parts of a motion, put back behind every step of a sampler, and how the seam is mended.

x (B, T, D) in normalised numbers; known (B, T, D); m (B, T, D) or (T, D): 1 where known (the thesis's 1 - m).

Source: thesis Eq. 4.10 (RePaint, EDGE: the known part noised to x_{t-1}); MDM (x_0 imputed); RePaint (Lugmayr et al.
2022), resampling; Ho et al. 2022, reconstruction guidance, with CondMDI's weight.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from motionlab.diffusion.sampling import Denoiser, noise_like
from motionlab.diffusion.schedule import Schedule

Step = Callable[[Tensor, Tensor, int], Tensor]


def overwrite(schedule: Schedule, known: Tensor, m: Tensor, generator: torch.Generator, *, last: bool = True) -> Step:
    """Eq. 4.10: behind every step the known part is replaced by itself, noised to that step.

    last: also behind the last step, where it is not noised any more: exact, and the cause of the seam. m may be soft.
    """
    m = m.to(known)

    def after(x: Tensor, x0: Tensor, t: int) -> Tensor:
        if t == 0 and not last:
            return x
        return (1 - m) * x + m * schedule.noised(known, t - 1, noise_like(known, generator))

    return after


def imputed(denoise: Denoiser, known: Tensor, m: Tensor) -> Denoiser:
    """MDM's way: the estimate of x_0 gets the known part, and the sampler goes on from that."""
    m = m.to(known)
    return lambda x, stamps: (1 - m) * denoise(x, stamps) + m * known


def until_last(inner: Denoiser, denoise: Denoiser, last: int) -> Denoiser:
    """``inner``, but ``denoise`` alone at the step that is told ``last``, so that the network has the last word.

    Source: CondMDI, ``--stop_imputation_at 1``.
    """
    return lambda x, stamps: (denoise if int(stamps[0]) == last else inner)(x, stamps)


def guided(denoise: Denoiser, schedule: Schedule, known: Tensor, m: Tensor, weight: float) -> Denoiser:
    """Known parts imputed; the rest of the x_0 estimate less weight sqrt(alpha_bar) / 2 times the gradient in x_t of
    |m (x_0 estimate - known)|^2, so that it moves to where the network's own estimate agrees with what is known."""
    m = m.to(known)
    level = dict(zip(schedule.stamps.tolist(), schedule.alpha_bar.tolist(), strict=True))

    def better(x: Tensor, stamps: Tensor) -> Tensor:
        with torch.enable_grad():
            at = x.detach().requires_grad_()
            x0 = denoise(at, stamps)
            (slope,) = torch.autograd.grad((m * (x0 - known)).square().sum(), at)
        a = x.new_tensor([level[int(t)] for t in stamps]).reshape(-1, *(1,) * (x.ndim - 1))
        return (1 - m) * (x0.detach() - weight * a.sqrt() / 2 * slope) + m * known

    return better


def soft(m: Tensor, frames: int) -> Tensor:
    """A mask (..., T, D) whose edges in time rise over ``frames`` frames outside what is known: 1, ..., 1/(n+1), 0."""
    best = m.float()
    for k in range(1, frames + 1):
        value = 1 - k / (frames + 1)
        for way in (k, -k):
            moved = torch.roll(m.float(), way, -2)
            moved[..., (slice(0, way) if way > 0 else slice(way, None)), :] = 0
            best = torch.maximum(best, value * moved)
    return best


def offset_decay(x: Tensor, known: Tensor, m: Tensor, frames: int) -> Tensor:
    """x (B, T, D) with its known parts exact, and the offset that this takes faded out over ``frames`` frames beside
    them: no jump in value and none in velocity, at either end of the fade.

    With e and v the offset of the nearest known frame and its change per frame, u the share of the fade that has passed
    and n its frames (no more than a gap has): x + e (2u^3 - 3u^2 + 1) + v n (u^3 - 2u^2 + u), from both sides of a gap.

    Source: inertialisation (Bollo 2018). Differs: a cubic, with no acceleration to match.
    """
    sure = (m >= 1).expand_as(x)
    offset = torch.where(sure, known - x, 0.0)
    left = _faded(offset, sure, frames)
    right = _faded(offset.flip(-2), sure.flip(-2), frames).flip(-2)
    return torch.where(sure, known, x + left + right)


def _faded(offset: Tensor, sure: Tensor, frames: int) -> Tensor:
    """What the known frame before each number adds to it (B, T, D); nothing where none is before."""
    count = offset.shape[-2]
    time = torch.arange(count, device=offset.device)[:, None].expand(offset.shape[-2:])
    before = torch.where(sure, time, -1).cummax(-2).values
    after = torch.where(sure, time, 2 * count + frames).flip(-2).cummin(-2).values.flip(-2)
    at = before.clamp(min=0)
    earlier = (at - 1).clamp(min=0)
    e = offset.gather(-2, at)
    v = torch.where(sure.gather(-2, earlier) & (at > 0), e - offset.gather(-2, earlier), 0.0)
    n = (after - before).clamp(max=frames).to(offset)
    u = ((time - before) / n).clamp(0, 1)
    faded = e * (2 * u**3 - 3 * u**2 + 1) + v * n * (u**3 - 2 * u**2 + u)
    return torch.where((before >= 0) & ~sure, faded, 0.0)
