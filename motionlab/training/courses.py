"""What is trained without end, each by what, on what, and judged how: completers, the thesis's own denoiser and the
transition prior; see ``train_more``."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from motionlab import checkpoint
from motionlab.bench import cases
from motionlab.bench.cases import PersonWindows, by_person, person_windows
from motionlab.bench.judge import CASES, FRAMES, judged
from motionlab.contact import with_contacts
from motionlab.diffusion import completer, features
from motionlab.diffusion.completer import KINDS, Completer, CompleterRecipe
from motionlab.diffusion.denoising import Noise, smoothed
from motionlab.diffusion.model import DenoiserRecipe, MotionDiffusion, load_denoiser, save_denoiser
from motionlab.diffusion.windows import Windows, on_standard
from motionlab.errors import DataError
from motionlab.humor.cvae import Cvae, from_weights, official_weights
from motionlab.humor.quality import quality_row
from motionlab.motion import Motion
from motionlab.training import train_more
from motionlab.training.chain_training import ChainRecipe, ChainTraining, LiveExamples
from motionlab.training.completer_training import CompleterTraining
from motionlab.training.denoiser_training import DenoiserTraining
from motionlab.training.model_card import person_states
from motionlab.training.train_more import learnt_from
from motionlab.training.training_loop import fast_halves

_EACH = 12  # windows of each validation person
LEGS_AND_GAPS = "legs and gaps, cm"  # the mean of the first three cases: error, or energy score of draws
_JUDGED_BY = ("legs hidden", "gap of 30 frames", "gap of 45 frames")
_DRAWS = 3
_NOISES = ((1.0, 0.5), (2.0, 1.0), (5.0, 2.0))  # degrees of joints, centimetres of the root
MEAN_ERROR = "x0 error, mean over steps"
OVER_ASKED = "over what was asked"
#: What was asked of the prior, on either body: shares of what constant velocity leaves, and centimetres.
ASKED = {
    "one step, prior mean": 0.75, "one step, posterior": 0.25, "2 s, posterior z, cm": 5.0, "2 s, closed loop, cm": 2.0,
}  # fmt: skip
_BODIES = "own bones", "standard body"
_MOST = 8  # windows of two seconds of each validation person


class CompleterCourse(train_more.Course):
    """A completer, judged on windows of the validation people. Draws begin with new weights: those of one answer are
    never left behind (docs/experiments.md)."""

    trainer, built = CompleterTraining, ("frames", "size", "layers", "patch")

    def _data(self, folder: Path | str | None) -> tuple[Windows, PersonWindows]:
        windows, takes = learnt_from(folder, FRAMES)
        return windows, person_windows(takes, FRAMES, _EACH)

    def load(self, path: Path) -> Completer:
        """Reads one that draws, or not, as the recipe says."""
        found = completer.load(path)
        if (found.recipe.diffusion, found.recipe.refines) != (self.recipe.diffusion, self.recipe.refines):
            raise DataError(f"not a {self.name}", path=path, remedy="name another --out, or train its kind")
        return found

    save = staticmethod(completer.save)

    def measured(self, model: Completer) -> dict[str, float]:
        """By person, errors on every case; of draws, on validation windows, energy scores and how far apart they are
        over their error. And accelerations over the truth's."""
        if model.recipe.refines:
            return _of_noise(model, self.held)
        row, noised = {}, model.recipe.diffusion
        for name in _JUDGED_BY if noised else CASES:
            draws = torch.Generator().manual_seed(0) if noised else None
            fill = partial(model.complete, generator=draws)
            each = judged(fill, CASES[name], self.held, draws=_DRAWS if noised else 1)
            if noised:
                row[f"{name}, energy score, cm"] = float(each["score"].mean())
                row[f"{name}, spread over error"] = float((each["spread"] / each["cm"]).mean())
            else:
                row[f"{name}, cm"] = float(each["cm"].mean())
            row[f"{name}, acceleration over the truth's"] = float(each["acceleration"].mean())
        aims = [x for name, x in row.items() if name.startswith(_JUDGED_BY) and name.endswith(", cm")]
        return {LEGS_AND_GAPS: sum(aims) / len(aims)} | row


def _of_noise(model: Completer, windows: PersonWindows) -> dict[str, float]:
    """What is left of noise that is new in every frame, and what the smoother alone leaves; first the mean."""
    motion, whose, _ = windows
    nothing = torch.zeros(*motion.root.shape[:2], features.UNITS, dtype=torch.bool)
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


class DenoiserCourse(train_more.Course):
    """A denoiser that is told nothing, of the kind of its first weights."""

    trainer, built = DenoiserTraining, ("size", "patch", "frame", "noising")

    def _data(self, folder: Path | str | None) -> tuple[Windows, Motion]:
        windows, takes = learnt_from(folder, FRAMES)
        return windows, person_windows(takes, FRAMES, _EACH).motion

    load, save = staticmethod(load_denoiser), staticmethod(save_denoiser)

    def measured(self, model: MotionDiffusion) -> dict[str, float]:
        """Errors of x_0 at five steps, and first their mean."""
        errors = model.errors(self.held, torch.Generator().manual_seed(0))
        return {MEAN_ERROR: sum(errors.values()) / len(errors)} | errors


class PriorCourse(train_more.Course):
    """A transition prior: half of its windows are of people's own bones, half of the standard body, which fits use;
    two in three of either on other betas. Held: by body and person, states and contacts (W, 61, ...)."""

    bodies, trainer = len(_BODIES), ChainTraining

    def _data(self, folder: Path | str | None) -> tuple[Windows, dict[str, dict[str, tuple[Tensor, Tensor]]]]:
        windows, takes = learnt_from(folder, self.recipe.length + 2, own=True)
        bodies = takes, [replace(t, motion=on_standard(t.motion)) for t in takes]
        held = {body: person_states(some, most=_MOST) for body, some in zip(_BODIES, bodies, strict=True)}
        if not held[_BODIES[0]]:
            raise DataError("no validation people are there", path=folder, remedy="unpack cmu_library into it")
        return windows, held

    @property
    def examples(self) -> LiveExamples:
        """On other bodies, as states."""
        return LiveExamples(self.windows, self.recipe.length + 1)

    def load(self, path: Path) -> Cvae:
        """Reads one of this kind."""
        found = from_weights(checkpoint.load(path)[0], path, checkpoint.REMEDY)
        if found.direct is None or found.skip is None:
            raise DataError(f"not a {self.name}", path=path, remedy="name another --out")
        return found

    def begun(self, recipe: ChainRecipe, first: Cvae | None) -> ChainTraining:
        """What goes on from weights is never shown the truth between, and has the whole KL divergence at once."""
        if first is not None:
            recipe = replace(recipe, width=first.width, sampling_start=-1.0, sampling_end=0.0, kl_warm_up=1e-6)
        return super().begun(recipe, first)

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
        return {OVER_ASKED: sum(shares) / len(shares)} | row


#: By name of what ships: a completer of one answer, one that corrects what was smoothed, one that draws, which may also
#: be of nothing known; the denoiser; and the prior.
COURSES = {
    "completer": (CompleterCourse, CompleterRecipe()),
    "completer_rough": (CompleterCourse, CompleterRecipe(refines=True, steps=2500)),
    "completer_draws": (
        CompleterCourse, CompleterRecipe(diffusion=True, kinds=(*KINDS, ("nothing", 0.1), ("onward", 0.2)))
    ),
    "diffusion_plain": (DenoiserCourse, DenoiserRecipe(bf16=fast_halves())),
    "transition": (PriorCourse, ChainRecipe()),
}  # fmt: skip
