"""Trains a denoiser to estimate x_0 from x_t at a random step; resumable to the bit.

Losses: on its numbers, its joints, their changes, and feet that should stand.

Source: thesis 4.1.2, Eqs. 4.8 and 4.9; MDM (Tevet et al. 2022): AdamW without decay of the weights, steps drawn evenly.
Differs: ``simple`` and ``velocity`` are means over the numbers of a frame, of normalised numbers (MDM), where the
thesis sums: 1 is a network that knows nothing. Positions are metres, not normalised values (EDGE). Warm-up, cosine
decay, clipped gradients; what ships is a moving average (MDM: chosen by FID, by hand; thesis: by eye); dropout follows
the run's generator; gradients not finite are skipped.
"""

from dataclasses import replace

import torch
from torch import Tensor

from motionlab.diffusion.features import Layout, Normaliser, units
from motionlab.diffusion.model import Denoiser, DenoiserRecipe, MotionDiffusion
from motionlab.diffusion.sampling import noise_like
from motionlab.diffusion.windows import Windows
from motionlab.errors import DataError
from motionlab.motion import FPS
from motionlab.skeleton import STANDARD
from motionlab.training.training_loop import TrainingRun, seeded

_MEASURED = 2000  # windows that the normaliser is measured on


class DenoiserTraining(TrainingRun):
    """A training run of a denoiser. start: the model to begin from, with its normaliser; None: new weights."""

    Recipe = DenoiserRecipe

    def __init__(self, recipe: DenoiserRecipe, windows: Windows, start: MotionDiffusion | None = None) -> None:
        if windows.length != recipe.frames or windows.fps != FPS:
            raise DataError(f"windows of {windows.length} frames at {windows.fps:g} fps: not {recipe.frames} at 30")
        self.windows, self.layout, self.schedule, self.clip = windows, recipe.layout, recipe.schedule, recipe.clip
        model = seeded(recipe.seed, recipe.denoiser)
        if start is None:
            some = self.layout.encode(windows.draw(_MEASURED, torch.Generator().manual_seed(0)))
            sizes = Normaliser.measure(some, self.layout, root_unit=recipe.root_unit)
        else:
            sizes = start.normaliser
            model.load_state_dict(start.denoiser.state_dict())
        optimiser = torch.optim.AdamW(model.parameters(), lr=recipe.lr, weight_decay=0.0)
        generator = torch.Generator().manual_seed(recipe.seed)
        super().__init__(recipe, windows.digest, generator, model, optimiser, normaliser=(sizes.mean, sizes.scale))

    @property
    def normaliser(self) -> Normaliser:
        """Of the numbers that it is shown."""
        return Normaliser(*self.extra["normaliser"])

    def _ready(self, model: Denoiser) -> MotionDiffusion:
        return MotionDiffusion(model, self.schedule, self.layout, self.normaliser, self.recipe)

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        recipe = self.recipe
        motion, clips = self.windows.drawn(recipe.batch, self.generator)
        x0 = self.normaliser.apply(self.layout.encode(motion))
        t = torch.randint(len(self.schedule), (recipe.batch,), generator=self.generator)
        xt = self.schedule.noised(x0, t, noise_like(x0, self.generator))
        seed = int(torch.randint(2**31, (), generator=self.generator))
        with torch.random.fork_rng(devices=[]), torch.autocast("cpu", torch.bfloat16, recipe.bf16):
            torch.manual_seed(seed)  # dropout draws from torch's own generator
            estimate = self.model(xt, self.schedule.stamps[t]).float()
        seen = None
        if self.windows.seen is not None:
            whole = torch.ones(len(clips), 2, dtype=torch.bool)  # the root's place, contacts
            seen = torch.cat((self.windows.seen[clips], whole), 1)[:, units(self.layout)]
        offsets = motion.skeleton.offsets[:, 0]
        parts = denoising_losses(estimate, x0, self.layout, self.normaliser, offsets, seen)
        return sum(weight * parts[name] for name, weight in recipe.weights.items() if weight), parts


def denoising_losses(
    estimate: Tensor, truth: Tensor, layout: Layout, normaliser: Normaliser, offsets: Tensor, seen: Tensor | None = None
) -> dict[str, Tensor]:
    """Computes the training losses by name, each a mean over windows and frames.

    simple: mean square of normalised numbers. velocity: of their change between frames, root and rotations only.
    fk: squared distance of the joints from the truth's, summed over joints, m^2. contact: squared way between frames of
    joints that touch the floor, times how surely they do, summed over joints, m^2.

    Args:
        estimate, truth: x_0 (B, T, D), normalised. offsets: (B or 1, J, 3) metres, the bodies'. seen: (B, D), False for
            numbers that were not recorded: the truth stands in for them, so that no part learns from them.
    """
    if seen is not None:
        estimate = torch.where(seen[:, None], estimate, truth)
    error, skeleton, rows = estimate - truth, replace(STANDARD, offsets=offsets[:, None]), normaliser.undo(estimate)
    joints, true = (layout.decode(x, 1.0, skeleton).positions for x in (rows, normaliser.undo(truth)))
    sure = rows[:, :-1, layout.slices["contacts"], None].clamp(0, 1)
    way = joints[..., skeleton.contact_indices, :].diff(dim=1)
    return {
        "simple": error.square().mean(),
        "velocity": error[..., : layout.slices["pose"].stop].diff(dim=1).square().mean(),
        "fk": (joints - true).square().sum((-1, -2)).mean(),
        "contact": (way * sure).square().sum((-1, -2)).mean(),
    }
