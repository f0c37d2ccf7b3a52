"""What the thesis's own denoiser is trained on, without end, and judged by; see ``train_more``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from motionlab import train_more
from motionlab.bench.judge import FRAMES
from motionlab.bench.person_windows import person_windows
from motionlab.diffusion.model import DenoiserRecipe, Trained, load_denoiser, save_denoiser
from motionlab.diffusion.training import DenoiserTraining
from motionlab.diffusion.windows import Windows
from motionlab.motion import Motion
from motionlab.train_more import learnt_from
from motionlab.training_loop import fast_halves

RECIPES = {"diffusion_plain": DenoiserRecipe()}  # by name of what ships
CHOSEN = "x0 error, mean over steps"
_EACH = 12  # windows of each person who chooses


class Course(train_more.Course):
    """A denoiser that is told nothing."""

    def __init__(
        self, name: str, recipe: DenoiserRecipe, folder: Path | str | None, data: tuple[Windows, Motion] | None = None
    ) -> None:
        """data: instead of the folder's, with windows (B, T) that it is judged on."""
        self.name, self.recipe = name, recipe
        if data is None:
            windows, takes = learnt_from(folder, FRAMES)
            data = windows, person_windows(takes, FRAMES, _EACH).motion
        self.windows, self.choose = data

    def load(self, path: Path) -> Trained:
        """Reads one."""
        return load_denoiser(path)

    def begun(self, recipe: DenoiserRecipe, first: Trained | None) -> DenoiserTraining:
        """Of the kind of the first."""
        built = {n: getattr(first.recipe, n) for n in ("size", "patch", "frame", "noising")} if first else {}
        recipe = replace(recipe, **built, bf16=fast_halves(torch.device("cpu")))
        return DenoiserTraining(recipe, self.windows, first)

    def resumed(self, kept: Path) -> DenoiserTraining:
        """On the same windows."""
        return DenoiserTraining.resume(kept, self.windows)

    def save(self, out: Path, model: Trained, about: dict) -> None:
        """As ``save_denoiser``, weights as float16."""
        save_denoiser(out, model, about, half=True)

    def measured(self, model: Trained) -> dict[str, float]:
        """Errors of x_0 at five steps, and first their mean."""
        errors = model.errors(self.choose, torch.Generator().manual_seed(0))
        return {CHOSEN: sum(errors.values()) / len(errors)} | errors
