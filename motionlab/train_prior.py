"""What the transition prior is trained on, without end, and judged by; see ``train_more``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from motionlab import checkpoint, train_more
from motionlab.diffusion.windows import Windows, on_standard
from motionlab.errors import DataError
from motionlab.humor.chain_training import ChainRecipe, ChainTraining
from motionlab.humor.cvae import Cvae, from_weights, official_weights
from motionlab.humor.examples import LiveExamples
from motionlab.humor.quality import quality_row
from motionlab.models import person_states
from motionlab.train_more import learnt_from

RECIPES = {"transition": ChainRecipe()}  # by name of what ships
CHOSEN = "over what was asked"
#: What was asked, on either body: shares of what constant velocity leaves, and centimetres.
ASKED = {
    "one step, prior mean": 0.75, "one step, posterior": 0.25, "2 s, posterior z, cm": 5.0, "2 s, closed loop, cm": 2.0,
}  # fmt: skip
_BODIES = "own bones", "standard body"
_MOST = 8  # windows of two seconds of each person who chooses


class Course(train_more.Course):
    """A transition prior: half of its windows are of people's own bones, half of the standard body, which fits use;
    two in three of either on other betas."""

    bodies = len(_BODIES)

    def __init__(
        self,
        name: str,
        recipe: ChainRecipe,
        folder: Path | str | None,
        data: tuple[Windows, dict[str, dict[str, tuple[Tensor, Tensor]]]] | None = None,
    ) -> None:
        """data: instead of the folder's; what it is judged on by body and person, states and contacts (W, 61, ...)."""
        self.name, self.recipe = name, recipe
        if data is None:
            windows, takes = learnt_from(folder, recipe.length + 2, own=True)
            bodies = takes, [replace(t, motion=on_standard(t.motion)) for t in takes]
            held = {body: person_states(some, most=_MOST) for body, some in zip(_BODIES, bodies, strict=True)}
            if not held[_BODIES[0]]:
                raise DataError("nobody who chooses is there", path=folder, remedy="unpack cmu_library into it")
            data = windows, held
        self.windows, self.held = data
        self.examples = LiveExamples(self.windows, recipe.length + 1)

    def load(self, path: Path) -> Cvae:
        """Reads one of this kind."""
        found = from_weights(checkpoint.load(path)[0], path, checkpoint.REMEDY)
        if found.direct is None or found.skip is None:
            raise DataError(f"not a {self.name}", path=path, remedy="name another --out")
        return found

    def begun(self, recipe: ChainRecipe, first: Cvae | None) -> ChainTraining:
        """What goes on from weights is never shown the truth between, and has the whole KL divergence at once."""
        if first is not None:
            recipe = replace(recipe, width=first.width, supervised=-1.0, sampled=0.0, annealed=1e-6)
        return ChainTraining(recipe, self.examples, first)

    def resumed(self, kept: Path) -> ChainTraining:
        """On the same windows."""
        return ChainTraining.resume(kept, self.examples)

    def save(self, out: Path, model: Cvae, about: dict) -> None:
        """Weights as float16, but those of linear layers that begin as something exact."""
        tensors = official_weights(model).items()
        exact = ("skip", "direct")
        checkpoint.save(out, {n: x if n.startswith(exact) else x.half() for n, x in tensors}, about)

    def measured(self, model: Cvae) -> dict[str, float]:
        """``quality_row`` on either body, a mean over people, and first the mean of what was asked over ``ASKED``."""
        row, shares = {}, []
        for body, people in self.held.items():
            each = [quality_row(model, *windows) for windows in people.values()]
            found = {name: float(torch.tensor([float(r[name]) for r in each]).nanmean()) for name in each[0]}
            for name, asked in ASKED.items():
                unit = 1.0 if name.endswith(", cm") else found["one step, constant velocity, cm"]
                shares.append(found[name.removesuffix(", cm") + ", cm"] / unit / asked)
            row |= {f"{body}: {name}": value for name, value in found.items()}
        return {CHOSEN: sum(shares) / len(shares)} | row
