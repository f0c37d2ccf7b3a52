"""Tells whether a record is still what the code gives, by what a small run measures, not by the code's text.

A record of the full profile holds a *fingerprint* beside its findings: what the smoke profile of the same notebook
measures, each number with the distance within which another machine stays. Moving or rewording code changes nothing in
it; a changed constant does. What the clock decides is no part of it.
"""

import ast
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from motionlab.errors import DataError

#: Share of a number, or of the bound it is judged by, that it may differ by without anything having changed.
TOLERANCE = 1e-3
ROUNDING = 1e-6  # what is smaller is rounding, such as the distance of two implementations of one formula
#: Runs of one notebook under other arithmetic may differ by this share; a number that differs more is no fingerprint:
#: where rounding is amplified so much, anything may come out. Then: how many times the spread of such runs is allowed.
STEADY, SLACK = 0.03, 5.0


class Mark(NamedTuple):
    """A number (None: none was measured) and how far another run may be from it."""

    value: float | None
    within: float

    def agrees(self, other: Self) -> bool:
        """Returns whether both are None, or no further apart than either allows."""
        if self.value is None or other.value is None:
            return self.value is other.value
        return abs(self.value - other.value) <= max(self.within, other.within)

    def __str__(self) -> str:
        return "nothing" if self.value is None else f"{self.value:.4g}"


Fingerprint = dict[str, Mark]


def number_of(notebook: str) -> str:
    """Returns the number that a notebook's name begins with: "02", or "05a"."""
    return notebook.partition("_")[0]


class StaleRecord(DataError):
    """A record that its code no longer gives: in what (``moved``), and what it says of its run (``provenance``)."""

    def __init__(self, notebook: str, moved: Sequence[str], provenance: Mapping[str, str]) -> None:
        took = f" ({duration(provenance['seconds'])} when last run)" if "seconds" in provenance else ""
        remedy = f"make full NOTEBOOKS={number_of(notebook)}{took}"
        super().__init__("stale: " + "; ".join(moved), place=f"record of {notebook}", remedy=remedy)


def duration(seconds: str) -> str:
    """Returns seconds, as a record has them, as a person says it: "8 min", or "1.6 h"."""
    minutes = float(seconds) / 60
    return f"{minutes / 60:.1f} h" if minutes >= 90 else f"{max(1, round(minutes))} min"


def mark(value: float | None, scale: float = 0.0, tolerance: float = TOLERANCE) -> Mark:
    """Computes the mark of a number; its size, or that of the bound it is judged by, says how far another may be."""
    if value is None or not math.isfinite(value):
        return Mark(None, 0.0)
    return Mark(float(value), max(ROUNDING, tolerance * max(abs(value), abs(scale))))


def merged(runs: Sequence[Fingerprint]) -> tuple[Fingerprint, list[str]]:
    """Computes one fingerprint from runs under different arithmetic: the first one's numbers, wide enough for all.

    Returns:
        the fingerprint, and what differs too much, or is not in all of them, to be part of it.
    """
    found = {}
    for name, (value, within) in runs[0].items():
        marks = [run[name] for run in runs if name in run]
        known = [mark.value for mark in marks if mark.value is not None]
        spread = max((abs(each - value) for each in known if value is not None), default=0.0)
        size = min((mark.within for mark in marks if mark.within), default=0.0) / TOLERANCE
        if len(marks) == len(runs) and len(known) in (0, len(runs)) and spread <= STEADY * size:
            found[name] = Mark(value, max(within, SLACK * spread))
    return found, [name for name in runs[0] if name not in found]


def differences(recorded: Fingerprint, now: Fingerprint) -> list[str]:
    """Lists how a run differs from its record, a phrase each; empty where nothing moved."""
    gone = [f"{name} is not measured any more" for name in recorded if name not in now]
    both = [(name, was, now[name]) for name, was in recorded.items() if name in now and not was.agrees(now[name])]
    return gone + [f"{n} was {was}, is {x} (may differ by {max(was.within, x.within):.1g})" for n, was, x in both]


# ------------------------------------------------------------------------------------------------------ code and files
def code_hash(notebook: Path | str) -> str:
    """Computes a hash of a notebook's code without its imports, by which a record says which cells it belongs to."""
    cells = json.loads(Path(notebook).read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    return hashlib.sha256("\0".join(map(_without_imports, code)).encode()).hexdigest()[:16]


def _without_imports(code: str) -> str:
    lines = code.splitlines()
    with suppress(SyntaxError):  # a magic
        for node in ast.parse(code).body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)
    return "\n".join(line for line in lines if line.strip())


def recordings_digest(folder: Path | None) -> dict[str, str]:
    """Computes a hash of the files (names and sizes) of every source in a folder of recordings; empty without one."""
    found = {}
    for source in sorted(path for path in folder.iterdir() if path.is_dir()) if folder else ():
        files = sorted((str(f.relative_to(source)), f.stat().st_size) for f in source.rglob("*") if f.is_file())
        found[source.name] = hashlib.sha256(json.dumps(files).encode()).hexdigest()[:8]
    return found
