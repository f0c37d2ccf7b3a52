"""What README.md and docs/scoreboard.md say of the results, written from the records."""

import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from motionlab.errors import DataError
from suite import execute, findings, ledger
from suite.findings import Claim, Finding

#: Around what is written into a page; the rest of it is a person's.
MARKS = ("<!-- findings:start -->", "<!-- findings:end -->")
#: Verdicts as README.md counts them.
_COUNTED = {
    ledger.CONFIRMED: "are confirmed", ledger.REFUTED: "refuted", ledger.CONDITION: "true on a condition",
    ledger.CONSTRUCTION: "true by construction", ledger.UNDECIDED: "still undecided",
}  # fmt: skip


def update(root: Path) -> None:
    """Writes docs/scoreboard.md and the findings of README.md in a checkout from the committed results.

    Raises:
        DataError: a page has no marks, or a sentence names a number that no finding holds.
    """
    claims = findings.load_claims(execute.NOTEBOOKS / "claims.toml")
    found = findings.load_results(execute.NOTEBOOKS / "results")
    for name, written in (("docs/scoreboard.md", scoreboard), ("README.md", first_findings)):
        path, (start, end) = root / name, MARKS
        before, _, rest = path.read_text(encoding="utf-8").partition(f"{start}\n")
        if end not in rest:
            raise DataError("no marks for the findings", path=path, remedy=f"add the lines {start} and {end}")
        path.write_text(f"{before}{start}\n{written(claims, found)}{end}{rest.split(end)[1]}", encoding="utf-8")


def first_findings(claims: Mapping[str, Claim], found: Sequence[Finding]) -> str:
    """Returns the findings that README.md begins with as Markdown, and how many claims came out how.

    Each is a ``[[headline]]`` of claims.toml: the claims whose findings it names, and what it says of them.
    """
    lines = []
    for headline in tomllib.loads((execute.NOTEBOOKS / "claims.toml").read_text(encoding="utf-8"))["headline"]:
        named = [claims[name] for name in headline["claims"]]
        tests = [test for claim in named for test in claim.tests]
        said = ledger.answer(Claim("README", "", "", "", "", answer=headline["says"], tests=tests), found)
        lines.append(f"- {said} ({_link(named[0].notebook, 'notebooks')})\n")
    counts = Counter(ledger.verdict(claim, found) for claim in claims.values())
    *each, last = (f"{counts[word]} {said}" for word, said in _COUNTED.items())
    return "".join(lines) + f"\nOf the thesis's {len(claims)} claims, {', '.join(each)}, and {last}.\n"


def scoreboard(claims: Mapping[str, Claim], found: Sequence[Finding]) -> str:
    """Returns the table of all claims that were measured, as Markdown."""
    lines = ["| claim | in short | verdict | answer | notebook |", "|---|---|---|---|---|"]
    for row in (row for row in ledger.scoreboard(claims, found) if row["verdict"] != ledger.OPEN):
        short = row["verdict"].partition(" ...")[0].removesuffix(": needs")  # without what the ledger adds
        verdict = f"**{short}**{row['in full'].removeprefix(short)}"
        link = _link(row["notebook"], "../notebooks")
        lines.append(f"| {row['claim']} | {row['in short']} | {verdict} | {row['answer']} | {link} |")
    return "\n".join(lines) + "\n"


def _link(number: str, folder: str) -> str:
    """A link to the notebook of a number."""
    return f"[{number}]({folder}/{next(execute.NOTEBOOKS.glob(f'{number}_*.ipynb')).name})"
