"""``motionlab train NAME``: trains for days, at the lowest priority, until somebody stops it; and ``train small``
(``recipes``), which ends.

``--more`` goes on from the state that is kept in the cache, or else from the weights that ship. Now and then the
averaged weights are judged on the validation people; only better ones are written. After a whole schedule the next one
begins from the best weights, at half the rate. When it is killed, nothing but the last minutes is lost.
"""

import argparse
import contextlib
import hashlib
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from motionlab import bench, checkpoint, corpus, splits
from motionlab.baselines import Noise, denoised
from motionlab.bench import CASES, FRAMES, PersonWindows, by_person, judged, person_windows
from motionlab.contact import with_contacts
from motionlab.corpus import Take
from motionlab.diffusion import completer, features
from motionlab.diffusion.completer import KINDS, Completer, CompleterRecipe
from motionlab.diffusion.model import DenoiserRecipe, MotionDiffusion, load_denoiser, save_denoiser
from motionlab.diffusion.windows import Windows, gather, on_standard
from motionlab.errors import DataError
from motionlab.humor import state
from motionlab.humor.priors import Cvae, from_weights, official_weights
from motionlab.training import recipes
from motionlab.training.chain_training import ChainRecipe, ChainTraining
from motionlab.training.completer_training import CompleterTraining
from motionlab.training.denoiser_training import DenoiserTraining
from motionlab.training.quality import quality_row
from motionlab.training.training_loop import TrainingRun, fast_halves

_EACH = 12  # windows of each validation person
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
_WINDOW, _MOST = 61, 8  # frames of a window of two seconds; windows of each validation person


def learnt_from(folder: Path | str | None, frames: int, *, own: bool = False) -> tuple[Windows, list[Take]]:
    """Returns windows of the training people, and of synthetic ones, drawn by person; and takes of validation people.

    own: every motion also on its own bones; else on the standard body alone.

    Raises:
        DataError: no folder, or nothing usable in it.
    """
    found, made = recipes.sources(folder)
    takes = [t for t in found.part("train") if t.motion.frames >= frames]
    motions, times = [t.motion for t in takes] + made, 1 + own
    windows = gather(
        [*(motions if own else ()), *map(on_standard, motions)], frames,
        missing=([t.missing for t in takes] + [()] * len(made)) * times,
        people=([t.person for t in takes] + [splits.SYNTHETIC] * len(made)) * times,
    )  # fmt: skip
    return windows, found.part("val")


