"""A small latent trial: windows squeezed into a few numbers by principal parts, and diffusion over those numbers.

Its rival draws the same numbers from a Gaussian. Source: thesis 4.2.5 names MLD (Chen et al. 2023), whose autoencoder
and denoiser are transformers. Differs: the autoencoder is linear and the denoiser a perceptron.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Generator, Tensor, nn

from motionlab.bench import PersonWindows
from motionlab.diffusion.model import MotionDiffusion
from motionlab.diffusion.sampling import NoiseSchedule, ddpm
from motionlab.motion import Motion
from studies.nb15_what_it_takes.figures import Panel
from studies.shared.generated import Judged, frechet, pseudo

LATENT, GAUSSIAN, P = "latent diffusion", "Gaussian", "P"
_WIDTH, _BATCH, _RATES = 512, 256, tuple(2.0**k for k in range(8))


@dataclass(frozen=True, eq=False)
class Squeezed:
    """mean (T D,), axes (T D, K): windows are mean + axes z; z (N, K) of training windows has mean 0 and variance 1."""

    model: MotionDiffusion
    mean: Tensor
    axes: Tensor

    @classmethod
    def of(cls, model: MotionDiffusion, x: Tensor, size: int, generator: Generator) -> Self:
        """Of training windows as rows x (N, T D), by a randomised range finder (Halko et al. 2011)."""
        mean, size = x.mean(0), min(size, len(x) - 1)
        rows, basis = x - mean, torch.randn(len(x), min(size + 16, *x.shape), generator=generator)
        for _ in range(2):
            basis = rows @ torch.linalg.qr(rows.mT @ basis).Q
        basis = torch.linalg.qr(rows.mT @ basis).Q
        values, axes = torch.linalg.eigh((rows @ basis).mT.cov(correction=0))
        return cls(model, mean, basis @ axes[:, -size:] * values[-size:].clamp(min=0).sqrt())

    def of_size(self, size: int) -> Self:
        """The same by its largest parts alone."""
        return Squeezed(self.model, self.mean, self.axes[:, -size:])

    def encode(self, x: Tensor) -> Tensor:
        """Rows (N, T D) -> z (N, K)."""
        return (x - self.mean) @ self.axes / self.axes.square().sum(0)

    def decode(self, z: Tensor) -> Motion:
        """z (N, K) -> windows (N, T), in the frame of their first pose."""
        return self.model.decode((self.mean + z @ self.axes.mT).unflatten(1, (self.model.recipe.frames, -1)))

    def lost_cm(self, x: Tensor) -> Tensor:
        """Mean distance (N,) of joints between windows and what is left of them, cm."""
        there, back = self.model.decode(x.unflatten(1, (self.model.recipe.frames, -1))), self.decode(self.encode(x))
        return 100 * (there.positions - back.positions).norm(dim=-1).mean((1, 2))


def learnt(z: Tensor, schedule: NoiseSchedule, steps: int, generator: Generator) -> Callable:
    """A perceptron that denoises rows z (N, K), by the plain loss of Eq. 4.8."""
    torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
    net = nn.Sequential(
        nn.Linear(z.shape[1] + 2 * len(_RATES), _WIDTH), nn.SiLU(), nn.Linear(_WIDTH, _WIDTH), nn.SiLU(),
        nn.Linear(_WIDTH, _WIDTH), nn.SiLU(), nn.Linear(_WIDTH, z.shape[1]),
    )  # fmt: skip

    def denoise(x: Tensor, stamps: Tensor) -> Tensor:
        angle = torch.pi / len(schedule) * stamps[:, None] * torch.tensor(_RATES)
        return net(torch.cat((x, angle.cos(), angle.sin()), -1))

    optimiser = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=0.01)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        which, t = (torch.randint(n, (_BATCH,), generator=generator) for n in (len(z), len(schedule)))
        x = z[which]
        noised = schedule.noised(x, t, torch.randn(x.shape, generator=generator))
        loss = (denoise(noised, schedule.stamps[t]) - x).square().mean()
        optimiser.zero_grad(), loss.backward(), optimiser.step(), rate.step()
    return torch.no_grad()(denoise)


def everybody(
    whole: Squeezed, x: Tensor, sizes: Sequence[int], training: int, count: int, steps: int, give: Callable
) -> tuple[dict[str, dict[int, Motion]], dict[str, float]]:
    """New windows (count, T) by P, and by both of each size k, by name and size; and seconds that one of them takes."""
    model, began = whole.model, time.perf_counter()
    made: dict[str, dict[int, Motion]] = {P: {0: model.sample(count, give(P), steps=steps)}, LATENT: {}, GAUSSIAN: {}}
    took, few = {P: (time.perf_counter() - began) / count}, model.schedule.respaced(steps)
    for k in sizes:
        space = whole.of_size(k)
        denoise = learnt(space.encode(x), model.schedule, training, give(f"{k}"))
        z, began = torch.randn(count, k, generator=give("z")), time.perf_counter()
        made[LATENT][k] = space.decode(ddpm(denoise, few, z, give("walk")))
        took[LATENT] = (time.perf_counter() - began) / count
        made[GAUSSIAN][k] = space.decode(z)
    return made, took


def compared(made: Mapping[str, Mapping[int, Motion]], test: PersonWindows) -> Panel:
    """Frechet distance of what was made to test people, by person."""
    real = Judged.of(test.motion)

    def far(motion: Motion) -> Tensor:
        mine = Judged.of(motion)
        return pseudo(lambda some: frechet(mine, some), [real], test.whose)

    lines = {name: {k: far(motion) for k, motion in made[name].items()} for name in (LATENT, GAUSSIAN)}
    return Panel(lines, "numbers k of a window", "Frechet distance", {P: far(made[P][0])})
