"""Denoises motions with a diffusion model: the reverse process, begun at the step with the same noise.

A motion y = x_0 + noise of known size is, but for a factor, what the noising process makes of x_0 at the step t* with
sqrt((1 - alpha_bar) / alpha_bar) = size. From there the model goes back in one step.

Source: thesis 4.2.1, "Denoising: come up with a better test"; SDEdit (Meng et al. 2022), which adds all of the noise
itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab import baselines, rotation
from motionlab.contact import with_contacts
from motionlab.diffusion import sampling
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.model import Trained
from motionlab.diffusion.sampling import NoiseSchedule
from motionlab.errors import DataError
from motionlab.heading import local_to_world, stuck_root, world_to_local
from motionlab.motion import Motion

_LIVELY, _QUICK = 2.5, 1.0  # strength of acceleration that is motion: rad/s^(3/2) of joints, m/s^(3/2) of the root


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
        """Returns the noise of so many degrees and centimetres."""
        return cls(degrees * torch.pi / 180, centimetres / 100, lasting)

    def on(self, motion: Motion, generator: torch.Generator) -> Motion:
        """Adds this noise to a motion; contacts are dropped."""
        turn = _rotation_noise(motion.rot.shape[:-2], self.turn, generator, lasting=self.lasting)
        shift = self.shift * _steady(motion.root.shape, generator, dim=motion.root.ndim - 2, lasting=self.lasting)
        return replace(motion, root=motion.root + shift, rot=motion.rot @ turn, contacts=None)


def smoothed(motion: Motion, noise: Noise) -> Motion:
    """Computes a motion without most of its noise: a Kalman smoother over joints and root, each with its own."""

    def by(size: float, lively: float):
        return lambda x: baselines.kalman(x, motion.fps, max(size, 1e-6), lively)

    turned = baselines.smooth(motion, by(noise.turn, _LIVELY))
    return replace(turned, root=by(noise.shift, _QUICK)(motion.root))


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
    model: Trained,
    noisy: Motion,
    rough: Motion,
    noise: Noise,
    generator: torch.Generator,
    start: ReverseProcess | None = None,
) -> Motion:
    """Computes denoised motions (B, T), where they were in the world, by the reverse process.

    It begins at the step with the same noise. rough: about the same motions, as a filter leaves them: the frame of
    reference is that of its first frame, contacts are measured on it. A model that takes known values gets none.

    Raises:
        DataError: the model's numbers hold velocities, whose noise is not the joints'; or there is no noise.
    """
    start = start or ReverseProcess()
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
    t = _begin(model.schedule, whole)
    signal, stamps = model.schedule.alpha_bar[t].sqrt().to(y), model.schedule.stamps[t].expand(len(y))
    more = (whole**2 - size**2).clamp(min=0).sqrt() if start.topped else torch.zeros_like(size)
    total = torch.zeros_like(y)
    for _ in range(start.looks):
        total = total + model.denoiser(signal * (y + more * sampling.noise_like(y, generator)), stamps)
    made = model.decode(total / start.looks, noisy.skeleton)
    return replace(local_to_world(frame, made) if frame else made, name=noisy.name)


def noise_size(layout: Layout, normaliser: Normaliser, turn: float, shift: float) -> Tensor:
    """Computes the deviation (D,) of each normalised number from noise of ``turn`` radians about each axis of a joint
    and ``shift`` metres: a turned column of length 1 moves by sqrt(2 / 3) turn in each coordinate."""
    size = torch.zeros(layout.size)
    for name, part in layout.slices.items():
        size[part] = {"root": shift, "orient": (2 / 3) ** 0.5 * turn, "pose": (2 / 3) ** 0.5 * turn}.get(name, 0.0)
    return size / normaliser.scale


def _rotation_noise(shape: Sequence[int], turn: float, generator: torch.Generator, *, lasting: float = 0.0) -> Tensor:
    """Small random rotations (..., T, J, 3, 3), each axis N(0, turn) radians, as ``_steady``."""
    return rotation.exp(turn * _steady((*shape, 3), generator, dim=len(shape) - 2, lasting=lasting))


def _steady(shape: Sequence[int], generator: torch.Generator, *, dim: int, lasting: float = 0.0) -> Tensor:
    """Standard normal numbers of which those next to each other along ``dim`` have correlation ``lasting``."""
    fresh = torch.randn(shape, generator=generator).movedim(dim, 0)
    out = [fresh[0]]
    for now in fresh[1:]:
        out.append(lasting * out[-1] + (1 - lasting**2) ** 0.5 * now)
    return torch.stack(out).movedim(0, dim)
