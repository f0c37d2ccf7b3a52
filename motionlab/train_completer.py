"""What completers are trained on, without end, and judged by; see ``train_more``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from motionlab import train_more
from motionlab.bench import cases
from motionlab.bench.judge import CASES, FRAMES, Case, energy_score, judged
from motionlab.bench.person_windows import PersonWindows, by_person, person_windows
from motionlab.contact import with_contacts
from motionlab.diffusion import completer, state
from motionlab.diffusion.completer import KINDS, Completer, CompleterRecipe
from motionlab.diffusion.completer_training import CompleterTraining
from motionlab.diffusion.denoising import Noise, smoothed
from motionlab.diffusion.windows import Windows
from motionlab.errors import DataError
from motionlab.train_more import learnt_from

#: By name of what ships: one answer, and draws, which may also be of nothing known.
RECIPES = {
    "completer": CompleterRecipe(),
    "completer_rough": CompleterRecipe(rough=True, steps=2500),
    "completer_draws": CompleterRecipe(noised=True, kinds=(*KINDS, ("nothing", 0.1), ("onward", 0.2))),
}
CHOSEN = "legs and gaps, cm"  # the mean of the first three cases, which chooses: error, or energy score of draws
_CHOOSING = ("legs hidden", "gap of 30 frames", "gap of 45 frames")
_EACH = 12  # windows of each person who chooses
_DRAWS = 3
_NOISES = ((1.0, 0.5), (2.0, 1.0), (5.0, 2.0))  # degrees of joints, centimetres of the root


class Course(train_more.Course):
    """A completer, judged on windows of the people who choose. Draws begin with new weights: those of one answer are
    never left behind (docs/experiments.md)."""

    def __init__(
        self,
        name: str,
        recipe: CompleterRecipe,
        folder: Path | str | None,
        data: tuple[Windows, PersonWindows] | None = None,
    ) -> None:
        """data: instead of the folder's."""
        self.name, self.recipe = name, recipe
        if data is None:
            windows, takes = learnt_from(folder, FRAMES)
            data = windows, person_windows(takes, FRAMES, _EACH)
        self.windows, self.choose = data

    def load(self, path: Path) -> Completer:
        """Reads one that draws, or not, as the recipe says."""
        found = completer.load(path)
        if (found.recipe.noised, found.recipe.rough) != (self.recipe.noised, self.recipe.rough):
            raise DataError(f"not a {self.name}", path=path, remedy="name another --out, or train its kind")
        return found

    def begun(self, recipe: CompleterRecipe, first: Completer | None) -> CompleterTraining:
        """Of the size of the first."""
        if first is not None:
            built = {name: getattr(first.recipe, name) for name in ("frames", "size", "layers", "patch")}
            recipe = replace(recipe, **built)
        return CompleterTraining(recipe, self.windows, first)

    def resumed(self, kept: Path) -> CompleterTraining:
        """On the same windows."""
        return CompleterTraining.resume(kept, self.windows)

    def save(self, out: Path, model: Completer, about: dict) -> None:
        """As ``completer.save``."""
        completer.save(out, model, about)

    def measured(self, model: Completer) -> dict[str, float]:
        """By person, errors on every case; of draws, on those that choose, energy scores and how far apart they are
        over their error. And accelerations over the truth's."""
        if model.recipe.rough:
            return _of_noise(model, self.choose)
        row = {}
        for name, case in CASES.items():
            if not model.recipe.noised:
                each = judged(model.complete, case, self.choose)
                row[f"{name}, cm"] = float(each["cm"].mean())
            elif name in _CHOOSING:
                each = _of_draws(model, case, self.choose)
                row[f"{name}, energy score, cm"] = float(each["score"].mean())
                row[f"{name}, spread over error"] = float((each["spread"] / each["cm"]).mean())
            else:
                continue
            row[f"{name}, acceleration over the truth's"] = float(each["acceleration"].mean())
        choose = [x for name, x in row.items() if name.startswith(_CHOOSING) and name.endswith(", cm")]
        return {CHOSEN: sum(choose) / len(choose)} | row


def _of_noise(model: Completer, windows: PersonWindows) -> dict[str, float]:
    """What is left of noise that is new in every frame, and what the smoother alone leaves; first the mean."""
    motion, whose, _ = windows
    nothing = torch.zeros(*motion.root.shape[:2], state.UNITS, dtype=torch.bool)
    row, left = {}, []
    for degrees, cm in _NOISES:
        noise = Noise.of(degrees, cm)
        rough = with_contacts(smoothed(noise.on(motion, torch.Generator().manual_seed(0)), noise))
        made = model.complete(rough, nothing, tremble=noise.turn)
        mine, alone = (float(by_person(cases.error_cm(m, motion, nothing), whose).mean()) for m in (made, rough))
        title = f"noise of {degrees:g} degrees, {cm:g} cm"
        row |= {f"{title}, cm": mine, f"{title}, smoother alone, cm": alone}
        left.append(mine)
    return {"noise, cm": sum(left) / len(left)} | row


def _of_draws(model: Completer, case: Case, windows: PersonWindows) -> dict[str, Tensor]:
    """What becomes of a case's windows in ``_DRAWS`` draws, by person (P,)."""
    motion, whose, lacks = windows
    known, generator = case.mask(len(motion.root)), torch.Generator().manual_seed(0)
    made = [
        cases.pasted(model.complete(motion, known & ~lacks, generator), motion, known | lacks) for _ in range(_DRAWS)
    ]
    error = torch.stack([cases.error_cm(m, motion, known, case.joints) for m in made]).mean(0)
    score = energy_score(made, motion, known, case.joints)
    found = {
        "score": score, "cm": error, "spread": 2 * (error - score),
        "acceleration": torch.stack([cases.acceleration_ratio(m, motion) for m in made]).mean(0),
    }  # fmt: skip
    return {name: by_person(x, whose) for name, x in found.items()}
