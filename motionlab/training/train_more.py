"""``python -m motionlab train NAME --more``: trains for days, at the lowest priority, until somebody stops it.

It goes on from the state that is kept in the cache, or else from the weights that ship. Now and then the averaged
weights are judged on the validation people; only better ones are written. After a whole schedule the next one begins
from the best weights, at half the rate. When it is killed, nothing but the last minutes is lost.
"""

import contextlib
import hashlib
import math
import os
from abc import ABC, abstractmethod
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from data_synth import corpus as synthetic
from motionlab import checkpoint, corpus, splits
from motionlab.corpus import Take
from motionlab.diffusion.windows import Windows, gather, on_standard
from motionlab.errors import DataError
from motionlab.training.training_loop import TrainingRun


def learnt_from(folder: Path | str | None, frames: int, *, own: bool = False) -> tuple[Windows, list[Take]]:
    """Returns windows of the training people, and of synthetic ones, drawn by person; and takes of validation people.

    own: every motion also on its own bones; else on the standard body alone.

    Raises:
        DataError: no folder, or nothing usable in it.
    """
    if not folder:
        raise DataError("this model learns from recordings", remedy="name a folder of them with --data")
    found = corpus.assemble(folder, splits.real_sources(folder))
    takes = [t for t in found.part("train") if t.motion.frames >= frames]
    made = [s.motion for s in synthetic.build(version="B").train]
    motions, times = [t.motion for t in takes] + made, 1 + own
    windows = gather(
        [*(motions if own else ()), *map(on_standard, motions)], frames,
        missing=([t.missing for t in takes] + [()] * len(made)) * times,
        people=([t.person for t in takes] + [splits.SYNTHETIC] * len(made)) * times,
    )  # fmt: skip
    return windows, found.part("val")


class Course(ABC):
    """What is trained without end, and what a model of it is worth.

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

    @abstractmethod
    def _data(self, folder: Path | str | None) -> tuple[Windows, Any]:
        """Windows of the folder's training people, and what validation people are."""

    @property
    def examples(self) -> Any:
        """What the run draws from."""
        return self.windows

    @abstractmethod
    def load(self, path: Path) -> Any:
        """Reads a model of this course.

        Raises:
            DataError: it is of another.
        """

    def begun(self, recipe: Any, first: Any) -> TrainingRun:
        """A new run of a recipe, from the weights of a model or None; its ``earlier`` counts the steps behind them."""
        if first is not None:
            recipe = replace(recipe, **{name: getattr(first.recipe, name) for name in self.built})
        return self.trainer(recipe, self.examples, first)

    @abstractmethod
    def measured(self, model: Any) -> dict[str, float]:
        """What a model is worth on the validation people: first what chooses, less is better."""

    @abstractmethod
    def save(self, out: Path, model: Any, about: dict) -> None:
        """Writes a checkpoint."""


def go_on(course: Course, out: Path, *, more: bool = True, every: int = 2500, schedules: int | None = None) -> None:
    """Trains, and writes to ``out`` what is better than what stands there, until Ctrl-C.

    more: go on from the kept state, or from ``out``; False: new weights. every: steps between two judgements; the state
    is kept ten times as often. schedules: how many; None: no end.

    Raises:
        DataError: ``out`` is of another kind of model.
    """
    _give_way()
    best, there, behind, kept = math.inf, None, 0, _kept(course.name, out)
    if out.with_suffix(".safetensors").exists():
        there, behind = course.load(Path(out)), checkpoint.read_recipe(out).get("step", 0)
        best = next(iter(course.measured(there).values()))
        print(f"{out.with_suffix('.safetensors')}: {best:.3f}", flush=True)
    run = _run(course, kept, there if more else None, more)
    if more and there and not run.step:
        run.earlier, run.curve = behind, checkpoint.read_recipe(out).get("curve", [])

    def judge(model: Any) -> dict[str, float]:
        nonlocal best, there, behind
        row = course.measured(model)
        if next(iter(row.values())) < best:
            best, there, behind = next(iter(row.values())), model, run.earlier + run.step
            course.save(out, model, _about(course, run, row))
            print(f"{out.with_suffix('.safetensors')}: {best:.3f}", flush=True)
        return row

    while True:
        run.run(keep=kept, every=max(every // 10, 1), judge=judge, judge_every=every, progress=True)
        schedules = None if schedules is None else schedules - 1
        if schedules == 0:
            return
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


def _give_way() -> None:
    """The lowest priority; of a session that it leads (``setsid``) also against other sessions."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(19)
        if os.getsid(0) == os.getpid():
            Path("/proc/self/autogroup").write_text("19", encoding="ascii")  # of Linux, whose nice ends at a session


def _run(course: Course, kept: Path, there: Any, more: bool) -> TrainingRun:
    """The kept run where there is one on these windows; else a new one. A kept run that is not gone on with is put
    aside."""
    if more and kept.exists():
        try:
            run = course.trainer.resume(kept, course.examples)
            print(f"goes on at step {run.step} of {run.recipe.steps}, as it was begun: {kept}", flush=True)
            return run
        except DataError as error:
            print(f"begins anew: {error}", flush=True)
    if kept.exists():
        kept.replace(kept.with_suffix(".old"))
    return course.begun(replace(course.recipe, lr=course.recipe.lr / 2) if there else course.recipe, there)


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