def person_states(takes: Sequence[Take], most: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Returns what a prior is judged on: states (W, 61, 339), their velocities of the past, and contacts (W, 61, 9) of
    each person, at most so many windows, evenly through their takes."""
    cuts: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for take in takes:
        whole = state.from_motion(take.motion, causal=True).float(), take.motion.contacts.float()
        starts = range(0, take.motion.frames - _WINDOW + 1, _WINDOW)
        cuts.setdefault(take.person, []).extend(tuple(x[i : i + _WINDOW] for x in whole) for i in starts)
    some = {who: zip(*splits.subsample(mine, most), strict=True) for who, mine in cuts.items() if mine}
    return {who: tuple(torch.stack(x) for x in pairs) for who, pairs in some.items()}


class Course:
    """What is trained without end, and what a model of it is worth (``load``, ``save`` and ``measured`` of each: first
    what chooses, less is better).

    name: of what ships. recipe: of new weights. windows: that it learns from; bodies: on so many each motion is there.
    held: what it is judged on. trainer: its run. built: fields of a recipe that weights decide.
    """

    bodies = 1
    trainer: ClassVar[type[TrainingRun]]
    built: ClassVar[tuple[str, ...]] = ()

    def __init__(self, name: str, recipe: Any, folder: Path | str | None, data: tuple[Windows, Any] | None = None):
        """data: windows and what is held out, instead of the folder's."""
        self.name, self.recipe = name, recipe
        self.windows, self.held = data or self._data(folder)

    def _data(self, folder: Path | str | None) -> tuple[Windows, Any]:
        """Windows of the folder's training people, and of its validation people."""
        windows, takes = learnt_from(folder, FRAMES)
        return windows, person_windows(takes, FRAMES, _EACH)

    def begun(self, recipe: Any, first: Any) -> TrainingRun:
        """A new run of a recipe, from the weights of a model or None; its ``earlier`` counts the steps behind them."""
        if first is not None:
            recipe = replace(recipe, **{name: getattr(first.recipe, name) for name in self.built})
        return self.trainer(recipe, self.windows, first)


class CompleterCourse(Course):
    """A completer, judged on windows of the validation people. Draws begin with new weights: those of one answer are
    never left behind (docs/experiments.md)."""

    trainer, built = CompleterTraining, ("frames", "size", "layers", "patch")

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
        row, draws = {}, _DRAWS if model.recipe.diffusion else 1
        for name in CASES if draws == 1 else _JUDGED_BY:
            fill = partial(model.complete, generator=None if draws == 1 else torch.Generator().manual_seed(0))
            each = judged(fill, CASES[name], self.held, draws=draws)
            found = {"cm": each["cm"]}
            if draws > 1:
                found = {"energy score, cm": each["score"], "spread over error": each["spread"] / each["cm"]}
            found["acceleration over the truth's"] = each["acceleration"]
            row |= {f"{name}, {what}": float(x.mean()) for what, x in found.items()}
        aims = [x for name, x in row.items() if name.startswith(_JUDGED_BY) and name.endswith(", cm")]
        return {"legs and gaps, cm": sum(aims) / len(aims)} | row


def _of_noise(model: Completer, windows: PersonWindows) -> dict[str, float]:
    """What is left of noise that is new in every frame, and what the smoother alone leaves; first the mean."""
    motion, whose, _ = windows
    nothing = torch.zeros(*motion.root.shape[:2], features.UNITS, dtype=torch.bool)
    row, left = {}, []
    for degrees, cm in _NOISES:
        noise = Noise.of(degrees, cm)
        rough = with_contacts(denoised(noise.on(motion, torch.Generator().manual_seed(0)), noise))
        made = model.complete(rough, nothing, tremble=noise.turn)
        mine, alone = (float(by_person(bench.error_cm(m, motion, nothing), whose).mean()) for m in (made, rough))
        title = f"noise of {degrees:g} degrees, {cm:g} cm"
        row |= {f"{title}, cm": mine, f"{title}, smoother alone, cm": alone}
        left.append(mine)
    return {"noise, cm": sum(left) / len(left)} | row


class DenoiserCourse(Course):
    """A denoiser that is told nothing, of the kind of its first weights."""

    trainer, built = DenoiserTraining, ("size", "patch", "frame", "noising")
    load, save = staticmethod(load_denoiser), staticmethod(save_denoiser)

    def measured(self, model: MotionDiffusion) -> dict[str, float]:
        """Errors of x_0 at five steps, and first their mean."""
        errors = model.errors(self.held.motion, torch.Generator().manual_seed(0))
        return {MEAN_ERROR: sum(errors.values()) / len(errors)} | errors


class PriorCourse(Course):
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
        checkpoint.save(out, official_weights(model), about, exact=("skip", "direct"))

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


def go_on(course: Course, out: Path, *, more: bool = True, every: int = 2500) -> Iterator[TrainingRun]:
    """Trains without end, and writes to ``out`` what is better than what stands there; gives the run after each
    schedule.

    more: go on from the kept state, or from ``out``; False: new weights. every: steps between two judgements; the state
    is kept ten times as often.

    Raises:
        DataError: ``out`` is of another kind of model.
    """
    best, there, about, kept, run = math.inf, None, {}, _kept(course.name, out), None
    if out.with_suffix(".safetensors").exists():
        there, about = course.load(out), checkpoint.read_recipe(out)
        best = next(iter(course.measured(there).values()))
        print(f"{out.with_suffix('.safetensors')}: {best:.3f}", flush=True)
    behind = about.get("step", 0)
    if more and kept.exists():
        try:
            run = course.trainer.resume(kept, course.windows)
            print(f"goes on at step {run.step} of {run.recipe.steps}, as it was begun: {kept}", flush=True)
        except DataError as error:
            print(f"begins anew: {error}", flush=True)
    if run is None:
        if kept.exists():
            kept.replace(kept.with_suffix(".old"))
        first = there if more else None
        run = course.begun(replace(course.recipe, lr=course.recipe.lr / 2) if first else course.recipe, first)
        if first:
            run.earlier, run.curve = behind, about.get("curve", [])

    def judge(model: Any) -> dict[str, float]:
        nonlocal best, there, behind
        row = course.measured(model)
        if next(iter(row.values())) < best:
            best, there, behind = next(iter(row.values())), model, run.earlier + run.step
            course.save(out, model, _about(course, run, row))
            print(f"{out.with_suffix('.safetensors')}: {best:.3f}", flush=True)
        return row

    while True:
        yield run.run(keep=kept, every=max(every // 10, 1), judge=judge, judge_every=every, progress=True)
        first, steps = (there, behind) if more else (run.shipped, run.earlier + run.best["step"])
        before, again = run, replace(run.recipe, lr=run.recipe.lr / 2, seed=run.recipe.seed + 1)
        run = course.begun(again, first)
        run.curve, run.earlier = before.curve, steps


def _kept(name: str, out: Path) -> Path:
    """Where the state of a run is kept that writes to ``out``."""
    where = hashlib.sha256(str(Path(out).resolve()).encode()).hexdigest()[:8]
    folder = corpus.cache_folder().with_name("training")
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{name}-{where}.partial.pt"


def _about(course: Course, run: TrainingRun, row: dict[str, float]) -> dict:
    frames = course.windows.people[course.windows.clip].bincount()  # synthetic people come last
    *real, made = (frames / course.windows.fps / 60 / course.bodies).tolist()
    chosen, recipe = next(iter(row)), run.recipe
    curve = [{name: at[name] for name in ("step", "loss", chosen)} for at in run.curve if at.keys() >= {"loss", chosen}]
    return {
        "made by": f"python -m motionlab train {course.name} --more --steps {recipe.steps} --data FOLDER",
        "step": run.earlier + run.step, "recipe": asdict(recipe), "windows": run.digest, "torch": torch.__version__,
        "minutes of motion, before mirroring": {splits.RECORDED: sum(real), splits.SYNTHETIC: made},
        "people": len(real), "quality, validation people": row,
        "curve": [*curve, {"step": run.earlier + run.step, chosen: row[chosen]}],
    }  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """``train``: what is small in minutes, a course until Ctrl-C."""
    name, out = options.model, options.out
    if options.more and name not in COURSES:
        raise DataError(f"{name} takes no --more", remedy=f"it is for {', '.join(COURSES)}")
    if name == "small":
        how = {"seed": options.seed, "steps": options.steps or recipes.STEPS}
        recipes.make_small(options.data, out or checkpoint.SHIPPED, **how)
        return 0
    kind, recipe = COURSES[name]
    recipe = replace(recipe, seed=options.seed, steps=options.steps or recipe.steps)
    try:
        course, every = kind(name, recipe, options.data), min(2500, -(-recipe.steps // 8))
        with contextlib.suppress(OSError, AttributeError):  # some systems know no priority
            os.nice(19)
            if os.getsid(0) == os.getpid():  # Linux weighs sessions first
                Path("/proc/self/autogroup").write_text("19", encoding="ascii")
        for _ in go_on(course, out or checkpoint.SHIPPED / name, more=options.more, every=every):
            pass
    except KeyboardInterrupt:
        print("stopped; the same command with --more goes on")
    return 0
