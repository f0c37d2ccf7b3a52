"""Inpaints motions with a diffusion model: unknown parts are sampled; :class:`Inpainting` says how the known enter.

x (B, T, D) in normalised numbers; known (B, T, D); m (B, T, D) or (T, D): 1 where known (the thesis's 1 - m).
:func:`inpaint` takes motions, :func:`inpaint_features` numbers.

Source: thesis 4.1.2, Eq. 4.10 (RePaint, EDGE: the known part noised to x_{t-1}), 4.2, 4.4.1; MDM (x_0 imputed); Ho et
al. 2022, reconstruction guidance, with CondMDI's weight.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from motionlab.baselines import nearest_known
from motionlab.contact import with_contacts
from motionlab.diffusion import sampling
from motionlab.diffusion.model import MotionDiffusion
from motionlab.diffusion.sampling import After, DenoiseFunction, NoiseSchedule, noise_like
from motionlab.errors import ShapeError
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import Motion


@dataclass(frozen=True)
class Inpainting:
    """How the known part enters the sampling.

    steps: of the respaced process. guidance_weight: of reconstruction guidance, which imputes the known part, as MDM
    does; 0: it is replaced (Eq. 4.10). replace_last: also in the last step, as the thesis does. mask_ramp: frames over
    which the mask's edges rise. blend_frames: over which ``offset_decay`` fades; 0: known parts stay as they are.
    """

    steps: int = 50
    replace_last: bool = True
    guidance_weight: float = 0.0
    mask_ramp: int = 0
    blend_frames: int = 0


def inpaint_features(
    model: MotionDiffusion, x0: Tensor, known: Tensor, generator: torch.Generator, how: Inpainting
) -> Tensor:
    """Inpaints normalised windows (B, T, D): they keep x0 where ``known`` holds and are sampled elsewhere.

    known: bool (B, T, D) or (T, D). How exactly x0 is kept is up to ``how``; elsewhere it is never read.
    """
    if known.shape[-2:] != x0.shape[-2:] or known.ndim > x0.ndim:
        raise ShapeError(f"known: expected {tuple(x0.shape[-2:])} or {tuple(x0.shape)}, got {tuple(known.shape)}")
    seen = torch.where(known, x0, 0.0)
    schedule = model.schedule.respaced(min(how.steps, len(model.schedule)))
    m = (_ramped(known, how.mask_ramp) if how.mask_ramp else known).to(x0)
    if how.mask_ramp:  # where the mask is soft the nearest known value stands in
        seen = _nearest_held(seen, known)
    if how.guidance_weight:
        inner, after = _guided(model.denoiser, schedule, seen, m, how.guidance_weight), None
    else:
        inner, after = model.denoiser, _replace(schedule, seen, m, generator, last=how.replace_last)

    def denoise(x: Tensor, stamps: Tensor) -> Tensor:  # the network may have the last word (CondMDI)
        return (inner if how.replace_last or int(stamps[0]) != int(schedule.stamps[0]) else model.denoiser)(x, stamps)

    x = sampling.ddpm(denoise, schedule, noise_like(x0, generator), generator, after=after)
    return offset_decay(x, seen, known, how.blend_frames) if how.blend_frames else x


def inpaint(
    model: MotionDiffusion, motion: Motion, known: Tensor, generator: torch.Generator, how: Inpainting | None = None,
) -> Motion:  # fmt: skip
    """Inpaints motions (B, T) with gaps: unknown numbers are sampled, the place in the world stays.

    known: bool (B, T, D) or (T, D), True where known. A stuck layout takes the place and heading of the first frame as
    given, known or not. Contacts that a motion lacks are labelled.
    """
    if model.layout.contacts and motion.contacts is None:
        motion = with_contacts(motion)
    x0 = model.encode(motion)
    whole, how = known.expand(len(x0), *known.shape[-2:]), how or Inpainting()
    pairs = zip(x0.split(64), whole.split(64), strict=True)
    x = torch.cat([inpaint_features(model, *pair, generator, how) for pair in pairs])
    made = replace(model.decode(x, motion.skeleton), name=motion.name)
    return local_to_world(stuck_root(motion)[1], made) if model.layout.frame == "stuck" else made


def _replace(
    schedule: NoiseSchedule, known: Tensor, m: Tensor, generator: torch.Generator, *, last: bool = True
) -> After:
    """Eq. 4.10: behind every step the known part is replaced by itself, noised to that step. last: also behind the last
    step, where it is not noised any more: exact, and the cause of the seam. m may be soft."""

    def after(x: Tensor, x0: Tensor, t: int) -> Tensor:
        if t == 0 and not last:
            return x
        return (1 - m) * x + m * schedule.noised(known, t - 1, noise_like(known, generator))

    return after


def _guided(
    denoise: DenoiseFunction, schedule: NoiseSchedule, known: Tensor, m: Tensor, weight: float
) -> DenoiseFunction:
    """Known parts imputed; the rest of the x_0 estimate less weight sqrt(alpha_bar) / 2 times the gradient in x_t of
    |m (x_0 estimate - known)|^2, so that it moves to where the network's own estimate agrees with what is known."""
    level = dict(zip(schedule.stamps.tolist(), schedule.alpha_bar.tolist(), strict=True))

    def better(x: Tensor, stamps: Tensor) -> Tensor:
        with torch.enable_grad():
            at = x.detach().requires_grad_()
            x0 = denoise(at, stamps)
            (slope,) = torch.autograd.grad((m * (x0 - known)).square().sum(), at)
        a = x.new_tensor([level[int(t)] for t in stamps]).reshape(-1, *(1,) * (x.ndim - 1))
        return (1 - m) * (x0.detach() - weight * a.sqrt() / 2 * slope) + m * known

    return better


