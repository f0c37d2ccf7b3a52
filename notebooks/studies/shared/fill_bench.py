"""The bench: every case, everybody who can do it, one number per window and measure.

Settings are chosen on the validation people; the best rival is the best on test people.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from motionlab import bench
from motionlab.bench import JOINTS, Case, PersonWindows, by_person, energy_score
from motionlab.motion import Motion
from studies.shared.fill_contenders import Contender
from studies.shared.fill_people import FRAMES, Cast, only, some

ERROR, SCORE, SPREAD, SHAKE, WAY = "error", "energy score", "spread over error", "acceleration", "path, m"
Scores = dict[str, Tensor]  # measure -> (N,) of windows, NaN where it was not measured


@dataclass(frozen=True, eq=False)
class Asked(Case):
    """edges: it has some in time. several: there is more than one answer, so that draws are worth their time.
    scattered: every window has a mask of its own."""

    edges: bool = False
    several: bool = False
    scattered: bool = False


def lost(count: int, generator: torch.Generator) -> Tensor:
    """Masks in which each joint is lost once, for 0.3 to 1 s; the root's place with the pelvis."""
    length = torch.randint(9, 31, (count, 1, JOINTS), generator=generator)
    start = (torch.rand(length.shape, generator=generator) * (FRAMES - length)).long()
    time = torch.arange(FRAMES)[:, None]
    known = (time < start) | (time >= start + length)
    return torch.cat((known, known[..., :1], torch.zeros_like(known[..., :1])), -1)


def _seeded(make: Callable, *how: float) -> Callable[[int], Tensor]:
    return lambda count: make(count, *how, torch.Generator().manual_seed(7))


_OTHERS = partial(_seeded, bench.every_frame, FRAMES)
_in_time = {"edges": True, "scattered": True}
HIDDEN, GAP, HALF, QUARTER = "legs hidden", "gap of 30 frames", "half of the joints", "a quarter of the joints"
EACH_HALF, EACH_QUARTER = "other joints each frame: half", "other joints each frame: a quarter"
LOST, SHORT, LONG, KEYS = "joints lost 0.3-1 s", "gap of 15 frames", "gap of 45 frames", "every 15th frame"
CASES: Mapping[str, Asked] = {
    HIDDEN: Asked(bench.CASES[HIDDEN].mask, bench.LOWER, several=True),
    EACH_HALF: Asked(_OTHERS(0.5), **_in_time),
    EACH_QUARTER: Asked(_OTHERS(0.25), **_in_time),
    LOST: Asked(_seeded(lost), **_in_time),
    HALF: Asked(bench.CASES[HALF].mask, scattered=True, several=True),
    QUARTER: Asked(bench.CASES[QUARTER].mask, scattered=True, several=True),
    SHORT: Asked(lambda n: bench.gap(n, FRAMES, 15), edges=True),
    GAP: Asked(bench.CASES[GAP].mask, edges=True, several=True),
    LONG: Asked(bench.CASES[LONG].mask, edges=True, several=True),
    KEYS: Asked(bench.CASES[KEYS].mask, edges=True),
}


@dataclass(frozen=True, eq=False)
class Result:
    """What somebody makes of a case: scores of the test windows, and the setting. rival: has no network. single:
    gives one answer."""

    scores: Scores
    setting: object = None
    rival: bool = False
    single: bool = True


