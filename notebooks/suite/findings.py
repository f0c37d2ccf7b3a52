"""Claims, findings and verdicts: what the thesis says, what we measured, and what follows.

A claim and the tests that decide it are written in ``claims.toml`` before the experiment runs. A finding is one
measurement of one test on one source of data, with its interval. Whether it meets its bound follows by a rule that
knows nothing of the experiment; what that says of the claim, ``suite.ledger``.
"""

import json
import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Self

from motionlab.errors import DataError
from motionlab.files import write_whole
from suite import staleness
from suite.staleness import Fingerprint, Mark

HOLDS, FAILS, UNJUDGED = "holds", "does not hold", "cannot be judged here"
ROLES = ("claim", "control", "apparatus", "beyond")
_NUMBERS = ("value", "low", "high")  # of a finding; NaN where there was nothing to measure


@dataclass(frozen=True)
class Criterion:
    """One measurable sentence of a claim: its operational definition and the bound fixed beforehand.

    relation, bound: the claim holds where ``value relation bound``. other: the other end of a two-sided band, of a
    measure that can also be too good (half the true acceleration is no success). needs: "full" where the smoke profile
    is too small to judge, "real" where recordings are needed. least: fewest samples that may judge. clock: what it
    measures depends on how fast the machine is, so that no fingerprint holds it. role: one of ROLES, of which "claim"
    alone decides (``suite.ledger``). reference: the baseline is no trivial method, so that it may pass. rival: the best
    tuned rival, where a paired difference or ratio is taken from it, so that its baseline is none. revised: what was
    changed in the definition after its first measurement, when and why.
    """

    id: str
    definition: str
    unit: str
    relation: str
    bound: float
    baseline: str
    needs: Sequence[str] = ()
    least: int = 1
    clock: bool = False
    role: str = "claim"
    reference: bool = False
    rival: str = ""
    revised: str = ""
    other: float | None = None

    def __post_init__(self) -> None:
        if self.relation not in (">=", "<=") or self.role not in ROLES:
            raise ValueError(f"relation {self.relation!r}, role {self.role!r}")

    @property
    def name(self) -> str:
        """Its name within its claim."""
        return self.id.split(".")[1]

    def bound_text(self) -> str:
        """Returns the bound as a person writes it, such as ">= 3 deg" or "0.8 to 1.2"."""
        if self.other is None:
            return f"{self.relation} {self.bound:g} {self.unit}".strip()
        return "{:g} to {:g} {}".format(*self.ends, self.unit).strip()

    @property
    def ends(self) -> tuple[float, float]:
        """The least and the greatest value within the bound, both included."""
        other = {">=": math.inf, "<=": -math.inf}[self.relation] if self.other is None else self.other
        return min(self.bound, other), max(self.bound, other)

    def meets(self, value: float) -> bool:
        """Returns whether a value lies within the bound, its end included."""
        return self.ends[0] <= value <= self.ends[1]


@dataclass(frozen=True)
class Claim:
    """One row of the ledger: where the thesis says it, its words, and the tests that decide it.

    answer: what we found, in a sentence whose numbers are named, not typed. condition, needs: what a verdict of "true
    when" or "undecided" asks for. carriers: the tests that carry it, where others only add. figure: the one that shows
    it.
    """

    id: str
    section: str
    title: str
    thesis: str
    notebook: str
    answer: str = ""
    condition: str = ""
    needs: str = ""
    figure: str = ""
    carriers: Sequence[str] = ()
    tests: tuple[Criterion, ...] = ()

    def __post_init__(self) -> None:
        if foreign := set(self.carriers) - {test.name for test in self.tests}:
            raise ValueError(f"no test {', '.join(sorted(foreign))} to carry it")


@dataclass(frozen=True)
class Finding:
    """One test measured on one source: value with a 95 % interval, sample size, baseline, verdict."""

    test: str
    source: str
    value: float
    low: float
    high: float
    n: int
    unit: str
    statistic: str
    bound: str
    verdict: str
    notebook: str
    profile: str
    baseline: str = ""
    baseline_value: float | None = None
    note: str = ""

    @property
    def claim(self) -> str:
        """Id of the claim this test belongs to."""
        return self.test.split(".")[0]

    def value_text(self) -> str:
        """Returns value, interval (of extremes none) and n, rounded for reading."""
        extreme = self.n < 2 or self.statistic in ("max", "min")
        interval = "" if extreme else f" [{self.low:.3g}, {self.high:.3g}]"
        return f"{self.value:.3g}{interval} {self.unit}, n = {self.n}"


