"""Hidden legs, gaps and joints of people nobody trained on: the completers, against rivals of the same hours.

    PYTHONPATH=notebooks python -m studies.nb11_cases.real_people FOLDER [--part choose]

Rivals learn from windows of the people who train, settings of everybody are chosen on the people who choose, and the
people of the report are used once. Every person counts alike; intervals are by bootstrap over people. What is measured
on the report goes into the recipe of ``completer``, where ``python -m motionlab models`` reads it.

Most recordings are of a figure without toes and with a stiff back. Nobody is asked for a joint that a figure does not
have: it stays as it came, whoever fills in the rest. Networks, which learnt never to be told of it, are not.

One answer is judged by its error; draws by their energy score, in which one answer may stand, too: six of each, and two
of the thesis's model (``diffusion_plain``, by Eq. 4.10), which takes minutes a case; the score does not depend on it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab import checkpoint, rotation
from motionlab.bench import cases, rivals
from motionlab.bench.judge import CASES, FRAMES, Case, energy_score, people
from motionlab.bench.person_windows import PersonWindows, by_person
from motionlab.diffusion import completer, state
from motionlab.diffusion.completer import Completer, guess
from motionlab.diffusion.inpainting import Way, repair
from motionlab.diffusion.masks import units
from motionlab.diffusion.model import motion_model
from motionlab.files import write_whole
from motionlab.heading import local_to_world, stuck_root
from motionlab.metrics import intervals
from motionlab.models import REPORT
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from motionlab.train_more import learnt_from
from studies.shared.inbetween_measures import l2p, l2q, npss

EACH, PRACTICE = 24, 8  # windows of each person, for the report and to choose on
LEARNT = 30_000  # training windows that the rivals learn from
FADES = (0, 5, 10)  # frames over which the jump at the edge of what is known may fade
STEPS = (5, 10)  # of the sampler
DRAWS = 6
R, T = "completer", "completer_draws"
P, MANY = "diffusion_plain", 50  # the thesis's model; its steps: 250 left no less on those who choose
#: What is asked of whom, and of which draws.
DRAWN = ("legs hidden", "gap of 30 frames", "gap of 45 frames")


@dataclass(frozen=True, eq=False)
class Contender:
    """fill: (motion, known, setting, seed) -> motion. settings: to choose from, by whether a case has edges in time.
    draws: how many; 0: one answer. told: of joints that a figure lacks."""

    fill: Callable[[Motion, Tensor, object, int], Motion]
    settings: Callable[[bool], Sequence] = lambda edges: (None,)
    draws: int = 0
    told: bool = True


def contenders(learnt: Motion, clips: Tensor, generator: torch.Generator) -> dict[str, Contender]:
    """Everybody by name. learnt: windows (N, T) of the clips (N,)."""
    fitted, one, many = rivals.Rivals.fit(learnt, generator), completer.load(R), completer.load(T)
    plain = motion_model(P)
    fades = lambda edges: FADES if edges else (0,)  # noqa: E731

    def ridges(edges: bool) -> list[tuple[float, int]]:
        return [(w, fade) for w in rivals.RIDGES for fade in fades(edges)]

    def ridge(motion: Motion, known: Tensor, how: tuple[float, int], seed: int | None) -> Motion:
        draw = None if seed is None else torch.Generator().manual_seed(seed)
        return replace(fitted, ridge=how[0]).regression(motion, known, how[1], draw)

    def drawn(motion: Motion, known: Tensor, steps: int, seed: int) -> Motion:
        return many.complete(motion, known, torch.Generator().manual_seed(seed), steps=steps)

    def overwritten(motion: Motion, known: Tensor, how: None, seed: int) -> Motion:
        draw = torch.Generator().manual_seed(seed)
        return repair(plain, motion, known[..., units(plain.layout)], draw, Way(steps=MANY))

    return {
        "mean pose": Contender(lambda m, k, how, _: fitted.mean(m, k, how), fades),
        "nearest": Contender(lambda m, k, how, _: fitted.nearest(m, k, how), fades),
        "slerp": Contender(lambda m, k, *_: rivals.interpolated(m, k), lambda edges: (None,) if edges else ()),
        "curves": Contender(lambda m, k, *_: curves(one, m, k), lambda edges: (None,) if edges else ()),
        "ridge": Contender(lambda m, k, how, _: ridge(m, k, how, None), ridges),
        R: Contender(lambda m, k, *_: one.complete(m, k), told=False),
        "nearest six": Contender(
            lambda m, k, how, n: fitted.nearest(m, k, how, rank=n, clips=clips), fades, draws=DRAWS
        ),
        "Gaussian": Contender(ridge, ridges, draws=DRAWS),
        T: Contender(drawn, lambda edges: STEPS, draws=DRAWS, told=False),
        P: Contender(overwritten, draws=2, told=False),
    }


def curves(model: Completer, motion: Motion, known: Tensor) -> Motion:
    """What a completer adds to: smooth curves through what is known."""
    local, frame = stuck_root(motion)
    return local_to_world(frame, state.motion_of(guess(local, known, *model.units.made), local))


def left(who: Contender, how: object, case: Case, windows: PersonWindows, standing: dict) -> dict[str, Tensor]:
    """What a contender leaves of a case's windows, by person (P,). standing: of L2P, by joint."""
    motion, whose, lacks = windows
    known = case.mask(len(motion.root))
    given = known if who.told else known & ~lacks
    made = [cases.pasted(who.fill(motion, given, how, k), motion, known | lacks) for k in range(who.draws or 1)]
    found = {
        "energy score, cm": energy_score(made, motion, known, case.joints),
        "cm": torch.stack([cases.error_cm(m, motion, known, case.joints) for m in made]).mean(0),
        "slide, mm a frame": torch.stack([cases.slide_mm(m, motion) for m in made]).mean(0),
        "acceleration over the truth's": torch.stack([cases.acceleration_ratio(m, motion) for m in made]).mean(0),
    }
    if who.draws:
        found["spread over error"] = 2 * (found["cm"] - found["energy score, cm"]) / found["cm"]
    elif (hidden := cases.hidden_frames(known)[0]).int().diff().abs().sum() == 2:  # one gap
        found |= _lafan(made[0], motion, hidden, standing)
    each = {name: by_person(x, whose) for name, x in found.items() if name != "NPSS"}
    if "NPSS" in found:  # over all windows of a person together
        each["NPSS"] = torch.tensor([found["NPSS"](whose == person) for person in whose.unique()])
    return each


