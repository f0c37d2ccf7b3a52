"""Which window is shown, and what of it: the same for films, for the scene to turn, and for the knob."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from motionlab import bench
from motionlab.bench import Case, PersonWindows
from motionlab.motion import Motion
from studies.shared.fill_bench import CASES, ERROR, Bench, made_by
from studies.shared.fill_contenders import Contender, Models, R, T
from studies.shared.fill_people import FRAMES, only


def typical(table: Bench, case: str, name: str, motion: Motion, least: float = 0.8) -> int:
    """Of the windows in which the root goes so many metres, the one of median error: neither the best nor the worst."""
    far = motion.root[..., :2].diff(dim=1).norm(dim=-1).sum(1) >= least
    error = table.found[case][name].scores[ERROR]
    rows = (error.isfinite() & (far if far.any() else True)).nonzero()[:, 0]
    return int(rows[error[rows].argsort()[len(rows) // 2]])


def panels(
    table: Bench, everybody: Mapping[str, Contender], case: str, windows: PersonWindows, row: int, names: Sequence[str]
) -> dict[str, Motion]:
    """One window: the truth, and what each of ``names`` makes of it, one draw, for :func:`motionlab.viz.movie.film`."""
    window, known = only(windows, torch.tensor([row])), CASES[case].mask(len(windows.whose))[[row]]
    made = {n: made_by(everybody[n], table.found[case][n].setting, known, window, 1)[0] for n in names}
    return {"truth": window.motion.clip(0)} | {name: motion.clip(0) for name, motion in made.items()}


def asked_of(what: str, seconds: float) -> Case:
    """What a person hides: "legs", or "gap" of so many seconds in the middle."""
    if what == "legs":
        return Case(lambda n: bench.legs(n, FRAMES), bench.LOWER)
    return Case(lambda n: bench.gap(n, FRAMES, min(round(30 * seconds), FRAMES - 2)))


def filled(m: Models, window: PersonWindows, case: Case, seed: int) -> tuple[dict[str, Motion], dict[str, float]]:
    """One window filled in by curves, R and one draw of T, and their errors in cm."""
    motion, _, lacks = window
    known = case.mask(1)
    given = known & ~lacks
    made = {"curves": m.curves(motion, known), R: m.r.complete(motion, given), T: m.drawn(motion, given, seed)}
    made = {name: bench.restore_known(x, motion, known | lacks) for name, x in made.items()}
    return made, {name: float(bench.error_cm(x, motion, known, case.joints)) for name, x in made.items()}


def single(motion: Motion) -> PersonWindows:
    """A clip (T) on the standard body as one window of one person that lacks nothing."""
    window = replace(motion, root=motion.root[None], rot=motion.rot[None], contacts=None)
    return PersonWindows(window, torch.zeros(1).long(), torch.zeros(1, 1, bench.JOINTS + 2).bool())
