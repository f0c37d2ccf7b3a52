"""``python -m motionlab models`` writes checkpoints/README.md: the models that ship, and what their recipes say of them
on people nobody trained on. Notebooks 04, 11 and 12 measure that anew."""

import argparse
from collections import defaultdict
from fnmatch import filter as named
from pathlib import Path

import jinja2

from motionlab import checkpoint
from motionlab.files import write_whole

#: Where the measurements stand in a recipe.
REPORT = "people nobody trained on"
#: What the table shows of a prior, on people's own bones and on the standard body.
_SHOWN = (
    "one step, prior mean, cm", "one step, posterior, cm", "one step, constant velocity, cm",
    "one step, posterior, contact F1", "contact F1, as one frame before", "2 s, posterior z, cm",
    "2 s, closed loop, cm", "2 s, best of 8 samples, cm", "2 s, prior mean, cm", "2 s, hold, cm", "kl, nats",
    "effective rank", "samples' bones", "samples' acceleration", "data's acceleration", "samples' slide",
    "data's slide", "walkers who go on", "data's walkers who go on",
)  # fmt: skip
_PAGE = Path(__file__).with_name("model_card.md")


def run(options: argparse.Namespace) -> int:
    """``models``: writes the table."""
    recipes = {path.stem: checkpoint.read_recipe(path) for path in sorted(checkpoint.SHIPPED.glob("*.json"))}
    found = {name: recipe[REPORT] for name, recipe in recipes.items() if REPORT in recipe}
    rows, contest = defaultdict(dict), {}
    for name, each in found.items():
        for measure, mean in each.items():
            rows[measure][name] = mean
    for key, mean in found.get("completer", {}).items():
        case, who, what = key.split("; ")
        contest.setdefault(what, {}).setdefault(who, {})[case] = mean
    makers = [*named(found, "completer_draws"), *named(found, "diffusion_*")]
    shown = [body + name for body in ("", "standard body: ") for name in _SHOWN if body + name in rows]
    page = jinja2.Template(_PAGE.read_text(encoding="utf-8"), trim_blocks=True, lstrip_blocks=True)
    text = page.render(
        recipes=recipes, contest=contest,
        sizes={name: checkpoint.SHIPPED.joinpath(f"{name}.safetensors").stat().st_size / 1e6 for name in recipes},
        priors=[*named(found, "humor_*"), *named(found, "transition")],
        prior_rows={name: rows[name] for name in shown},
        makers=makers, maker_rows={name: row for name, row in rows.items() if {*makers} & {*row}},
    )  # fmt: skip
    write_whole(path := checkpoint.SHIPPED / "README.md", f"{text}\n")
    print(path)
    return 0
