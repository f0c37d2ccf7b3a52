"""``python -m motionlab models`` writes checkpoints/README.md: the models that ship, and what their recipes say of them
on people nobody trained on. Notebooks 04, 11 and 12 measure that anew."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from motionlab import checkpoint
from motionlab.files import write_whole

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
_CREDIT = (
    "Some of these weights learnt from the CMU Graphics Lab Motion Capture Database: the data used in this project was "
    "obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217."
)


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
    text += f"{_models_table()}\n\n`train humor`, `train features` and `--preset` are gone: today `train transition`, "
    text += "`make train`, `train small`.\n\n"
    text += "## Transition priors on people nobody trained on\n\nMean over people and its 95 % interval, by bootstrap "
    text += f"over people.\n\n{_quality_table(PRIORS, _SHOWN)}\n\n"
    if (completer := checkpoint.SHIPPED / "completer.json").exists():
        text += _contest(checkpoint.read_recipe(completer).get(REPORT, {}))
    if table := _quality_table(["completer_draws", "diffusion_*"]):
        text += f"## Generation in 250 steps, when it shipped (notebook 11 takes 1000, of other windows)\n\n{table}\n\n"
    write_whole(path, f"{text}Licence: MIT, as the project's. {_CREDIT}\n")
    return path


def run(options: argparse.Namespace) -> int:
    """``models``: writes the table."""
    print(write_readme())
    return 0
