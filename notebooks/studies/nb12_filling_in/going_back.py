"""Denoises motions with a diffusion model: the reverse process, begun at the step with the same noise.

A motion y = x_0 + noise of known size is, but for a factor, what the noising process makes of x_0 at the step t* with
sqrt((1 - alpha_bar) / alpha_bar) = size. From there the model goes back in one step.

Source: thesis 4.2.1; SDEdit (Meng et al. 2022), which adds all of the noise itself.
"""

from dataclasses import dataclass, replace

import torch

from motionlab.contact import with_contacts
from motionlab.diffusion import sampling
from motionlab.diffusion.denoising import Noise, noise_size
from motionlab.diffusion.model import MotionDiffusion
from motionlab.diffusion.sampling import NoiseSchedule
from motionlab.heading import local_to_world, stuck_root, world_to_local
from motionlab.motion import Motion


@dataclass(frozen=True)
class ReverseProcess:
    """How the reverse process begins and goes on.

    level: noise at its first step, over that of the motion. topped: numbers less noisy than that get more. looks: with
    other noise, averaged. filtered: the rough motion is what begins, not the noisy one.
    """

    level: float = 1.0
    topped: bool = True
    looks: int = 1
    filtered: bool = False


def _begin(schedule: NoiseSchedule, size: float) -> int:
    """The step t* that is about as noisy, for its signal, as a signal of unit size with noise of this size."""
    ratio = ((1 - schedule.alpha_bar) / schedule.alpha_bar).log()
    return int((ratio - 2 * torch.tensor(size, dtype=ratio.dtype).log()).abs().argmin())


@torch.no_grad()
def denoise(
    model: MotionDiffusion, noisy: Motion, rough: Motion, noise: Noise, generator: torch.Generator,
    start: ReverseProcess | None = None,
) -> Motion:  # fmt: skip
    """Computes denoised motions (B, T), where they were in the world, by the reverse process.

    It begins at the step with the same noise. rough: about the same motions, as a filter leaves them: the frame of
    reference is that of its first frame, contacts are measured on it. A model that takes known values gets none; one of
    velocities, whose noise is not the joints', is none for this.
    """
    start = start or ReverseProcess()
    size = noise_size(model.layout, model.normaliser, noise.turn, noise.shift)
    whole = size[size > 0].square().mean().sqrt().item() * start.level
    frame = stuck_root(rough)[1] if model.layout.frame == "stuck" else None
    given = rough if start.filtered else noisy
    local = world_to_local(frame, given) if frame else given
    if model.layout.contacts:
        local = replace(local, contacts=with_contacts(rough).contacts)
    y = model.normaliser.apply(replace(model.layout, frame="world").encode(local))
    t = _begin(model.schedule, whole)
    signal, stamps = model.schedule.alpha_bar[t].sqrt().to(y), model.schedule.stamps[t].expand(len(y))
    more = (whole**2 - size**2).clamp(min=0).sqrt() if start.topped else torch.zeros_like(size)
    total = torch.zeros_like(y)
    for _ in range(start.looks):
        total = total + model.denoiser(signal * (y + more * sampling.noise_like(y, generator)), stamps)
    made = model.decode(total / start.looks, noisy.skeleton)
    return replace(local_to_world(frame, made) if frame else made, name=noisy.name)
