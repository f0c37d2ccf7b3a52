"""Motions whose unknown parts a diffusion model fills in: every way of putting the known part back, by one call.

Source: thesis 4.1.2 (Eq. 4.10), 4.2, 4.4.1; SDEdit (Meng et al. 2022), to begin from a guess.
The ways themselves: ``inpainting`` and ``sampling``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.contact import with_contacts
from motionlab.diffusion import inpainting, sampling
from motionlab.diffusion.sampling import Denoiser
from motionlab.diffusion.trained import Trained
from motionlab.errors import ShapeError
from motionlab.frames import local_to_world, stuck_root, world_to_local
from motionlab.motion import Motion

PUTS = ("overwrite", "imputed", "nothing")
SAMPLERS = ("ddpm", "ddim")


@dataclass(frozen=True)
class Way:
    """How the known part comes in.

    put: "overwrite" (Eq. 4.10), "imputed" (MDM), or "nothing", where only a model that is told, or guidance, knows it.
    steps, sampler: of the respaced process. last: overwrite (or impute) also in the last step, as the thesis does.
    weight: of reconstruction guidance; 0: none. begin: at which share of the steps to begin from a guess; 1 without
    one: from noise. times, jump: of RePaint's resampling; times 1: none. soft: frames over
    which the mask's edges rise. finish: frames over which ``inpainting.offset_decay`` fades; 0: no finish, known parts
    stay as the sampler left them.
    """

    put: str = "overwrite"
    steps: int = 50
    sampler: str = "ddpm"
    last: bool = True
    weight: float = 0.0
    begin: float = 1.0
    times: int = 1
    jump: int = 10
    soft: int = 0
    finish: int = 0

    def __post_init__(self) -> None:
        for name, allowed in (("put", PUTS), ("sampler", SAMPLERS)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        if self.times > 1 and self.put != "overwrite":
            raise ValueError("resampling goes with put = 'overwrite'")
        if not 0 < self.begin <= 1 or (self.begin < 1 and (self.times > 1 or self.sampler != "ddpm")):
            raise ValueError(f"begin: expected a share of the steps of plain DDPM, above 0, got {self.begin}")


def fill(
    model: Trained, x0: Tensor, known: Tensor, generator: torch.Generator, way: Way, guess: Tensor | None = None
) -> Tensor:
    """Normalised numbers (B, T, D) whose known part is x0's (known: (B, T, D) or (T, D), bool) and whose rest is new.

    What x0 holds where it is not known is never read. A model that is told gets the mask and the known values. guess
    (B, T, D): of the rest; sampling begins with it, noised to step ``way.begin`` (SDEdit).
    """
    if (guess is None) != (way.begin == 1):
        raise ValueError("begin: below 1 with a guess, 1 without")
    if known.shape[-2:] != x0.shape[-2:] or known.ndim > x0.ndim:
        raise ShapeError(f"known: expected {tuple(x0.shape[-2:])} or {tuple(x0.shape)}, got {tuple(known.shape)}")
    seen = torch.where(known, x0, 0.0)
    schedule = model.schedule.respaced(min(way.steps, len(model.schedule)))
    m = inpainting.soft(known, way.soft) if way.soft else known.to(x0)
    if way.soft:  # where the mask is soft the nearest known value stands in
        seen = _held(seen, known)
    denoise: Denoiser = model.denoiser
    if model.recipe.told:
        denoise = lambda x, stamps: model.denoiser(x, stamps, seen, known.expand_as(x))  # noqa: E731
    alone = denoise
    if way.weight:
        denoise = inpainting.guided(denoise, schedule, seen, m, way.weight)
    elif way.put == "imputed":
        denoise = inpainting.imputed(denoise, seen, m)
    if denoise is not alone and not way.last:
        denoise = inpainting.until_last(denoise, alone, int(schedule.stamps[0]))
    after = None
    if way.put == "overwrite":
        after = inpainting.overwrite(schedule, seen, m, generator, last=way.last)
    x, begin = sampling.noise_like(x0, generator), round(way.begin * (len(schedule) - 1))
    if guess is not None:
        x = schedule.noised(torch.where(known, x0, guess), begin, x)
    if way.times > 1:
        x = sampling.resampled(denoise, schedule, x, generator, after=after, times=way.times, jump=way.jump)
    elif way.sampler == "ddpm":
        x = sampling.ddpm(denoise, schedule, x, generator, after=after, start=begin)
    else:
        x = sampling.ddim(denoise, schedule, x, after=after)
    return inpainting.offset_decay(x, seen, known, way.finish) if way.finish else x


def repair(
    model: Trained,
    motion: Motion,
    known: Tensor,
    generator: torch.Generator,
    way: Way | None = None,
    *,
    guess: Motion | None = None,
    batch: int = 64,
) -> Motion:
    """Motions (B, T) with their unknown parts made anew, where they were in the world.

    guess: of the whole motions, for ways that begin with one, in the world.

    known: bool (B, T, D) or (T, D), True where known, as ``model.layout.mask`` makes it. A stuck layout takes the place
    and heading of the first frame as given, known or not. Contacts that a motion lacks are labelled.
    """
    if model.layout.contacts and motion.contacts is None:
        motion = with_contacts(motion)
    stuck = model.layout.frame == "stuck"
    local, frame = stuck_root(motion) if stuck else (motion, None)
    x0 = model.encode(motion)
    whole, way = known.expand(len(x0), *known.shape[-2:]), way or Way()
    if guess is not None:  # in the frame of the motion's first frame, not of its own
        inside = replace(world_to_local(frame, guess), contacts=guess.contacts) if stuck else guess
        guessed = model.encode_local(inside)
    parts = [
        fill(model, x0[at], whole[at], generator, way, None if guess is None else guessed[at])
        for at in _batches(len(x0), batch)
    ]
    made = model.decode(torch.cat(parts), local.skeleton)
    made = replace(made, contacts=made.contacts, name=motion.name)
    return local_to_world(frame, made) if stuck else made


def _batches(count: int, size: int) -> Iterator[slice]:
    return (slice(at, at + size) for at in range(0, count, size))


def _held(x: Tensor, known: Tensor) -> Tensor:
    """Each unknown number takes the value of the known one nearest in time; 0 where its column knows none."""
    known = known.expand_as(x)
    time = torch.arange(x.shape[-2])[:, None].expand_as(x)
    far = 10 * x.shape[-2]
    before = torch.where(known, time, -far).cummax(-2).values
    after = torch.where(known, time, far).flip(-2).cummin(-2).values.flip(-2)
    nearest = torch.where(time - before <= after - time, before, after).clamp(0, x.shape[-2] - 1)
    return torch.where(known.any(-2, keepdim=True), x.gather(-2, nearest), 0.0)