def _ramped(m: Tensor, frames: int) -> Tensor:
    """A mask (..., T, D) whose edges in time rise over ``frames`` frames outside what is known: 1, ..., 1/(n+1), 0."""
    best = m.float()
    for k in range(1, frames + 1):
        for sides in ((k, -k), (-k, k)):
            best = torch.maximum(best, (1 - k / (frames + 1)) * pad(m.float(), (0, 0, *sides)))
    return best


def offset_decay(x: Tensor, known: Tensor, m: Tensor, frames: int) -> Tensor:
    """Computes x (B, T, D) with its known numbers exact; the correction fades out over ``frames`` frames, smooth in
    value and velocity at either end.

    With e and v the offset of the nearest known frame and its change per frame, u the share of the fade that has passed
    and n its frames (no more than a gap has): x + e (2u^3 - 3u^2 + 1) + v n (u^3 - 2u^2 + u), from both sides of a gap.

    Source: inertialisation (Bollo 2018). Differs: a cubic, with no acceleration to match.
    """
    sure = (m >= 1).expand_as(x)
    offset = torch.where(sure, known - x, 0.0)
    left = _fade_from_before(offset, sure, frames)
    right = _fade_from_before(offset.flip(-2), sure.flip(-2), frames).flip(-2)
    return torch.where(sure, known, x + left + right)


def _fade_from_before(offset: Tensor, sure: Tensor, frames: int) -> Tensor:
    """What the known frame before each number adds to it (B, T, D); nothing where none is before."""
    count = offset.shape[-2]
    time = torch.arange(count, device=offset.device)[:, None].expand(offset.shape[-2:])
    before, after = (at.mT for at in nearest_known(sure.mT))
    any_before = (before <= time) & sure.any(-2, keepdim=True)
    earlier = (before - 1).clamp(min=0)
    e = offset.gather(-2, before)
    v = torch.where(sure.gather(-2, earlier) & (before > 0), e - offset.gather(-2, earlier), 0.0)
    n = torch.where(after >= time, (after - before).clamp(max=frames), frames).to(offset)
    u = ((time - before) / n).clamp(0, 1)
    faded = e * (2 * u**3 - 3 * u**2 + 1) + v * n * (u**3 - 2 * u**2 + u)
    return torch.where(any_before & ~sure, faded, 0.0)


def _nearest_held(x: Tensor, known: Tensor) -> Tensor:
    """Each unknown number takes the value of the known one nearest in time; 0 where its column knows none."""
    known = known.expand_as(x)
    time = torch.arange(x.shape[-2])[:, None].expand_as(x)
    before, after = (at.mT for at in nearest_known(known.mT))
    nearest = torch.where(time - before <= after - time, before, after)
    return torch.where(known.any(-2, keepdim=True), x.gather(-2, nearest), 0.0)
