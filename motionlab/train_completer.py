"""``python -m motionlab train completer --more``: trains for days, at the lowest priority, until somebody stops it.

It goes on from the state that is kept in the cache, or else from the weights that ship. Now and then the averaged
weights are judged on the people who choose; only better ones are written. After a whole schedule the next one begins
from the best weights, at half the rate. When it is killed, nothing but the last minutes is lost.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
from dataclasses import replace
from pathlib import Path

import torch

from data_synth import corpus as synthetic
from motionlab import checkpoint, corpus, splits
from motionlab.bench.judge import CASES, FRAMES, judged
from motionlab.bench.person_windows import PersonWindows, person_windows
from motionlab.diffusion import completer
from motionlab.diffusion.completer import Completer, CompleterRecipe
from motionlab.diffusion.completer_training import CompleterTraining
from motionlab.diffusion.windows import Windows, gather, on_standard
from motionlab.errors import DataError

#: By name of what ships: one answer, and draws.
RECIPES = {"completer": CompleterRecipe(), "completer_draws": CompleterRecipe(noised=True)}
CHOSEN = "legs and gaps, cm"  # the mean error of the first three cases, which chooses
_CHOOSING = ("legs hidden", "gap of 30 frames", "gap of 45 frames")
_EACH = 12  # windows of each person who chooses
_EVERY = 2500  # steps between two judgements: half an hour of a slow core


def learnt_from(folder: Path | str | None) -> tuple[Windows, PersonWindows]:
    """Returns windows of the people who train, and of synthetic ones, drawn by person; and of the people who choose.

    Raises:
        DataError: no folder, or nothing usable in it.
    """
    if not folder:
        raise DataError("this model learns from recordings", remedy="name a folder of them with --data")
    found = corpus.assemble(folder, splits.real_sources(folder))
    takes = [t for t in found.part("train") if t.motion.frames >= FRAMES]
    made = [s.motion for s in synthetic.build(version="B").train]
    motions = [on_standard(m) for m in (*(t.motion for t in takes), *made)]
    whose = [t.person for t in takes] + [splits.SYNTHETIC] * len(made)
    windows = gather(motions, FRAMES, missing=[t.missing for t in takes] + [()] * len(made), people=whose)
    return windows, person_windows(found.part("choose"), FRAMES, _EACH)


def on_people(model: Completer, windows: PersonWindows) -> dict[str, float]:
    """Measures a completer on every case, by person: the mean that chooses first, then errors and accelerations."""
    row = {}
    for name, case in CASES.items():
        each = judged(model.complete, case, windows)
        row[f"{name}, cm"] = float(each["cm"].mean())
        row[f"{name}, acceleration over the truth's"] = float(each["acceleration"].mean())
    return {CHOSEN: sum(row[f"{name}, cm"] for name in _CHOOSING) / len(_CHOOSING)} | row


def go_on(
    name: str,
    recipe: CompleterRecipe,
    folder: Path | str | None,
    out: Path,
    *,
    more: bool = True,
    data: tuple[Windows, PersonWindows] | None = None,
    every: int = _EVERY,
    schedules: int | None = None,
) -> None:
    """Trains, and writes to ``out`` what is better than what stands there, until Ctrl-C.

    name: of ``RECIPES``. more: go on from the kept state, or from ``out``; False: new weights. data: instead of the
    folder's. every: steps between two judgements; the state is kept ten times as often. schedules: how many; None: no
    end.

    Raises:
        DataError: nothing to learn from, or ``out`` is of another kind of model.
    """
    _give_way()
    windows, choose = data or learnt_from(folder)
    best, there = math.inf, None
    if out.with_suffix(".safetensors").exists():
        there = completer.load(Path(out))
        best = on_people(there, choose)[CHOSEN]
        print(f"{out.with_suffix('.safetensors')}: {best:.3f} cm", flush=True)
        if there.recipe.noised != recipe.noised:
            raise DataError(f"not a {name}", path=out, remedy="name another --out, or train its kind")
    run = _run(recipe, windows, _kept(name, out), there if more else None, more)
    if more and there and not run.step:
        run.earlier = checkpoint.read_recipe(out).get("step", 0)

    def judge(model: Completer) -> dict[str, float]:
        nonlocal best, there
        row = on_people(model, choose)
        if row[CHOSEN] < best:
            best, there = row[CHOSEN], model
            completer.save(out, model, _about(name, run, row))
            print(f"{out.with_suffix('.safetensors')}: {best:.3f} cm", flush=True)
        return row

    while schedules is None or schedules > 0:
        run.run(keep=_kept(name, out), every=max(every // 10, 1), judge=judge, judge_every=every, progress=True)
        schedules = None if schedules is None else schedules - 1
        again = replace(run.recipe, lr=run.recipe.lr / 2, seed=run.recipe.seed + 1)
        before, run = run, CompleterTraining(again, windows, there or run.averaged)
        run.curve, run.earlier = before.curve, before.earlier + before.step


def _kept(name: str, out: Path) -> Path:
    """Where the state of a run is kept that writes to ``out``."""
    where = hashlib.sha256(str(Path(out).resolve()).encode()).hexdigest()[:8]
    folder = corpus.cache_folder().with_name("training")
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{name}-{where}.partial.pt"


def _give_way() -> None:
    """The lowest priority, among the programs of this session and against other sessions."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(19)
        Path("/proc/self/autogroup").write_text("19", encoding="ascii")  # of Linux, whose nice ends at a session


def _run(
    recipe: CompleterRecipe, windows: Windows, kept: Path, first: Completer | None, more: bool
) -> CompleterTraining:
    """The kept run where there is one on these windows; else a new one. A kept run that is not gone on with is put
    aside."""
    if more and kept.exists():
        try:
            run = CompleterTraining.resume(kept, windows)
            print(f"goes on at step {run.step} of {run.recipe.steps}, as it was begun: {kept}", flush=True)
            return run
        except DataError as error:
            print(f"begins anew: {error}", flush=True)
    if kept.exists():
        kept.replace(kept.with_suffix(".old"))
    if first is None:
        return CompleterTraining(recipe, windows)
    built = {name: getattr(first.recipe, name) for name in ("frames", "size", "layers", "patch")}
    return CompleterTraining(replace(recipe, lr=recipe.lr / 2, **built), windows, first)


def _about(name: str, run: CompleterTraining, row: dict[str, float]) -> dict:
    windows, recipe = run.windows, run.recipe
    *real, made = (windows.people[windows.clip].bincount() / windows.fps / 60).tolist()  # synthetic people come last
    return {
        "made by": f"python -m motionlab train {name} --more --steps {recipe.steps} --data FOLDER",
        "step": run.earlier + run.step, "windows": run.digest, "torch": torch.__version__,
        "minutes of motion, before mirroring": {splits.RECORDED: sum(real), splits.SYNTHETIC: made},
        "people": len(real), "quality, people who choose": row, "curve": [*run.curve, {"step": run.step, **row}],
    }  # fmt: skip
