"""What README.md and docs/scoreboard.md say of the results, written from the records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from motionlab.errors import DataError
from suite import execute, findings, ledger
from suite.findings import Claim, Finding

#: Around the findings in README.md.
MARKS = ("<!-- findings:start -->", "<!-- findings:end -->")
#: Each: the claims whose findings it names, and what it says of them, numbers as in an answer of the ledger.
FINDINGS = (
    (
        ("H03", "H04", "H07"),
        "**A motion prior fills in what the camera did not see.** With it, the hidden legs of {legs[synthetic].n} "
        "synthetic people who sit down end {legs[synthetic].size:.0f} cm nearer to the truth than after a tuned fit "
        "without it. Where the whole person is seen, a fit is still {pose[CMU].size:.1f} cm nearer "
        "({pose[CMU].n} recorded people). But it does not know what it hardly learnt: people who roll on the floor end "
        "{roll[synthetic].size:.0f} cm farther off with it ({roll[synthetic].n} synthetic people).",
    ),
    (
        ("H06",),
        "**Three numbers for a rotation make bodies spin.** Where a rotation vector jumps inside a gap of hidden "
        "frames, smoothing turns the body the long way round in {crossing[recordings].value:.0%} of the gaps "
        "({crossing[recordings].n} recorded people). With six numbers for a rotation it does so in "
        "{cure[recordings].value:.1%} of all gaps, and with three in {anywhere[recordings].value:.1%}.",
    ),
    (
        ("H22",),
        "**A fit need not take twenty minutes**, as the thesis reports for two seconds of motion on its graphics card. "
        "On one processor core, the stage that asks the prior takes our solver {real_time[CMU].value:.1f} s for a "
        "recorded person. It gets to where the usual search ends {sooner[CMU].value:.0f} times sooner "
        "({sooner[CMU].n} people); whether its errors are as small is not certain.",
    ),
    (
        ("D08",),
        "**To fill in, tell a network what is known while it learns.** It puts hidden legs "
        "{one[recordings].size:.1f} cm nearer to the truth than the best simple rival ({one[recordings].n} recorded "
        "people). Diffusion is not what does it: noise adds several answers where several are right. Draws of the "
        "thesis's diffusion model, told nothing, score {plain[recordings].size:.1f} cm worse than a Gaussian's.",
    ),
)
#: Verdicts as README.md counts them.
_COUNTED = {
    "confirmed": "are confirmed",
    "refuted": "refuted",
    "true when": "true on a condition",
    "by construction": "true by construction",
    "undecided": "still undecided",
}
_SCOREBOARD = """# Scoreboard

What became of every claim of the thesis (H: its chapter 3, HuMoR; D: chapter 4, diffusion). This page is written from
the records by `PYTHONPATH=notebooks python -m suite pages`, and its numbers are read from them.

A *finding* is one test measured on one source, with its 95 % interval, n, a bound that stands in
[`claims.toml`](../notebooks/claims.toml), and a trivial baseline. *Confirmed*: every test that can tell holds.
*Refuted*: the tests that carry the claim fail. *True when*: some hold and some fail, and the condition parts them.
*Undecided*: intervals cross the bound, or there are too few people or clips. *By construction*: true by mathematics or
by how it is built. *To be judged again*: the models behind it had seen little real motion. Notebook
[99](../notebooks/99_scoreboard.ipynb) explains the words and shows every number.
"""


def update(root: Path) -> None:
    """Writes docs/scoreboard.md and the findings of README.md in a checkout from the committed results.

    Raises:
        DataError: README.md has no marks, or a sentence names a number that no finding holds.
    """
    claims = findings.load_claims(execute.NOTEBOOKS / "claims.toml")
    found = findings.load_results(execute.NOTEBOOKS / "results")
    (root / "docs/scoreboard.md").write_text(scoreboard(claims, found), encoding="utf-8")
    path, (start, end) = root / "README.md", MARKS
    text = path.read_text(encoding="utf-8")
    if start not in text or end not in text:
        raise DataError("no marks for the findings", path=path, remedy=f"add the lines {start} and {end}")
    front = f"{text.split(start)[0]}{start}\n{first_findings(claims, found)}{end}{text.split(end)[1]}"
    path.write_text(front, encoding="utf-8")


def first_findings(claims: Mapping[str, Claim], found: Sequence[Finding]) -> str:
    """Returns the findings that README.md begins with as Markdown, and how many claims came out how."""
    lines, files = [], _files()
    for names, text in FINDINGS:
        named = [claims[name] for name in names]
        whole = Claim("README", "", "", "", "", answer=text, tests=sum((claim.tests for claim in named), ()))
        book = named[0].notebook.partition("_")[0]
        again = ", to be measured again" if any(claim.again for claim in named) else ""
        lines.append(f"- {ledger.answer(whole, found)} ([{book}](notebooks/{files[book]}){again})\n")
    counts = Counter(_short(ledger.verdict(claim, found)) for claim in claims.values())
    *each, last = (f"{counts[word]} {said}" for word, said in _COUNTED.items())
    return "".join(lines) + f"\nOf the thesis's {len(claims)} claims, {', '.join(each)}, and {last}.\n"


def scoreboard(claims: Mapping[str, Claim], found: Sequence[Finding]) -> str:
    """Returns the page of all claims that were measured, as Markdown."""
    files = _files()
    lines = ["| claim | in short | verdict | answer | notebook |", "|---|---|---|---|---|"]
    for row in ledger.scoreboard(claims, found):
        if row["verdict"] == ledger.OPEN:
            continue
        short = _short(row["verdict"])
        verdict = f"**{short}**{row['in full'].removeprefix(short)}"
        again = " *(to be judged again)*" if claims[row["claim"]].again else ""
        book = row["notebook"].partition("_")[0]
        link = f"[{book}](../notebooks/{files[book]})"
        lines.append(f"| {row['claim']} | {row['in short']} | {verdict} | {row['answer']}{again} | {link} |")
    return f"{_SCOREBOARD}\n" + "\n".join(lines) + "\n"


def _files() -> dict[str, str]:
    """The notebooks' files, by their numbers."""
    return {path.stem.partition("_")[0]: path.name for path in execute.NOTEBOOKS.glob("*.ipynb")}


def _short(verdict: str) -> str:
    """A verdict without its condition and without what would decide it."""
    return verdict.partition(" ...")[0].removesuffix(": needs")
