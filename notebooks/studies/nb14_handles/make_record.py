"""Trains what notebook 14 compares, seed by seed, and keeps what was measured of it; with ``--ship`` the model itself.

``make records`` runs it; from ``notebooks/``, with $MOTIONLAB_DATA set:
``python -m studies.nb14_handles.make_record results/long/handles.json [--seeds 4 | --ship]``
"""

import argparse
import json
import os
from dataclasses import asdict, replace
from pathlib import Path

import torch

from motionlab import checkpoint, files
from motionlab.diffusion.poses import Poser, PoseRecipe
from motionlab.training import courses
from studies.nb14_handles import people, training, trials

_SMALL = PoseRecipe(size=128, layers=3, steps=3000, batch=128)
#: Handles as an input or not, a loss on their deviation or not; and one answer without noise.
ARMS = {
    "neither": replace(_SMALL, conditioned=False, handle_weight=0.0),
    "loss": replace(_SMALL, conditioned=False),
    "input": replace(_SMALL, handle_weight=0.0),
    "input and loss": _SMALL,
    "input and loss, no noise": replace(_SMALL, diffusion=False),
}
EACH = 48  # poses of a person


def seeded(name: str) -> torch.Generator:
    """The same handles and the same noise for all."""
    return torch.Generator().manual_seed(sum(map(ord, name)))


def ways(model: Poser) -> dict[str, trials.Way]:
    """How a model may be asked."""
    recipe, found = model.recipe, {}
    if recipe.diffusion:
        found["Eq. 4.10"] = trials.inpainted(model, recipe.conditioned)
    if recipe.diffusion and recipe.conditioned:
        found["draw"] = trials.draw(model)
    return found | ({"answer": trials.answer(model)} if recipe.conditioned else {})


def ship(folder: Path) -> None:
    """Trains the model that ships and writes it, with what it is worth on validation people."""
    recipe = PoseRecipe()
    windows, chosen = courses.learnt_from(folder, 1)
    (model,) = training.train([recipe], windows)
    val = people.poses(chosen, EACH)
    tried = {name: trials.tried([way], val, seeded) for name, way in ways(model).items()}
    made_up = float((windows.people[windows.clip] == windows.people.max()).sum()) / windows.fps / 60
    minutes = len(windows.root) / windows.fps / 60
    about = {
        "made by": "python -m studies.nb14_handles.make_record --ship (in notebooks/, one core)",
        "step": recipe.steps, "windows": windows.digest, "torch": torch.__version__,
        "minutes of motion, before mirroring": {"recordings": minutes - made_up, "synthetic": made_up},
        "people": int(windows.people.max()),
        "quality, validation people": {f"{n}, {k}": float(x.mean()) for n, by in tried.items() for k, x in by.items()},
        "recipe": asdict(recipe),
    }  # fmt: skip
    tensors = {n: x if n in ("mean", "scale") else x.half() for n, x in model.state_dict().items()}
    checkpoint.save(checkpoint.SHIPPED / "poser", tensors, about)


def record(folder: Path, path: Path, seeds: int) -> None:
    """Trains and measures all arms on the test people; seeds that are on record of these recipes stay."""
    recipe = {name: asdict(arm) for name, arm in ARMS.items()} | {"poses of a person": EACH}
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    rows = before["rows"] if before.get("recipe") == recipe else []
    left = [seed for seed in range(seeds) if seed not in {row["seed"] for row in rows}]
    if not left:
        return
    windows, test = courses.learnt_from(folder, 1)[0], people.poses(people.takes(folder, "test"), EACH)
    for seed in left:
        models = training.train([replace(arm, seed=seed) for arm in ARMS.values()], windows)
        asked = {(arm, how): way for arm, m in zip(ARMS, models, strict=True) for how, way in ways(m).items()}
        for (arm, how), way in (asked | {("mean pose", "Eq. 4.10"): trials.mean_kept(models[0])}).items():
            found = trials.tried([way], test, seeded, finish=how != "Eq. 4.10")
            rounded = {measure: [round(v, 4) for v in x.tolist()] for measure, x in found.items()}
            rows.append({"seed": seed, "arm": arm, "asked": how} | rounded)
        files.write_whole(path, json.dumps({"recipe": recipe, "rows": rows}) + "\n")
        print(f"seed {seed} is on record", flush=True)


def load(path: Path | str) -> dict[tuple[str, str, str], torch.Tensor]:
    """Reads the record: (arm, asked, measure) -> seeds by people (S, P)."""
    found: dict[tuple[str, str, str], list] = {}
    for row in json.loads(Path(path).read_text(encoding="utf-8"))["rows"]:
        for measure, values in row.items():
            if isinstance(values, list):
                found.setdefault((row["arm"], row["asked"], measure), []).append(values)
    return {key: torch.tensor(values) for key, values in found.items()}


def command() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("record", type=Path, nargs="?", default=Path("results/long/handles.json"))
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--ship", action="store_true")
    options, folder = parser.parse_args(), Path(os.environ["MOTIONLAB_DATA"])
    torch.set_num_threads(1)
    ship(folder) if options.ship else record(folder, options.record, options.seeds)


if __name__ == "__main__":
    command()