def _lafan(made: Motion, truth: Motion, hidden: Tensor, standing: dict) -> dict:
    """L2P and L2Q (B,) of hidden frames (T,), and NPSS of windows (B,) together. Quaternions have the signs nearer to
    the truth's, unlike the benchmark's: so these are for comparisons here alone."""
    places, turns = zip(
        *((m.world[0][:, hidden], rotation.matrix_to_quaternion(m.world[1][:, hidden])) for m in (made, truth)),
        strict=True,
    )
    near = turns[0] * (turns[0] * turns[1]).sum(-1, keepdim=True).sign()
    return {
        "L2P": l2p(*places, **standing), "L2Q": l2q(near, turns[1]),
        "NPSS": lambda mine: npss(near[mine].flatten(2), turns[1][mine].flatten(2)),
    }  # fmt: skip


def measure(folder: str, part: str) -> tuple[dict[str, dict[str, dict[str, float]]], dict[str, object]]:
    """Everybody on every case: by measure means and intervals over people, and paired against the completers; and the
    settings that were chosen."""
    generator = torch.Generator().manual_seed(0)
    learnt, clips = learnt_from(folder, FRAMES)[0].drawn(LEARNT, generator)
    learnt = replace(learnt, skeleton=STANDARD)
    everybody = contenders(learnt, clips, generator)
    spread = learnt.clip(torch.arange(2000)).positions.flatten(0, 1)
    standing = {"mean": spread.mean(0), "std": spread.std(0)}
    practice, report = people(folder, "choose", PRACTICE), people(folder, part, EACH)
    rows, chosen = {}, {}
    for title, case in CASES.items():
        some = {}
        for name, who in everybody.items():
            options = list(who.settings(case.edges)) if not who.draws or title in DRAWN else []
            if not options:
                continue
            aim = "energy score, cm"  # of one answer its error
            tried = [float(left(who, o, case, practice, standing)[aim].mean()) for o in options] if options[1:] else [0]
            best = chosen[f"{title}: {name}"] = options[tried.index(min(tried))]
            some[name] = left(who, best, case, report, standing)
            print(
                f"{title}: {name} {best}: " + ", ".join(f"{k} {x.nanmean():.3g}" for k, x in some[name].items()),
                flush=True,
            )
        for name, each in some.items():
            kind = "draws, energy score, cm" if everybody[name].draws else "one answer, cm"
            rows[f"{title}; {name}; {kind}"] = _over_people(each["energy score, cm"], generator)
            if name != R and not everybody[name].draws:
                rows[f"{title}; {name}; less {R}, cm"] = _over_people(each["cm"] - some[R]["cm"], generator)
            if T in some and name != T:
                less = each["energy score, cm"] - some[T]["energy score, cm"]
                rows[f"{title}; {name}; less {T}, energy score, cm"] = _over_people(less, generator)
        for name in (R, T, P):
            for what in ("acceleration over the truth's", "slide, mm a frame", "spread over error"):
                if name in some and what in some[name]:
                    rows[f"{title}; {name}; {what}"] = _over_people(some[name][what], generator)
        for what in ("L2P", "L2Q", "NPSS"):
            if "slerp" in some and what in some[R]:
                ratio = some[R][what] / some["slerp"][what]
                rows[f"{title}; {R}, {what}; over slerp's"] = _over_people(ratio, generator)
    return rows, chosen


def _over_people(values: Tensor, generator: torch.Generator) -> dict[str, float]:
    values = values[values.isfinite()]
    mean, low, high = intervals.interval(values, "mean", generator)
    return {"mean": mean, "low": low, "high": high, "people": len(values)}


def main() -> None:
    """Measures and prints; of the report it is kept in the models' recipes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("--part", choices=("choose", "report"), default="report")
    options = parser.parse_args()
    found, chosen = measure(options.folder, options.part)
    for name, row in found.items():
        print(f"{name}: {row['mean']:.3g} [{row['low']:.3g}, {row['high']:.3g}]")
    if options.part == "report":
        path = checkpoint.SHIPPED / f"{R}.json"
        about = checkpoint.read_recipe(path) | {REPORT: found, "settings, by the people who choose": chosen}
        write_whole(path, json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
