"""Small denoisers that differ in one thing ("arms"), each trained from several seeds: what it measures is kept.

    PYTHONPATH=notebooks python -m studies.shared.small_models frames [losses ...] [--data FOLDER] [--seeds 4]

Each is the thesis's own denoiser, but small. Rows go into ``results/long/small_SET.json`` as each arm ends; an arm that
stands there is not trained again. Weights stay in the cache, by what they were made with, so that sets share arms. A
run that is killed goes on. It works at the lowest priority, on one core.
"""

import argparse
import hashlib
import json
import os
import time
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch

from motionlab import corpus, splits
from motionlab.bench import FRAMES, PersonWindows, person_windows
from motionlab.diffusion.model import LOSS_WEIGHTS, DenoiserRecipe, MotionDiffusion, load_denoiser, save_denoiser
from motionlab.diffusion.windows import Windows
from motionlab.files import write_whole
from motionlab.motion import Motion
from motionlab.training.courses import learnt_from
from motionlab.training.denoiser_training import DenoiserTraining
from studies.shared import small_measures

#: Where rows are kept, from ``notebooks/``.
RECORDS = Path(__file__).parents[2] / "results" / "long"
STEPS, LONGER = 1000, 10  # of the optimiser; times that where somebody stops training
BASE = DenoiserRecipe(size="small", patch=4, steps=STEPS, batch=16, lr=2e-3, warm_up=100, dropout=0.0)
_EACH, _PRACTICE = 12, 6  # windows of a test and of a validation person
_KEEP, _JUDGEMENTS = 250, 20  # steps between two states kept; judgements of a run that is stopped


@dataclass(frozen=True)
class Arm:
    """name, recipe: of what is trained, seed and all. people: of the training people so many, drawn by the seed, and
    no synthetic ones; 0: all of both. stops: judged on its way by the validation people; best and last are kept."""

    name: str
    recipe: DenoiserRecipe
    people: int = 0
    stops: bool = False

    @property
    def digest(self) -> str:
        """Of all that decides the weights, but for the name."""
        return hashlib.sha256(json.dumps(asdict(replace(self, name=""))).encode()).hexdigest()[:12]

    @property
    def kept(self) -> list[str]:
        """The names of what is kept of it."""
        return [f"{self.name}, best", f"{self.name}, last"] if self.stops else [self.name]


def _seeded(seeds: int, *arms: Arm) -> list[Arm]:
    """All arms of the first seed, then of the next: a set that was not run to its end is still paired."""
    return [replace(arm, recipe=replace(arm.recipe, seed=seed)) for seed in range(seeds) for arm in arms]


def _losses(**weights: float) -> DenoiserRecipe:
    return replace(BASE, weights=LOSS_WEIGHTS | weights)


_WORLD = replace(BASE, frame="world")
_FRAMES = (Arm("stuck", BASE), Arm("world", _WORLD), Arm("world, 8 cm", replace(_WORLD, root_unit=0.08)))
SETS: dict[str, list[Arm]] = {
    "frames": _seeded(8, *_FRAMES),
    "longer": _seeded(8, *(replace(arm, recipe=replace(arm.recipe, steps=LONGER * STEPS)) for arm in _FRAMES[:2])),
    "losses": _seeded(
        8, Arm("all", BASE), Arm("no FK", _losses(fk=0.0)), Arm("no velocity", _losses(velocity=0.0)),
        Arm("no contact", _losses(contact=0.0)), Arm("simple", _losses(fk=0.0, velocity=0.0, contact=0.0)),
    ),
    "people": _seeded(8, *(Arm(f"{n} people", BASE, n) for n in (8, 15, 30, 60))),
    "stop": _seeded(8, Arm("8 people, long", replace(BASE, steps=LONGER * STEPS), 8, stops=True)),
    "noising": _seeded(8, *(Arm(f"{n} steps", replace(BASE, noising=n)) for n in (10, 50, 200, 1000))),
}  # fmt: skip


def record(name: str) -> dict:
    """Reads what is kept of a set: "rows", each with "arm", "seed" and what ``small_measures.measured`` found, and
    "beside", of recorded motion."""
    return json.loads((RECORDS / f"small_{name}.json").read_text(encoding="utf-8"))


def paired(name: str, arms: Collection[str]) -> list[dict]:
    """The rows of some arms of a set, of the seeds that all of them have; none where nothing is kept of it."""
    rows = record(name)["rows"] if (RECORDS / f"small_{name}.json").exists() else []
    seeds = set.intersection(*({row["seed"] for row in rows if row["arm"] == arm} for arm in arms))
    return [row for row in rows if row["arm"] in arms and row["seed"] in seeds]


def _of(rows: Sequence[dict], arm: str) -> list[dict]:
    return sorted((row for row in rows if row["arm"] == arm), key=lambda row: row["seed"])


def by_seed(rows: Sequence[dict], arm: str, measure: str) -> torch.Tensor:
    """What an arm measured, a number for each seed (S,), in the order of seeds: of its estimates of x_0, the mean over
    noise and people; or of its samples."""
    if rows and measure in rows[0]["estimates"]:
        return estimates_by_seed(rows, arm, measure).flatten(1).mean(1)
    return torch.tensor([row["samples"][measure] for row in _of(rows, arm)], dtype=torch.float64)


def estimates_by_seed(rows: Sequence[dict], arm: str, measure: str) -> torch.Tensor:
    """What the estimates of x_0 of an arm left, by seed, level of noise and person (S, 5, P)."""
    found = [list(row["estimates"][measure].values()) for row in _of(rows, arm)]
    return torch.tensor(found, dtype=torch.float64)


