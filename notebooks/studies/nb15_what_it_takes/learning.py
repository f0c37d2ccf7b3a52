"""Hidden legs by ridge regression on so many people, and what longer trainings left on record."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import bench
from motionlab.bench import PersonWindows, by_person
from motionlab.contact import with_contacts
from motionlab.diffusion.features import units
from motionlab.diffusion.model import MotionDiffusion
from motionlab.motion import Motion
from motionlab.viz.palette import ROLE
from studies.nb15_what_it_takes.figures import Panel
from studies.shared import small_models
from studies.shared.clips import recorded
from studies.shared.fill_people import FRAMES, Cast

NETWORK, RIDGE = "network", "ridge regression"  # of ``hours``
#: Arms of small models: by the number of people who teach; best and last of a run; by the number of noising steps.
PEOPLE = {n: f"{n} people" for n in (8, 15, 30, 60)}
STOPS = tuple(f"8 people, long, {which}" for which in ("best", "last"))
NOISING = {n: f"{n} steps" for n in (10, 50, 200, 1000)}
BOTH = {"x0 error": "error of x0", "frechet": "Frechet distance"}
MEASURES = BOTH | {"acceleration, m/s^2": "acceleration, m/s^2"}


class Rows(NamedTuple):
    """Windows as rows x (N, T D) of a model's numbers; whose (N,); kept (N, T D): what is not asked for."""

    x: Tensor
    whose: Tensor
    kept: Tensor


def rows(model: MotionDiffusion, motion: Motion, whose: Tensor, lacks: Tensor) -> Rows:
    """Windows (N, T) whose legs are hidden. lacks (N, 1, U): joints that a figure does not have."""
    kept = (bench.legs(len(whose), motion.frames) | lacks)[..., units(model.layout)]
    labelled = with_contacts(motion) if motion.contacts is None else motion
    return Rows(model.encode(labelled).flatten(1), whose, kept.flatten(1))


def teachers(model: MotionDiffusion, cast: Cast, folder: Path | str | None, each: int) -> Rows:
    """At most so many learnt windows of every recorded person, people numbered from 0. Without recordings each clip
    counts as a person."""
    whose = cast.clips
    if folder:
        takes = recorded(folder).part("train")
        names = [take.person for take in takes if take.motion.frames >= FRAMES]
        people = list(dict.fromkeys(names))
        of_clip = [people.index(name) for name in names] + [-1] * (int(whose.max()) + 1)  # synthetic clips come last
        whose = torch.tensor(of_clip)[whose]
    some = torch.cat([(whose == k).nonzero()[:each, 0] for k in whose.unique() if k >= 0])
    lacks = torch.zeros(len(some), 1, bench.JOINTS + 2, dtype=torch.bool)
    return rows(model, cast.learnt.clip(some), whose[some].unique(return_inverse=True)[1], lacks)


def filled(model: MotionDiffusion, some: Rows, guess: Tensor) -> Motion:
    """The windows with guesses (N, T D) in place of what was hidden, in the frame of their first pose."""
    x = torch.where(some.kept, some.x, guess)
    return model.decode(x.unflatten(1, (FRAMES, -1)))


def left_cm(model: MotionDiffusion, some: Rows, guess: Tensor) -> Tensor:
    """What is left of each person (P,): mean distance of knees, ankles and feet from the true ones, cm."""
    made, truth = (filled(model, some, x) for x in (guess, some.x))
    return by_person(bench.error_cm(made, truth, bench.legs(len(some.x), FRAMES), bench.LOWER), some.whose)


def roles(made: Mapping[str, Motion]) -> dict[str, str]:
    """Colours of what ``hide`` or ``meeting.met`` made."""
    ours = {name: "baseline" if "people" in name else "ours" for name in made if name not in ROLE}
    return ours | {"stage 3": "stage3"}


def middle(windows: PersonWindows) -> Tensor:
    """The row of each person's middle window."""
    mine = [(windows.whose == person).nonzero()[:, 0] for person in windows.whose.unique()]
    return torch.stack([some[len(some) // 2] for some in mine])


def tuned(learn, model: MotionDiffusion, people: int, seed: int, val: Rows):
    """What ``learn`` (people, seed, weight) learnt, by the weight that leaves least of the validation people."""
    tried = [learn(people, seed, weight) for weight in (100.0, 1000.0, 10_000.0)]
    return min(tried, key=lambda guess: float(left_cm(model, val, guess(val.x)).mean()))


def hours() -> dict[str, dict[float, Tensor]]:
    """Error of hidden legs of each person (P,), cm, by model and hours; mean of seeds (``docs/experiments.md``)."""
    found = json.loads((small_models.RECORDS / "hours.json").read_text(encoding="utf-8"))["completer"]
    by: dict[str, dict[float, list]] = {NETWORK: {}, RIDGE: {}}
    for row in found:
        for name, key in ((NETWORK, "legs hidden"), (RIDGE, "legs hidden, ridge")):
            by[name].setdefault(round(row["hours"], 1), []).append(row["test"][key])
    return {name: {h: torch.tensor(x).double().mean(0) for h, x in some.items()} for name, some in by.items()}


def of_arms(
    points: Mapping[float, tuple], measures: Mapping[str, str], xlabel: str, beside: Mapping[str, Mapping] | None = None
) -> dict[str, Panel]:
    """A panel a measure, of arms by x: (rows, arm). beside: level lines, by name and measure."""
    found = {}
    for key, label in measures.items():
        line = {x: small_models.by_seed(trained, arm, key) for x, (trained, arm) in points.items()}
        levels = {n: torch.tensor([some[key]]) for n, some in (beside or {}).items() if key in some}
        found[label] = Panel({"the thesis's, small": line}, xlabel, "", levels)
    return found


def against(trained: Sequence[dict], arm: str, other: str, measure: str) -> tuple[Tensor, Tensor]:
    """What one arm left over what another did, for each training seed (S,); and the other of the next seed over that of
    the same, which is what luck makes of nothing."""
    mine, theirs = (small_models.by_seed(trained, name, measure) for name in (arm, other))
    return mine / theirs, theirs.roll(1) / theirs