def load_claims(path: Path | str) -> dict[str, Claim]:
    """Reads the ledger of claims.

    Raises:
        DataError: not TOML, a claim or test without a required field, an id used twice, an unknown relation.
    """
    claims, row = {}, {}
    try:
        for row in tomllib.loads(Path(path).read_text(encoding="utf-8"))["claim"]:
            tests = row.pop("test", {}).items()
            if row["id"] in claims:
                raise ValueError("id used twice")
            tests = tuple(Criterion(id=f"{row['id']}.{name}", **test) for name, test in tests)
            claims[row["id"]] = Claim(**row, tests=tests)
    except (OSError, KeyError, TypeError, ValueError) as error:
        place, remedy = row and f"claim {row.get('id', '?')}", "restore claims.toml from the repository"
        raise DataError(str(error), path=path, place=place, remedy=remedy) from error
    return claims


def all_tests(claims: dict[str, Claim]) -> dict[str, Criterion]:
    """Returns every test of the ledger by id ("H06.excess")."""
    return {test.id: test for claim in claims.values() for test in claim.tests}


def judge(test: Criterion, low: float, high: float, n: int) -> str:
    """Returns the verdict on one measurement: the whole interval must lie on one side of the bound, or in the band.

    Too few samples, a NaN, or an interval across the bound cannot be judged.
    """
    if n < test.least or not (math.isfinite(low) and math.isfinite(high)):
        return UNJUDGED
    if high < test.ends[0] or low > test.ends[1]:
        return FAILS
    return HOLDS if test.meets(low) and test.meets(high) else UNJUDGED


@dataclass(frozen=True)
class Record:
    """What one full run of one notebook found: ``results/NN.json``.

    fingerprint: what the smoke profile of the same notebook measures (``staleness``), and what more or else it measures
    on recordings. weights: checksums of the checkpoints that it loads. recordings: of the lists of recordings, by
    source. Both as they were when the fingerprint was taken.
    """

    notebook: str
    source_hash: str
    findings: tuple[Finding, ...]
    provenance: dict[str, str] = field(default_factory=dict)
    fingerprint: Fingerprint = field(default_factory=dict)
    fingerprint_on_recordings: Fingerprint = field(default_factory=dict)
    weights: dict[str, str] = field(default_factory=dict)
    recordings: dict[str, str] = field(default_factory=dict)

    def expected(self, recordings: dict[str, str]) -> Fingerprint:
        """Returns what a smoke run must measure beside these recordings.

        Without recordings, the fingerprint on synthetic motion; with those of the record, also that on them; with
        others only what does not depend on them.
        """
        if not recordings:
            return self.fingerprint
        if self.recordings and self.recordings.items() <= recordings.items():
            return self.fingerprint | self.fingerprint_on_recordings
        return {name: mark for name, mark in self.fingerprint.items() if name not in self.fingerprint_on_recordings}

    def moved(self, now: Self) -> list[str]:
        """Lists how a smoke run differs from this record, a phrase each."""
        other = [f"{n} are other weights" for n, digest in self.weights.items() if now.weights.get(n, digest) != digest]
        return other + staleness.differences(self.expected(now.recordings), now.fingerprint)


def save_record(path: Path | str, record: Record) -> None:
    """Writes a record, and the folder it goes into; a reader never sees half a file.

    Raises:
        DataError: it cannot be written there.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    found = asdict(record)
    for row in found["findings"]:  # JSON knows no NaN
        row |= {name: None for name in _NUMBERS if math.isnan(row[name])}
    text = json.dumps(found, indent=1, ensure_ascii=False)
    write_whole(Path(path), re.sub(r"\[\s+(\S+),\s+(\S+)\s+\]", r"[\1, \2]", text) + "\n")  # a mark on one line


def load_record(path: Path | str) -> Record:
    """Reads one ``results/NN.json``.

    Raises:
        DataError: not JSON, or not a record.
    """
    try:
        raw = json.loads(Path(path).read_text(encoding="utf-8"))
        rows = [row | {name: math.nan for name in _NUMBERS if row[name] is None} for row in raw["findings"]]
        marks = {k: {n: Mark(*pair) for n, pair in raw[k].items()} for k in raw if k.startswith("fingerprint")}
        return Record(**{**raw, **marks, "findings": tuple(Finding(**row) for row in rows)})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(str(error), path=path, remedy="run `make full` to measure again") from error


def record_path(notebook: Path) -> Path:
    """Returns where the record of a notebook lies: results/NN.json beside it."""
    return notebook.parent / "results" / f"{staleness.number_of(notebook.stem)}.json"


def record_of(notebook: Path) -> Record:
    """Reads the record of a notebook; an empty one where there is none."""
    path = record_path(notebook)
    return load_record(path) if path.exists() else Record(notebook.stem, "", ())


def load_results(folder: Path | str) -> list[Finding]:
    """Reads the findings of every record in a folder, in notebook order."""
    return [f for path in sorted(Path(folder).glob("*.json")) for f in load_record(path).findings]
