"""The verdict on a claim of the thesis from what its tests measured, and the claim's answer in words.

    role of a test   asks                                     decides the verdict?
    claim            is what the thesis says true?            yes, alone
    control          does the measure fail where it must?     no; where it fails, those beside it are void
    apparatus        is our instrument right?                 no
    beyond           what do we add to the thesis?            no

A claim test decides only where its baseline, the best tuned rival run through the same measure, does not pass the
bound. A paired difference has that rival in itself and names it (``rival``); one that names none has a baseline of zero
that passes, and decides nothing. A baseline that is no trivial method (a reference, another form of the same method) is
marked ``reference`` in ``claims.toml``. Two to seven clips, people or seeds decide nothing, nor do fewer than five
rounds of a stopwatch: five that agree are rarer than one in twenty by chance (sign test). A single number is a count.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, Self

from motionlab.errors import DataError
from suite.findings import FAILS, HOLDS, UNJUDGED, Claim, Criterion, Finding

CONFIRMED, REFUTED, CONDITION, UNDECIDED = "confirmed", "refuted", "true when ...", "undecided: needs ..."
CONSTRUCTION, OPEN = "by construction", "not measured yet"
#: Of a finding that decides nothing, and of one that does.
SILENT, VOID, DECIDES = "not informative", "void: its control failed", (HOLDS, FAILS, UNJUDGED)
LEAST, ROUNDS = 8, 5  # clips, people or seeds; rounds of a stopwatch
_REAL = ("recordings", "bandai_namco", "pose2sim", "anidance", "cmu", "captury")
_NUMBERS = re.compile(r"\d[\d.,]*\d|\d")


class Weighed(NamedTuple):
    """A finding with its test and what it says of the claim: holds, does not hold, cannot be judged, or nothing."""

    test: Criterion
    finding: Finding
    says: str


def weigh(claim: Claim, found: Iterable[Finding]) -> list[Weighed]:
    """Returns what each finding of a claim says of it, those that do not decide (``role``) included."""
    tests = {test.id: test for test in claim.tests}
    mine = [f for f in found if f.test in tests]
    void = {f.source for f in mine if tests[f.test].role == "control" and f.verdict == FAILS}
    return [Weighed(tests[f.test], f, _says(tests[f.test], f, void)) for f in mine]


def _says(test: Criterion, finding: Finding, void: set[str]) -> str:
    if test.role != "claim":
        return finding.verdict
    if finding.source in void:
        return VOID
    base = finding.baseline_value
    within = bool(test.rival) and base in (test.bound, test.other)
    if not test.reference and base is not None and math.isfinite(base) and test.meets(base) and not within:
        return SILENT
    return UNJUDGED if 1 < finding.n < (ROUNDS if test.clock else LEAST) else finding.verdict


def verdict(claim: Claim, found: Iterable[Finding]) -> str:
    """Returns the verdict on a claim: that of its claim tests, where any is informative.

    Refuted where most rows of the tests that carry it fail and none holds (``carriers``; all, where none are named).
    """
    weighed = weigh(claim, found)
    if weighed and not any(test.role == "claim" for test in claim.tests):
        built = {w.says for w in weighed if w.test.role == "apparatus"}
        return CONSTRUCTION if built == {HOLDS} else UNDECIDED
    if not (rows := [w for w in weighed if w.test.role == "claim"]):
        return OPEN
    rows = [w for w in rows if w.says in DECIDES]
    says = {w.says for w in rows}
    carried = [w.says for w in rows if not claim.carriers or w.test.name in claim.carriers]
    if HOLDS not in carried and 2 * carried.count(FAILS) > len(carried):
        return REFUTED
    return CONFIRMED if says == {HOLDS} else CONDITION if {HOLDS, FAILS} <= says else UNDECIDED


# --------------------------------------------------------------------------------------------------------- in words
class _Measured(list):
    """The findings of one test as an answer may name them: {sits.value:.0%}, {sits[recordings].low:.2f}."""

    def __getitem__(self, source: str) -> Self:
        return _Measured(f for f in self if f.source == source)

    def __getattr__(self, name: str) -> float:
        if len(self) != 1:
            raise KeyError(f"{len(self)} sources: name one")
        (row,) = self
        number = (vars(row) | {"size": abs(row.value), "baseline": row.baseline_value})[name]
        if not math.isfinite(number):
            raise ValueError(f"{name} of {row.test}: not finite")
        return number


def answer(claim: Claim, found: Sequence[Finding]) -> str:
    """Returns a claim's answer with its numbers put in.

    Raises:
        DataError: it names a number that no finding holds, or has one written in that is not the thesis's own.
    """
    named = {test.name: [f for f in found if f.test == test.id] for test in claim.tests}
    place = f"answer of {claim.id}"
    typed = _NUMBERS.findall(re.sub(r"\{[^}]*\}|\b\dD\b|\bstage \d", "", claim.answer))
    if foreign := sorted(set(typed) - set(_NUMBERS.findall(f"{claim.thesis} {claim.title}"))):
        raise DataError(f"{', '.join(foreign)} is typed", place=place, remedy="name the finding: {test.value:.1f}")
    try:
        return claim.answer.format(**{name: _Measured(rows) for name, rows in named.items() if rows})
    except (KeyError, AttributeError, ValueError, TypeError, IndexError) as error:
        raise DataError(f"no finding for {error}", place=place, remedy="name test, source and number") from error


def found_answer(claim: Claim, found: Sequence[Finding]) -> str:
    """Returns a claim's answer; of a run that did not measure all that it names, a sentence that says so."""
    try:
        return answer(claim, found) if weigh(claim, found) else ""
    except DataError:
        return "This run did not measure all that the answer names."


def spoken(claim: Claim, found: Sequence[Finding]) -> str:
    """Returns the verdict in full: with the condition, or with what would decide."""
    said = verdict(claim, found)
    rest = {CONDITION: claim.condition, UNDECIDED: claim.needs}.get(said)
    return said.replace("...", rest) if rest else said


def apart(claim: Claim, found: Sequence[Finding]) -> dict[str, str]:
    """Returns the verdict on synthetic motion alone and on recordings alone."""
    parts = enumerate(("synthetic", "real"))
    return {name: verdict(claim, [f for f in found if is_real(f) == real]) for real, name in parts}


def is_real(finding: Finding) -> bool:
    """Returns whether a finding is of recordings alone."""
    return finding.source.lower().startswith(_REAL)


def scoreboard(claims: Mapping[str, Claim], found: Sequence[Finding]) -> list[dict[str, str]]:
    """Returns one row per claim: id, title, verdict (also in full), answer, the notebook that shows it."""
    return [
        {"claim": c.id, "in short": c.title, "verdict": verdict(c, found), "in full": spoken(c, found),
         "answer": answer(c, found) if weigh(c, found) else "", "notebook": c.notebook}
        for c in claims.values()
    ]  # fmt: skip
