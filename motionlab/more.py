"""``python -m motionlab train completer``: trains for hours or days, at the lowest priority, until somebody stops it.

It goes on from the state that is kept in the cache, or else from the weights that ship, or else from new ones. Every
half hour the averaged weights are judged on the people who choose; only better ones are written. After a whole schedule
the next one begins from the best weights, at half the rate. Nothing but the time since the last judgement is lost when
it is killed.
"""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import replace
from pathlib import Path

import torch

from data_synth import corpus as synthetic
from motionlab import corpus, splits
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
_JUDGED = 1800.0  # seconds between two judgements


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
    recipe: CompleterRecipe,
    folder: Path | str | None,
    out: Path,
    *,
    command: str,
    more: bool = True,
    data: tuple[Windows, PersonWindows] | None = None,
    judge_every: int | None = None,
    schedules: int | None = None,
) -> None:
    """Trains, and writes to ``out`` what is better than what stands there, until Ctrl-C.

    more: go on from the kept state or from ``out``; False: new weights. data: instead of the folder's. judge_every:
    steps; None: as many as take half an hour. schedules: how many; None: no end.
    """
    _give_way()
    windows, choose = data or learnt_from(folder)
    kept = corpus.cache_folder().with_name("training") / f"{out.stem}.partial.pt"
    kept.parent.mkdir(parents=True, exist_ok=True)
    shipped = completer.load(out) if more and out.with_suffix(".safetensors").exists() else None
    best = on_people(shipped, choose)[CHOSEN] if shipped else float("inf")
    run = _run(recipe, windows, kept if more else None, shipped)
    while schedules is None or schedules > 0:
        if run.step >= run.recipe.steps:  # the next schedule, from the best weights, at half the rate
            schedules = None if schedules is None else schedules - 1
            again = replace(run.recipe, lr=run.recipe.lr / 2, seed=run.recipe.seed + 1)
            before, run = run, CompleterTraining(again, windows, run.shipped)
            run.best, run.curve = before.best, before.curve
            continue
        every = judge_every or _in_half_an_hour(run)

        def judge(model: Completer) -> dict[str, float]:
            nonlocal best
            row = on_people(model, choose)
            if row[CHOSEN] < best:
                best = row[CHOSEN]
                completer.save(out, model, _about(run, row, command))  # noqa: B023
                print(f"{out.with_suffix('.safetensors')}: {best:.3f} cm", flush=True)
            return row

        run.run(keep=kept, every=every, judge=judge, judge_every=every, progress=True)


def _give_way() -> None:
    """The lowest priority, among the programs of this session and against other sessions."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(19)
        Path("/proc/self/autogroup").write_text("19", encoding="ascii")  # of Linux, whose nice ends at a session


def _run(recipe: CompleterRecipe, windows: Windows, kept: Path | None, first: Completer | None) -> CompleterTraining:
    """The kept run where there is one on these windows; else a new one."""
    if kept is not None and kept.exists():
        try:
            run = CompleterTraining.resume(kept, windows)
            print(f"goes on at step {run.step} of {run.recipe.steps}: {kept}", flush=True)
            return run
        except DataError as error:
            print(f"begins anew: {error}", flush=True)
    if first is None:
        return CompleterTraining(recipe, windows)
    built = {name: getattr(first.recipe, name) for name in ("frames", "size", "layers", "patch", "noised")}
    return CompleterTraining(replace(recipe, lr=recipe.lr / 2, **built), windows, first)


def _in_half_an_hour(run: CompleterTraining) -> int:
    """Steps of half an hour, from the time that five take."""
    run.advance()
    began = time.perf_counter()
    for _ in range(5):
        run.advance()
    return max(round(5 * _JUDGED / (time.perf_counter() - began)), 1)


def _about(run: CompleterTraining, row: dict[str, float], command: str) -> dict:
    return {
        "made by": command, "step": run.step, "windows": run.digest, "torch": torch.__version__,
        "minutes of motion, before mirroring": {"all": run.windows.minutes},
        "people": int(run.windows.people.max()), "quality, people who choose": row,
        "curve": [*run.curve, {"step": run.step, **row}],
    }  # fmt: skip