@dataclass(frozen=True, eq=False)
class Bench:
    """found: case -> contender -> what it makes of it, on windows of ``whose`` (N,)."""

    found: Mapping[str, Mapping[str, Result]]
    whose: Tensor

    def people(self, case: str, name: str, measure: str = ERROR, rows: Tensor | None = None) -> Tensor:
        """The mean (P,) of each person, over the windows that were measured, or those of them in ``rows`` (N,)."""
        values = self.found[case][name].scores[measure]
        return by_person(values if rows is None else torch.where(rows, values, torch.nan), self.whose)

    def pair(self, case: str, a: str, b: str, measure: str = ERROR, rows: Tensor | None = None) -> list[Tensor]:
        """The means (P,) of two contenders, on the windows of both; of ``rows`` (N,) alone, where given."""
        both = torch.stack([self.found[case][n].scores[measure].isfinite() for n in (a, b)]).all(0)
        both = both if rows is None else both & rows
        return [self.people(case, n, measure, both) for n in (a, b)]

    def ranked(self, case: str, measure: str = ERROR, rows: Tensor | None = None) -> list[str]:
        """Rivals, the best on test people first, which favours them: of one answer for the error, all for the score."""
        names = [n for n, r in self.found[case].items() if r.rival and (r.single or measure == SCORE)]
        return sorted(names, key=lambda n: float(self.people(case, n, measure, rows).nanmean()))

    def standings(self, measure: str = ERROR) -> dict[str, dict[str, tuple[float, float]]]:
        """By case and contender: the mean over people, and that over the best rival's on the same windows."""
        table: dict[str, dict[str, tuple[float, float]]] = {case: {} for case in self.found}
        for case, row in table.items():
            best = self.ranked(case, measure)[0]
            for name in [n for n, r in self.found[case].items() if r.single or not r.rival or measure == SCORE]:
                mine, theirs = (float(x.nanmean()) for x in self.pair(case, name, best, measure))
                row[name] = mine, mine / theirs
        return table


def made_by(who: Contender, setting: object, known: Tensor, windows: PersonWindows, draws: int) -> list[Motion]:
    """Draws of windows; nobody is asked for what a figure lacks."""
    motion, _, lacks = windows
    given = known if who.told else known & ~lacks
    return [bench.restore_known(who.fill(motion, given, setting, k), motion, known | lacks) for k in range(draws)]


def scored(who: Contender, setting: object, case: Asked, windows: PersonWindows) -> Scores:
    """Every measure of windows (NaN where a contender is asked for few): error and energy score of the case's joints;
    of one draw the two are the same."""
    count = len(windows.whose)
    rows = torch.arange(count) if case.several or not who.few else some(windows, who.few)
    part, known = only(windows, rows), case.mask(count)[rows]  # a mask is that of the window's place in all
    made = made_by(who, setting, known, part, who.draws if case.several else 1)
    error = torch.stack([bench.error_cm(m, part.motion, known, case.joints) for m in made]).mean(0)
    score = energy_score(made, part.motion, known, case.joints)
    found = {
        ERROR: error, SCORE: score, SPREAD: 2 * (error - score) / error,
        SHAKE: torch.stack([bench.acceleration_ratio(m, part.motion) for m in made]).mean(0),
        WAY: torch.stack([path_m(m, known) for m in made]).mean(0),
    }  # fmt: skip
    return {k: torch.full((count,), torch.nan).index_put((rows,), x.float()) for k, x in found.items()}


def path_m(motion: Motion, known: Tensor) -> Tensor:
    """Metres (B,) that the root goes over the floor in hidden frames, and into and out of them."""
    hidden = bench.hidden_frames(known)
    steps = motion.root[..., :2].diff(dim=1).norm(dim=-1)
    return (steps * (hidden[:, 1:] | hidden[:, :-1])).sum(1)


def contest(title: str, everybody: Mapping[str, Contender], cast: Cast) -> dict[str, Result]:
    """Everybody who can do a case, by name; settings by the validation people."""
    case, found = CASES[title], {}
    for name, who in everybody.items():
        options = list(who.settings(case.edges, case.scattered))
        if not options or (who.rival and who.draws > 1 and not case.several):
            continue
        if options[1:]:
            quick = replace(who, draws=min(who.draws, 2))  # what a score is on average does not depend on how many
            aims = [float(by_person(scored(quick, o, case, cast.val)[SCORE], cast.val.whose).mean()) for o in options]
            options = [options[aims.index(min(aims))]]
        found[name] = Result(scored(who, options[0], case, cast.test), options[0], who.rival, who.draws == 1)
    return found
