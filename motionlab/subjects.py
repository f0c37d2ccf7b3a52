"""Splits recordings by subject into training, validation ("val") and test ("test") people.

A performance may exist in several sources (CMU's subject_trial ids agree between them), so the split is by person, over
all sources at once. ``subjects.toml`` says which persons are kept from training, and why. A collection that is not
named there is split by a hash of the person's name, so that it stays the same from one machine to the next.
"""

import hashlib
import re
import tomllib
from functools import cache
from pathlib import Path

PARTS = ("train", "val", "test")
_TABLE = Path(__file__).with_name("subjects.toml")
#: Of ten persons of a collection that ``subjects.toml`` does not know: one validates, two test.
_VAL, _TEST = 1, 2


@cache
def _table(path: Path = _TABLE) -> dict:
    """Reads ``subjects.toml``: its content, by section."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def person_of(source: str, path: Path | str) -> str:
    """Returns who performs a file of a source.

    ``subjects.toml`` names a pattern for some sources, in whose first group the person stands, or single files.
    Elsewhere it is the folder that the file lies in, as in AMASS; of a flat folder the file's name up to its first "_"
    or digit.
    """
    known, path = _table(), Path(path)
    if named := known["files"].get(f"{source}/{path.stem}"):
        return named
    if source in known["alone"]:
        return source
    if pattern := known["patterns"].get(source):
        if found := re.match(pattern["name"], path.stem):
            return f"{pattern['people']}_{found[1]}"
        return f"{pattern['people']}_{path.stem}"
    if path.parent.name not in ("", ".", source):
        return f"{source}/{path.parent.name}"
    return f"{source}/{re.split(r'[_0-9]', path.stem)[0] or path.stem}"


def part_of(person: str) -> str:
    """Returns the part that a person belongs to, one of ``PARTS``."""
    known = _table()
    for name in ("val", "test"):
        if person in known[name]["people"]:
            return name
    group = person.split("/")[0]
    named = group == person and any(person.startswith(f"{p['people']}_") for p in known["patterns"].values())
    if group in known["alone"] or named:
        return "train"
    lot = int(hashlib.sha256(person.encode()).hexdigest(), 16) % 10
    return "val" if lot < _VAL else "test" if lot < _VAL + _TEST else "train"
