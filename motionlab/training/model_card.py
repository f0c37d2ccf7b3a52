"""How good the transition priors are on people nobody trained on, and the table of all models that ship.

python -m motionlab models --data FOLDER    # measures on ``test`` people, into the recipes; minutes
python -m motionlab models                  # writes checkpoints/README.md from the recipes
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from motionlab import checkpoint, corpus, splits
from motionlab.diffusion.windows import on_standard
from motionlab.errors import DataError
from motionlab.files import write_whole
from motionlab.humor import pretrained, quality
from motionlab.humor.cvae import Cvae
from motionlab.humor.rollout import sample_rollout
from motionlab.humor.state import unpack
from motionlab.metrics import interval
from motionlab.motion import FPS, Motion

PRIORS = "humor_*", "transition"  # patterns of their names
#: Where the measurements stand in a recipe.
REPORT = "people nobody trained on"
BODIES = "", "standard body: "  # before a measure: people's own bones, and what fits use
#: What the table shows of a prior.
_SHOWN = (
    "one step, prior mean, cm", "one step, posterior, cm", "one step, constant velocity, cm",
    "one step, posterior, contact F1", "contact F1, as one frame before", "2 s, posterior z, cm",
    "2 s, closed loop, cm", "2 s, best of 8 samples, cm", "2 s, prior mean, cm", "2 s, hold, cm", "kl, nats",
    "effective rank", "samples' bones", "samples' acceleration", "data's acceleration", "samples' slide",
    "data's slide", "walkers who go on", "data's walkers who go on",
)  # fmt: skip
_MOST = 24  # windows of two seconds per person
_WALKING = 0.5  # m/s: who is faster over a whole window walks
_CREDIT = (
    "Some of these weights learnt from the CMU Graphics Lab Motion Capture Database: the data used in this project was "
    "obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217."
)


def judge_prior(name: str, folder: Path | str) -> dict[str, dict[str, float]]:
    """Computes what a transition prior that ships does on the people of ``test``.

    Every person counts alike, with at most 24 windows of two seconds. The result also goes into the prior's recipe.

    Returns:
        by measure (``quality.quality_row``, the share of walkers who still walk after two seconds), on people's own
        bones and on the standard body: the mean over people, the ends of its 95 % interval by bootstrap over people,
        and how many there are.
    Raises:
        DataError: nobody of ``test`` is in the folder.
    """
    model = pretrained.load_motion_prior(name)
    takes = corpus.assemble(folder, splits.real_sources(folder)).part("test")
    found = {}
    for body in BODIES:
        some = [replace(t, motion=on_standard(t.motion)) for t in takes] if body else takes
        rows = list(person_rows(model, person_states(some)).values())
        if not rows:
            raise DataError("nobody of ``test`` is there", path=folder, remedy="unpack cmu_library into it")
        for measure in rows[0]:
            values = torch.tensor([row[measure] for row in rows])
            values = values[values.isfinite()]
            mean, low, high = interval(values, "mean", torch.Generator().manual_seed(0))
            found[body + measure] = {"mean": mean, "low": low, "high": high, "people": len(values)}
    path = checkpoint.SHIPPED / f"{name}.json"
    write_whole(path, json.dumps(checkpoint.read_recipe(path) | {REPORT: found}, indent=1) + "\n")
    return found


def person_states(takes: Sequence[corpus.Take], most: int = _MOST) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Returns what a prior is judged on: states (W, 61, 339), their velocities of the past, and contacts (W, 61, 9) of
    each person."""
    people: dict[str, list[Motion]] = {}
    for take in takes:
        people.setdefault(take.person, []).append(take.motion)
    found = {who: splits.state_windows(motions, most=most) for who, motions in people.items()}
    return {who: windows for who, windows in found.items() if len(windows[0])}


def person_rows(
    model: Cvae, people: Mapping[str, tuple[torch.Tensor, torch.Tensor]], seed: int = 0
) -> dict[str, dict[str, float]]:
    """Computes the measures of ``judge_prior`` of each person: means over states (W, T, 339), contacts (W, T, 9)."""
    return {
        who: quality.quality_row(model, *windows, seed) | _walkers(model, windows[0], seed)
        for who, windows in people.items()
    }


@torch.no_grad()
def _walkers(model: Cvae, states: torch.Tensor, seed: int) -> dict[str, float]:
    """Of windows in which a person walks, the share whose samples still do in the last half second, and who do so."""

    def over_floor(states: torch.Tensor) -> torch.Tensor:  # (W, T - 1) of the pelvis, m/s
        return unpack(states)["joints"][:, :, 0, :2].diff(dim=1).norm(dim=-1) * FPS

    speed = over_floor(states)
    walking = speed.mean(1) > _WALKING
    names = "walkers who go on", "data's walkers who go on"
    if not walking.any():
        return dict.fromkeys(names, float("nan"))
    first, generator = states[walking, 0], torch.Generator().manual_seed(seed)
    made = sample_rollout(model, first, states.shape[1] - 1, generator=generator).states
    least = 0.5 * speed[walking].mean(1)
    still = (over_floor(made)[:, -15:].mean(1) > least, speed[walking, -15:].mean(1) > least)
    return {name: float(each.float().mean()) for name, each in zip(names, still, strict=True)}


