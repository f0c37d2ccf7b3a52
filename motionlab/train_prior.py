"""What the transition prior is trained on, without end, and judged by; see ``train_more``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torch import Tensor

from motionlab import checkpoint, splits, train_more
from motionlab.diffusion.windows import Windows, on_standard
from motionlab.humor import pretrained
from motionlab.humor.chain_training import ChainRecipe, ChainTraining
from motionlab.humor.cvae import Cvae, official_weights
from motionlab.humor.examples import LiveExamples
from motionlab.humor.training import quality_row
from motionlab.train_more import learnt_from

RECIPES = {"transition": ChainRecipe()}  # by name of what ships
CHOSEN = "over what was asked"
#: What was asked, on either body: shares of what constant velocity leaves, and centimetres.
ASKED = {
    "one step, prior mean": 0.75, "one step, posterior": 0.25, "2 s, posterior z, cm": 5.0, "2 s, closed loop, cm": 2.0,
}  # fmt: skip
_BODIES = "own bones", "standard body"
_MOST = 96  # windows of two seconds, of all who choose


class Course(train_more.Course):
    """A transition prior: half of its windows on people's own bones, half on the standard body, which fits use."""

    bodies = len(_BODIES)

    def __init__(
        self,
        name: str,
        recipe: ChainRecipe,
        folder: Path | str | None,
        data: tuple[Windows, dict[str, tuple[Tensor, Tensor]]] | None = None,
    ) -> None:
        """data: instead of the folder's; what it is judged on by body, states (W, 61, 339) and contacts (W, 61, 9)."""
        self.name, self.recipe = name, recipe
        if data is None:
            windows, takes = learnt_from(folder, recipe.length + 2, own=True)
            motions = [t.motion for t in takes]
            bodies = dict(zip(_BODIES, (motions, [on_standard(m) for m in motions]), strict=True))
            held = {body: splits.state_windows(some, most=_MOST, causal=True) for body, some in bodies.items()}
            data = windows, held
        self.windows, self.held = data
        self.examples = LiveExamples(self.windows, recipe.length + 1)

    def load(self, path: Path) -> Cvae:
        """Reads a prior."""
        return pretrained.load_motion_prior(str(path))

    def begun(self, recipe: ChainRecipe, first: Cvae | None) -> ChainTraining:
        """What goes on from weights is never shown the truth between, and begins with the whole KL divergence."""
        if first is not None:
            recipe = replace(recipe, width=first.width, supervised=0.0, sampled=1e-6, annealed=1e-6)
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
        """``quality_row`` on either body, and first the mean of what was asked over ``ASKED``."""
        row, shares = {}, []
        for body, held in self.held.items():
            found = quality_row(model, *held)
            for name, asked in ASKED.items():
                unit = 1.0 if name.endswith(", cm") else found["one step, constant velocity, cm"]
                shares.append(found[name.removesuffix(", cm") + ", cm"] / unit / asked)
            row |= {f"{body}: {name}": value for name, value in found.items()}
        return {CHOSEN: sum(shares) / len(shares)} | row
