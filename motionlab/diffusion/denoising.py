"""Noise taken out of a motion by a diffusion model: the reverse process, begun at the step that is as noisy.

A motion y = x_0 + noise of known size is, but for a factor, what the noising process makes of x_0 at the step t* with
sqrt((1 - alpha_bar) / alpha_bar) = size. From there on the model goes back, in one look or in several steps.

Source: thesis 4.2.1, "Denoising: come up with a better test"; SDEdit (Meng et al. 2022), which adds all of the noise
itself; the pull to the measurement: DiffPIR (Zhu et al. 2023).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.contact import with_contacts
from motionlab.diffusion import sampling
from motionlab.diffusion.rivals import noise_size, rotation_noise, steady
from motionlab.diffusion.schedule import Schedule
from motionlab.diffusion.trained import Trained
from motionlab.errors import DataError
from motionlab.frames import local_to_world, stuck_root, world_to_local
from motionlab.motion import Motion


@dataclass(frozen=True)
class Noise:
    """turn: radians about each axis of every joint. shift: metres along each axis of the root. Standard deviations.

    lasting: correlation of one frame's noise with the next one's; 0: every frame's is new.
    """

    turn: float
    shift: float
    lasting: float = 0.0

    @classmethod
    def of(cls, degrees: float, centimetres: float, lasting: float = 0.0) -> Noise:
        """In the units that people think in."""
        return cls(degrees * torch.pi / 180, centimetres / 100, lasting)

    def on(self, motion: Motion, generator: torch.Generator) -> Motion:
        """A motion with this noise on it; contacts are dropped."""
        turn = rotation_noise(motion.rot.shape[:-2], self.turn, generator, lasting=self.lasting)
        shift = self.shift * steady(motion.root.shape, generator, dim=motion.root.ndim - 2, lasting=self.lasting)
        return replace(motion, root=motion.root + shift, rot=motion.rot @ turn, contacts=None)


@dataclass(frozen=True)
class Start:
    """How the reverse process begins and goes on.

    level: noise at its first step, over that of the motion. topped: numbers less noisy than that get more. steps: DDIM
    steps down from there; 1: one look, the network's mean of all that may be. looks: with other noise, averaged.
    pull: of the measurement on every estimate of x_0, by r^2 / (r^2 + noise^2), r^2 = pull (1 - alpha_bar); 0: none.
    filtered: the rough motion is what begins, not the noisy one.
    """

    level: float = 1.0
    topped: bool = True
    steps: int = 1
    looks: int = 1
    pull: float = 0.0
    filtered: bool = False


def begin(schedule: Schedule, size: float) -> int:
    """The step t* that is about as noisy, for its signal, as a signal of unit size with noise of this size."""
    ratio = ((1 - schedule.alpha_bar) / schedule.alpha_bar).log()
    return int((ratio - 2 * torch.tensor(size, dtype=ratio.dtype).log()).abs().argmin())


@torch.no_grad()
def denoise(
    model: Trained, noisy: Motion, rough: Motion, noise: Noise, generator: torch.Generator, start: Start | None = None
) -> Motion:
    """Motions (B, T) without their noise, where they were in the world.

    rough: about the same motions, as a filter leaves them: the frame of reference is taken from its first frame, and
    contacts are measured on it. A model that is told is told nothing.

    Raises:
        DataError: the model's numbers hold velocities, whose noise is not the joints'; or there is no noise.
    """
    start = start or Start()
    if model.layout.velocities:
        raise DataError("the model reads velocities", remedy="denoise with a model of places and rotations")
    size = noise_size(model.layout, model.normaliser, noise.turn, noise.shift)
    if not (size > 0).any():
        raise DataError("no noise", place="noise", remedy="give how much a joint turns or the root moves")
    whole = size[size > 0].square().mean().sqrt().item() * start.level
    frame = stuck_root(rough)[1] if model.layout.frame == "stuck" else None
    given = rough if start.filtered else noisy
    local = world_to_local(frame, given) if frame else given
    if model.layout.contacts:
        local = replace(local, contacts=with_contacts(rough).contacts)
    y = model.encode_local(local)
    t = begin(model.schedule, whole)
    schedule = Schedule(model.schedule.alpha_bar[: t + 1], model.schedule.stamps[: t + 1])
    schedule = schedule.respaced(min(start.steps, t + 1))
    told = model.denoiser if not start.pull else _pulled(model.denoiser, schedule, y, size, start.pull)
    more = (whole**2 - size**2).clamp(min=0).sqrt() if start.topped else torch.zeros_like(size)
    total = torch.zeros_like(y)
    for _ in range(start.looks):
        x = schedule.alpha_bar[-1].sqrt().to(y) * (y + more * sampling.noise_like(y, generator))
        total = total + sampling.ddim(told, schedule, x)
    made = model.decode(total / start.looks, noisy.skeleton)
    return replace(local_to_world(frame, made) if frame else made, name=noisy.name)


def _pulled(denoiser: sampling.Denoiser, schedule: Schedule, y: Tensor, size: Tensor, pull: float):
    """A denoiser whose estimate of x_0 moves to the measurement y as far as it is the less sure of the two."""
    level = dict(zip(schedule.stamps.tolist(), schedule.alpha_bar.tolist(), strict=True))
    measured = size > 0

    def better(x: Tensor, stamps: Tensor) -> Tensor:
        x0 = denoiser(x, stamps)
        unsure = pull * (1 - level[int(stamps[0])])
        share = torch.where(measured, unsure / (unsure + size.square()), 0.0)
        return x0 + share * (y - x0)

    return better