def _models_table() -> str:
    """Returns the table of the models that ship, from their recipes: Markdown."""
    rows = []
    for path in sorted(checkpoint.SHIPPED.glob("*.json")):
        recipe = checkpoint.read_recipe(path)
        frames = recipe.get("data", {})  # at 30 a second, where no minutes were written down
        minutes = recipe.get("minutes of motion, before mirroring", {k: n / 1800 for k, n in frames.items()})
        steps = recipe.get("step", recipe.get("recipe", {}).get("steps", recipe.get("steps", "")))
        rows.append({
            "model": path.stem, "MB": f"{path.with_suffix('.safetensors').stat().st_size / 1e6:.1f}",
            "real, h": f"{minutes.get('recordings', 0) / 60:.1f}",
            "synthetic, h": f"{minutes.get('synthetic', 0) / 60:.1f}",
            "people": str(recipe.get("people", "")), "steps": str(steps),
            "made by": f"`{recipe.get('made by') or recipe.get('command', '')}`",
        })  # fmt: skip
    return _markdown(rows)


def _quality_table(kinds: Sequence[str], shown: Sequence[str] | None = None) -> str:
    """Returns what models do on people nobody trained on, side by side: Markdown. kinds: patterns of their names.
    shown: these measures alone, on either body."""
    found = {
        path.stem: recipe[REPORT]
        for kind in kinds for path in sorted(checkpoint.SHIPPED.glob(f"{kind}.json"))
        if REPORT in (recipe := checkpoint.read_recipe(path))
    }  # fmt: skip
    measures = dict.fromkeys(name for each in found.values() for name in each)
    if shown:
        measures = [body + name for body in BODIES for name in shown if body + name in measures]
    return _markdown(
        [{"": measure} | {name: _cell(each.get(measure)) for name, each in found.items()} for measure in measures]
    )


def _contest(found: Mapping[str, Mapping[str, float]]) -> str:
    """Returns what was found on test people, "case; who; what": a table for each what."""
    text, keys = "", [name.split("; ") for name in found]
    for what in dict.fromkeys(what for _, _, what in keys):
        cases, people = (dict.fromkeys(key[k] for key in keys if key[2] == what) for k in (0, 1))
        rows = [{"": who} | {case: _cell(found.get(f"{case}; {who}; {what}")) for case in cases} for who in people]
        text += f"**{what[0].upper()}{what[1:]}**\n\n{_markdown(rows)}\n\n"
    return text and f"## Completers and their rivals (notebook 12 measures them anew)\n\n{text}"


def _cell(found: Mapping[str, float] | None) -> str:
    return "" if found is None else f"{found['mean']:.3g} [{found['low']:.3g}, {found['high']:.3g}]"


def _markdown(rows: list[dict[str, str]]) -> str:
    if not rows:
        return ""
    lines = [f"| {' | '.join(cells)} |" for cells in (rows[0], *(row.values() for row in rows))]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def write_readme() -> Path:
    """Writes ``checkpoints/README.md``: the models, and how they do; returns its path."""
    path = checkpoint.SHIPPED / "README.md"
    text = "# Models\n\nMade by `python -m motionlab models` from the recipes beside the weights.\n\n"
    text += f"{_models_table()}\n\n`train humor` and `--preset` are gone: today `train transition`, `train small`.\n\n"
    text += "## Transition priors on people nobody trained on\n\nMean over people and its 95 % interval, by bootstrap "
    text += f"over people.\n\n{_quality_table(PRIORS, _SHOWN)}\n\n"
    if (completer := checkpoint.SHIPPED / "completer.json").exists():
        text += _contest(checkpoint.read_recipe(completer).get(REPORT, {}))
    if table := _quality_table(["completer_draws", "diffusion_*"]):
        text += f"## Generation in 250 steps, when it shipped (notebook 11 takes 1000, of other windows)\n\n{table}\n\n"
    write_whole(path, f"{text}Licence: MIT, as the project's. {_CREDIT}\n")
    return path


def run(options: argparse.Namespace) -> int:
    """``models``: writes the table; with recordings, measures the transition priors first."""
    for kind in PRIORS if options.data else ():
        for path in sorted(checkpoint.SHIPPED.glob(f"{kind}.json")):
            judge_prior(path.stem, options.data)
    print(write_readme())
    return 0
