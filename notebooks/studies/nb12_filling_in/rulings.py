"""Which numbers each test of the ledger is judged by: of the bench, of seams, of transitions; one for each person.

Everybody is compared with the best rival on test people, which favours rivals, and so is the second best: the baseline.
"""

from collections.abc import Callable, Iterator, Mapping
from operator import sub, truediv

import torch
from torch import Tensor

from motionlab.bench import PersonWindows, by_person
from motionlab.motion import Motion
from studies.nb12_filling_in import flaws, noise, switching
from studies.shared import fill_bench as bench
from studies.shared.fill_bench import SCORE, SHAKE, WAY, Bench
from studies.shared.fill_contenders import GAUSSIAN, GUIDED, NEAREST, P, R, T

Ruling = tuple[str, Tensor, Tensor, str]  # test, values (P,), the baseline's, note
_OVER: dict[str, tuple[str, str]] = {}
for _test, _case in zip(("middle", "large", "lasting"), noise.NOISES, strict=True):
    _OVER |= {f"D07.{_test}": (_case, P), f"D07.ours_{_test}": (_case, R)}
for _test, _case in {"half": bench.EACH_HALF, "quarter": bench.EACH_QUARTER, "lost": bench.LOST}.items():
    _OVER |= {f"D09.{_test}": (_case, GUIDED), f"D09.told_{_test}": (_case, R)}
_LESS = {
    "D08.plain": (bench.HIDDEN, P), "D08.guided": (bench.HIDDEN, GUIDED), "D08.told": (bench.HIDDEN, T),
    "D10.half": (bench.HALF, GUIDED), "D10.told_half": (bench.HALF, T), "D10.quarter": (bench.QUARTER, GUIDED),
    "D10.told_quarter": (bench.QUARTER, T), "D11.plausible": (bench.GAP, P), "D11.told": (bench.GAP, T),
    "D11.told_long": (bench.LONG, T),
}  # fmt: skip
_ONE = {"D08.one": bench.HIDDEN, "D11.short": bench.SHORT, "D11.keys": bench.KEYS}
_SAMPLING = {"D08.sampling": bench.HIDDEN, "D10.sampling": bench.HALF, "D11.sampling": bench.GAP}


def of_bench(table: Bench, truth: Motion) -> Iterator[Ruling]:
    """Tests that errors, energy scores and paths in a gap decide; truth (N, T). A short run has not all of them."""

    def versus(test: str, case: str, name: str, how: Callable, **more: object) -> Ruling:
        best, second, *_ = table.ranked(case, **more)
        mine, theirs = (how(*table.pair(case, n, best, **more)) for n in (name, second))
        return test, mine, theirs, f"best rival: {best}"

    score = {"measure": SCORE}
    yield from (versus(test, *what, truediv) for test, what in _OVER.items() if what[0] in table.found)
    yield from (versus(test, *what, sub, **score) for test, what in _LESS.items() if what[0] in table.found)
    yield from (versus(test, case, R, sub) for test, case in _ONE.items() if case in table.found)
    for test, case in _SAMPLING.items():
        pairs = ((T, R), (GAUSSIAN, "Gaussian"))
        yield test, *(sub(*table.pair(case, *pair, **score)) for pair in pairs), ""
    for test, case in {"legs": bench.HIDDEN, "gap": bench.GAP}.items():
        yield f"D04.{test}", *(sub(*table.pair(case, n, GAUSSIAN, **score)) for n in (P, NEAREST)), ""
    pelvis = bench.CASES[bench.HALF].mask(len(table.whose))[:, 0, 0]
    for test, rows in {"known": pelvis, "hidden": ~pelvis}.items():
        yield versus(f"D10.pelvis_{test}", bench.HALF, T, sub, rows=rows, **score)
    yield "D08.smooth", *(table.people(bench.HIDDEN, n, SHAKE) for n in (P, "nearest")), ""
    true = by_person(bench.path_m(truth, bench.CASES[bench.GAP].mask(len(table.whose))), table.whose)
    ratio = {name: table.people(bench.GAP, name, WAY) / true for name in (P, T, "curves")}
    yield from ((f"D11.{test}", ratio[n], ratio["curves"], "") for test, n in (("meanders", P), ("told_path", T)))


def of_seams(
    made: Mapping[str, Motion], ends: Mapping[str, Mapping[str, Tensor]], windows: PersonWindows, known: Tensor
) -> Iterator[Ruling]:
    """Tests of the seam: what ``flaws.cures`` made, and what ``flaws.seams`` measured of it."""

    def each(name: str, measure: str) -> Tensor:
        return by_person(ends[name][measure], windows.whose)

    jump, large, off, gap = flaws.JUMP, flaws.LARGE, flaws.OFF, flaws.LEAVES
    true, curves = each("truth", jump), each("curves", jump)
    yield "D11.jump", each(P, jump) - true, curves - true, ""
    yield "D11.cause", each(P, jump) - each(flaws.OPEN, jump), torch.zeros_like(curves), ""
    for test, name in {"curves": "curves", "mixed": flaws.FADED}.items():
        yield f"D17.{test}", each(name, large), each(P, large), ""
    yield "D17.told", torch.maximum(each(R, large), each(T, large)), each(P, large), ""
    exact = torch.stack([ends[n][off] for n in ("curves", R, T, flaws.FADED)]).amax(0)
    yield "D17.exact", *(by_person(x / 100, windows.whose) for x in (exact, ends[flaws.OPEN][off])), ""
    yield "D17.gap", *(each(n, gap) - each(P, gap) for n in (flaws.FADED, flaws.SOFT)), ""
    lines = {n: flaws.off_the_line(made[n], windows.motion, known) for n in ("truth", P, flaws.SOFT)}
    far = {n: by_person(x, windows.whose) for n, x in lines.items()}
    yield "D16.free", far[flaws.SOFT] / far["truth"], far[P] / far["truth"], ""


def of_switching(passed: Mapping[str, Mapping]) -> Iterator[Ruling]:
    """Tests of transitions; on each measure against the best rival."""
    for test, measure in {"jump": switching.JUMP, "skate": switching.SKATE, "acceleration": switching.CALM}.items():
        best, second, _ = sorted(switching.RIVALS, key=lambda n: float(passed[n][measure].mean()))
        less = {n: passed[n][measure] - passed[best][measure] for n in (P, T, second)}
        yield f"D20.{test}", less[P], less[second], f"best rival: {best}"
        yield f"D20.told_{test}", less[T], less[second], f"best rival: {best}"