# ------------------------------------------------------------------------------------------------------------ training
@dataclass(frozen=True, eq=False)
class _Data:
    """windows: to learn from. val: windows (N, T) that stop a run. test: that everything is measured on."""

    windows: Windows
    val: Motion
    test: PersonWindows


def folder() -> Path:
    """Where weights are kept, beside the corpus."""
    found = corpus.cache_folder().with_name("training") / "small"
    found.mkdir(parents=True, exist_ok=True)
    return found


def _of_people(windows: Windows, count: int, seed: int) -> Windows:
    """Windows of so many recorded people, in an order drawn by the seed: fewer are always among more."""
    recorded = int(windows.people.max())  # synthetic people, who are one, come last
    some = torch.randperm(recorded, generator=torch.Generator().manual_seed(seed))[:count]
    mine = torch.isin(windows.people[windows.clip[windows.begins]], some)
    return replace(windows, begins=windows.begins[mine])


def trained(arm: Arm, data: _Data) -> dict[str, MotionDiffusion]:
    """What is kept of an arm, by name; trained where it is not in the cache, or gone on with."""
    paths = {name: folder() / f"{arm.digest}{'-last' * (k > 0)}.safetensors" for k, name in enumerate(arm.kept)}
    if all(path.exists() for path in paths.values()):
        return {name: load_denoiser(path) for name, path in paths.items()}
    windows = _of_people(data.windows, arm.people, arm.recipe.seed) if arm.people else data.windows
    unfinished = folder() / f"{arm.digest}.partial.pt"
    run = DenoiserTraining.resume(unfinished, windows) if unfinished.exists() else DenoiserTraining(arm.recipe, windows)
    ways = {"judge": partial(_judged, data.val), "judge_every": arm.recipe.steps // _JUDGEMENTS} if arm.stops else {}
    run.run(keep=unfinished, every=_KEEP, **ways)
    models = [run.shipped, run.averaged] if arm.stops else [run.averaged]
    for (name, path), model in zip(paths.items(), models, strict=True):
        stopped = {"best": run.best["step"]} if arm.stops else {}
        save_denoiser(path, model, {"arm": name, "curve": run.curve} | stopped)
    unfinished.unlink(missing_ok=True)
    return {name: load_denoiser(path) for name, path in paths.items()}


def _judged(val: Motion, model: MotionDiffusion) -> dict[str, float]:
    """The mean error of x_0 over levels of noise, on windows (N, T)."""
    found = model.errors(val, torch.Generator().manual_seed(0))
    return {"x0 error": sum(found.values()) / len(found)}


def run(name: str, data: _Data, seeds: int | None) -> None:
    """Trains and measures what is not on record of a set, for the first ``seeds`` seeds."""
    path = RECORDS / f"small_{name}.json"
    found = record(name) if path.exists() else {"beside": {}, "rows": []}
    found["beside"] = small_measures.beside(data.test) | found["beside"]
    for arm in SETS[name]:
        if seeds is not None and arm.recipe.seed >= seeds:
            continue
        at = {(row["arm"], row["seed"]): row for row in found["rows"]}
        if all(at.get((kept, arm.recipe.seed), {}).get("recipe") == arm.digest for kept in arm.kept):
            continue
        before = time.process_time()
        for kept, model in trained(arm, data).items():
            row = {"arm": kept, "seed": arm.recipe.seed, "recipe": arm.digest, "steps": arm.recipe.steps}
            row |= small_measures.measured(model, data.test)
            at[kept, arm.recipe.seed] = row
            said = ", ".join(f"{what} {x:.3g}" for what, x in row["samples"].items())
            error, seconds = torch.tensor([*row["estimates"]["x0 error"].values()]).mean(), time.process_time() - before
            print(f"{name}: {kept}, seed {arm.recipe.seed}, {seconds:.0f} s: x0 {error:.3f}, {said}", flush=True)
        found["rows"] = sorted(at.values(), key=lambda row: (row["seed"], row["arm"]))
        _write(path, found)
    if small_measures.PLAIN not in found["beside"]:
        _write(path, found | {"beside": found["beside"] | small_measures.plateau(data.test)})


def _write(path: Path, found: dict) -> None:
    """A row a line, so that a change of one shows as one."""
    lines = ",\n  ".join(json.dumps(row) for row in found["rows"])
    write_whole(path, f'{{\n "beside": {json.dumps(found["beside"])},\n "rows": [\n  {lines}\n ]\n}}\n')


def command(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m studies.shared.small_models", description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", choices=SETS, metavar="SET", help=f"of {', '.join(SETS)}")
    parser.add_argument("--data", default=os.environ.get("MOTIONLAB_DATA"), help="recordings ($MOTIONLAB_DATA)")
    parser.add_argument("--seeds", type=int, help="only the first so many")
    options = parser.parse_args(arguments)
    if not options.data:
        parser.error("these models learn from recordings: name a folder of them with --data")
    torch.set_num_threads(1)
    os.nice(19)
    windows, takes = learnt_from(options.data, FRAMES)
    test = corpus.assemble(options.data, splits.real_sources(options.data)).part("test")
    data = _Data(windows, person_windows(takes, FRAMES, _PRACTICE).motion, person_windows(test, FRAMES, _EACH))
    for name in options.sets:
        run(name, data, options.seeds)


if __name__ == "__main__":
    command()
