"""All walks of notebook 07, nearly three hours of one core: apart from it, side by side, and on record.

A walk is known by where z begins and by the search that it tunes. ``make_record`` leaves the record; the notebook reads
it, and walks itself where a record is missing or was made by another recipe.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from motionlab import files
from motionlab.checkpoint import SHIPPED
from motionlab.errors import DataError
from motionlab.parallel import run_jobs
from studies.nb07_decoupled import tuning
from studies.nb07_decoupled.trials import Case, reference
from studies.nb07_decoupled.tuning import Choice, Search

Key = tuple[str, str]
#: Where z begins: as the posterior's mean of stage 2, or as single shooting's; fixed, as shooting's.
STAGE_2, GIVEN, FIXED = "stage 2", "single shooting", "shooting, z fixed"


@dataclass(frozen=True)
class Recipe:
    """What the walks have in common.

    seed, clips: of the practice scene. frames: of a clip; with z fixed ``short`` and ``long``. schedule: of the
    fits, by name. search, fixed: evaluations of a search. rounds: looks of a walk at most. steps: K that have a walk.
    scene: its name. prior: digest of the weights of the "compact" priors.
    """

    seed: int
    clips: int
    frames: int
    short: int
    long: int
    schedule: str
    search: int
    fixed: int
    rounds: int
    steps: tuple[int, ...]
    scene: str = "sitting, legs hidden"
    prior: str = field(default_factory=lambda: digest("compact"))


def digest(name: str) -> str:
    """Of the weights of the three shipped priors of a name: 16 digits of SHA-256."""
    files = [SHIPPED / f"{kind}_{name}.safetensors" for kind in ("humor", "pose_prior", "init_gmm")]
    return hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()[:16]


def searches(recipe: Recipe) -> dict[Key, Search]:
    """Every search that is tuned; the walks that take longest come first, by and large."""
    many = {(STAGE_2, name): tuning.l1_of(k) for k, name in reversed(of_steps(recipe.steps).items()) if k > 1}
    fixed = {(FIXED, str(frames)): tuning.FIXED_Z for frames in (recipe.long, recipe.short)}
    given = {(GIVEN, name): search for name, search in tuning.GOOD_Z.items()}
    return many | fixed | given | {(STAGE_2, name): s for name, s in (tuning.SEARCHES | tuning.TURNS).items()}


def of_steps(steps: tuple[int, ...]) -> dict[int, str]:
    """The L1 search with K decoding steps, by name."""
    return {k: "L1" if k == 1 else f"L1, K = {k}" for k in steps}


def walks(
    recipe: Recipe,
    practice: Case,
    fitted: Callable[..., Case],
    *,
    workers: int = 1,
    known: Mapping[Key, Choice] | None = None,
    done: Callable[[dict[Key, Choice]], object] = lambda so_far: None,
) -> dict[Key, Choice]:
    """Where every walk ends; only those are walked that are not ``known``.

    practice: clips with the single-shooting fit. fitted(frames=, solver=): the same scene's clips, of another length
    and by another solver, for walks with z fixed. done: called after every walk with all that there is so far.
    """
    found = {key: choice for key, choice in (known or {}).items() if key in searches(recipe)}
    jobs = {
        key: partial(_fixed, fitted, int(key[1]), search, recipe)
        if key[0] == FIXED
        else partial(tuning.tune, practice, search, recipe.search, rounds=recipe.rounds, start=_start(practice, key[0]))
        for key, search in searches(recipe).items()
        if key not in found
    }
    names = list(jobs)

    def ended(k: int, choice: Choice) -> None:
        found[names[k]] = choice
        done(found)

    if jobs:
        run_jobs(list(jobs.values()), workers, ended)
    return {key: found[key] for key in searches(recipe)}


def _start(practice: Case, source: str) -> dict:
    return practice.start | ({"z": reference(practice)["z"]} if source == GIVEN else {})


def _fixed(fitted: Callable[..., Case], frames: int, search: Search, recipe: Recipe) -> Choice:
    case = fitted(frames=frames, solver="shooting")
    start = case.start | {"z": reference(case)["z"]}
    return tuning.tune(case, search, recipe.fixed, rounds=recipe.rounds, start=start)


# ------------------------------------------------------------------------------------------------------- the record
def save(path: Path | str, recipe: Recipe, found: Mapping[Key, Choice]) -> None:
    """Write walks as JSON, whole; measures that are not finite are null."""
    rows = [
        {
            "z": source, "search": name, "chosen": choice.setting, "ended": choice.ended,
            "seconds": round(choice.seconds, 1), "tried": [_written(row) for row in choice.rows],
        }
        for (source, name), choice in found.items()
    ]  # fmt: skip
    lines = ",\n  ".join(json.dumps(row, allow_nan=False) for row in rows)
    head = json.dumps(asdict(recipe))
    files.write_whole(path, f'{{\n "recipe": {head},\n "walks": [\n  {lines}\n ]\n}}\n')


def _written(row: Mapping[str, float]) -> dict[str, float | None]:
    return {n: float(f"{x:.6g}") if math.isfinite(x) else None for n, x in row.items()}


def load(path: Path | str, recipe: Recipe) -> dict[Key, Choice]:
    """The walks on record; none where there is no file, or one of another recipe. Walks that the recipe does not have
    are left out.

    Raises:
        DataError: another kind of file, or a damaged one.
    """
    if not Path(path).exists():
        return {}
    place, found, wanted = "recipe", {}, searches(recipe)
    try:
        record = json.loads(Path(path).read_text(encoding="utf-8"))
        if Recipe(**record["recipe"] | {"steps": tuple(record["recipe"]["steps"])}) != recipe:
            return {}
        for k, row in enumerate(record["walks"]):
            place = f"walk {k}"
            key = row["z"], row["search"]
            if key in wanted:
                found[key] = _read(row, wanted[key])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        command = f"python -m studies.nb07_decoupled.make_record {path}"
        remedy = f"restore it from version control, or delete it and run make records, or {command}"
        raise DataError(f"not a record of walks ({error!r})", path=path, place=place, remedy=remedy) from error
    return found


def _read(row: Mapping[str, object], search: Search) -> Choice:
    setting = {n: float(row["chosen"][n]) for n in search.begin}
    tried = [{n: math.inf if x is None else float(x) for n, x in one.items()} for one in row["tried"]]
    found = {tuple(one[n] for n in search.begin): one[search.measure] for one in tried}
    if found[tuple(setting.values())] != min(found.values()):
        raise ValueError(f"{row['search']}: something else that was tried is better than what was chosen")
    if not isinstance(row["ended"], bool):
        raise ValueError(f"{row['search']}: ended is {row['ended']!r}")
    return Choice(setting, tried, row["ended"], float(row["seconds"]))
