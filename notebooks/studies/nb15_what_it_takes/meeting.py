"""The network without noise (R) beside its twin with noise (T), and beside chapter 3 on the same windows.

All get the places of the joints above the knees, of which TestOps' stages 1 and 2 make poses. From there stage 3 goes
on by HuMoR's prior; a network takes the body above the legs as known.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.bench import LOWER, legs
from motionlab.footage.scene_fit import QUICK_WORK
from motionlab.humor.energies import KEYPOINTS
from motionlab.humor.evidence import Observation3D
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb15_what_it_takes.figures import Panel
from studies.shared import fill_bench as bench
from studies.shared import fill_people as people
from studies.shared.fill_bench import ERROR, SCORE, Bench
from studies.shared.fill_contenders import GAUSSIAN, Contender, Models, R, T
from studies.shared.fill_people import Cast

STAGE_2, STAGE_3 = "stage 2", "stage 3"


def contest(title: str, everybody: Mapping[str, Contender], models: Models, cast: Cast, steps: Sequence[int]) -> Bench:
    """R, the Gaussian's draws, and two draws of T in so many steps of its sampler ("5", say) on a case."""
    few = people.only(cast.test, people.some(cast.test, 6))
    draws = {f"{n}": lambda motion, known, _, seed, n=n: models.drawn(motion, known, seed, n) for n in steps}
    who = {name: everybody[name] for name in (R, GAUSSIAN)}
    who |= {n: Contender(draw, draws=2, told=False, rival=False) for n, draw in draws.items()}
    return Bench({title: bench.contest(title, who, replace(cast, test=few))}, few.whose)


def over_steps(table: Bench, title: str, steps: Sequence[int]) -> Panel:
    """Score and error of T's draws by the steps of its sampler, beside R and the Gaussian."""
    score, one = ({n: table.people(title, f"{n}", m) for n in steps} for m in (SCORE, ERROR))
    levels = {name: table.people(title, name, SCORE) for name in (R, GAUSSIAN)}
    return Panel({T: score, "one draw of T": one}, "steps of the sampler", "cm", levels)


def met(
    truth: Motion, priors: Priors, whole: bool, fills: Mapping[str, Callable[[Motion, Tensor], Motion]]
) -> tuple[dict[str, Motion], dict[str, float]]:
    """Stages 2 and 3 (the faster solver's), and what each of ``fills`` makes of stage 2's upper body: motions (B, T);
    and seconds of a window that each took behind stage 2. whole: False: few steps, to see that it runs."""
    count, seen = len(truth.root), torch.ones(truth.positions.shape[:-1], dtype=torch.bool)
    seen[..., STANDARD.indices(LOWER)] = False
    places = Observation3D(torch.where(seen[..., None], truth.positions, 0.0), seen, truth.fps, "legs hidden")
    how = {"schedule": Schedule.lean() if whole else QUICK_WORK, "weights": KEYPOINTS, "solver": "shooting"}
    fitted = fit(places, priors, **how)
    took = {STAGE_3: sum(report.seconds for report in fitted.results.get(3, ())) / count}
    two = fitted.stages[2]
    contacts = two.root.new_zeros(*two.root.shape[:-1], len(STANDARD.contact_names))
    start, made = Motion(STANDARD, two.root, two.rot, two.fps, contacts), {STAGE_2: two, STAGE_3: fitted.stages[3]}
    for name, fill in fills.items():
        began = time.perf_counter()
        made[name] = fill(start, legs(count, truth.frames))
        took[name] = (time.perf_counter() - began) / count
    return made, took
