"""The report: a gallery of the committed notebooks, stamped with what a run of today says of their numbers.

A film, three sentences, a card for every notebook, the claims, and the tests on a page of their own. Links are relative
and nothing comes from elsewhere, so that a folder or a static host serves it as it is. The pages are the notebooks as
committed: a short run is compared with their records, and its own numbers are not shown. A full run shows its own.
"""

import math
import shutil
import time
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import jinja2

from suite import execute, findings, ledger, page, staleness
from suite.execute import Run
from suite.findings import Claim, Finding, Record
from suite.page import Check, Page

#: The film that the page begins with, by its caption; without it, the first.
FILM = "**Figure 00.2.**"
TEMPLATES = Path(__file__).parent / "templates"
#: The parts of the gallery, by the number that each begins with.
PARTS = {
    "00": "Start here", "01": "Motion, rotations, skin", "04": "A prior of transitions: repairing what a camera saw",
    "10": "A diffusion model: making motion", "99": "All answers",
}  # fmt: skip


def write_report(out: Path, profile: str, names: Sequence[str] = (), *, run: bool = True) -> list[Run]:
    """Runs notebooks side by side, even where some fail, into ``out``/today, and writes the pages.

    The committed results stay as they are. Interrupting writes the pages with what has run, then raises
    KeyboardInterrupt. run: False where nothing is to be run; the pages say so.
    """
    paths, today, ran = execute.find_notebooks(names), out / "today", []
    shutil.rmtree(today, ignore_errors=True)
    today.mkdir(parents=True)
    environment = {"MOTIONLAB_PROFILE": profile, "MOTIONLAB_RESULTS": str((today / "results").resolve())}
    try:
        if run:
            execute.run_side_by_side([(path, today / path.name) for path in paths], environment, ran)
    finally:
        for entry in build(out, ran, full=profile == "full"):
            if entry.check.mark == "bad":
                print(f"{entry.name}: {entry.check.said}")
    return sorted(ran)


def build(out: Path, runs: Sequence[Run] = (), *, full: bool = False) -> list[Page]:
    """Builds the pages from the committed notebooks, or, of a full run, from its own in ``out``/today.

    Of a short run it compares the numbers with the records; what agrees leaves nothing but these numbers behind.
    """
    today = {run.notebook: run for run in runs}
    claims = findings.load_claims(execute.NOTEBOOKS / "claims.toml")
    found = findings.load_results(execute.NOTEBOOKS / "results")
    entries = []
    for path in execute.find_notebooks():
        run, copy = today.get(path.stem), out / "today" / path.name
        record, now = findings.record_of(path), findings.record_of(copy)
        check = _check(run, record, now, full=full)
        if full and run and not run.error:
            path, record = copy, now
            found = [*(f for f in found if f.notebook != path.stem), *record.findings]
        elif check.mark == "good":
            copy.unlink(missing_ok=True)
        entries.append(entry := page.read(path, out))
        real = record.fingerprint_on_recordings or any(map(ledger.is_real, record.findings))
        needs = "synthetic motion and recordings" if real else "synthetic motion alone"
        entry.record, entry.check, entry.needs = record, check, needs
    verdicts = [(claim, ledger.verdict(claim, found)) for claim in claims.values()]
    for entry in entries:
        entry.claims = [(claim, said) for claim, said in verdicts if claim.notebook == entry.number]
    _write(out, entries, verdicts, found)
    return entries


def _check(run: Run | None, record: Record, now: Record, *, full: bool) -> Check:
    """What today's run says of a notebook."""
    if run is None:
        return Check("", "Not checked today")
    day = f"today ({time.strftime('%Y-%m-%d')})"
    if run.error:
        return Check("bad", f"Run {day}: {run.status}", (run.error,))
    if full:
        return Check("good", f"Run in full {day}")
    expected = record.expected(now.recordings)
    if not expected:
        return Check("", f"Run {day} to its end; no numbers are on record to compare")
    if moved := tuple(record.moved(now)):
        return Check("bad", f"Checked {day}: {len(moved)} of {len(expected)} numbers differ from the record", moved)
    agree = sum(not name.endswith((": n", ": baseline")) for name in expected)
    return Check("good", f"Checked {day}: {agree} finding{'s' * (agree != 1)} agree{'s' * (agree == 1)}", agree=agree)


# --------------------------------------------------------------------------------------------------------------- pages
def _write(out: Path, entries: Sequence[Page], verdicts: Sequence[tuple[Claim, str]], found: Sequence[Finding]) -> None:
    """Write the gallery, a page for every notebook, that of the tests, and their style."""
    files = jinja2.FileSystemLoader(TEMPLATES)
    environment = jinja2.Environment(loader=files, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"measured": _measured, "duration": staleness.duration}
    parts = groupby(entries, lambda entry: [part for number, part in PARTS.items() if number <= entry.number][-1])
    films = [picture for entry in entries for picture in entry.pictures if picture.film]
    environment.globals |= {
        "entries": entries, "parts": {title: list(some) for title, some in parts}, "claims": verdicts,
        "findings": found, "ledger": ledger,
        "film": max(films, key=lambda film: film.caption.startswith(FILM), default=None),
        "pages": {entry.number: f"{entry.name}.html" for entry in entries},
        "points": next((entry.points for entry in reversed(entries) if entry.points), ()),
        "checks": Counter(entry.check.mark for entry in entries), "day": time.strftime("%Y-%m-%d"),
    }  # fmt: skip

    def write(name: str, template: str, **values: object) -> None:
        (out / name).write_text(environment.get_template(template).render(values), encoding="utf-8")

    write("index.html", "index.html")
    write("tests.html", "tests.html")
    for before, entry, after in zip([None, *entries], entries, [*entries[1:], None], strict=False):
        write(f"{entry.name}.html", "notebook.html", entry=entry, before=before, after=after)
    shutil.copy(TEMPLATES / "style.css", out / "style.css")


def _measured(finding: Finding) -> str:
    """What was measured, as a person writes it."""
    if not math.isfinite(finding.value):
        return "not run: nothing to measure" if finding.n == 0 else f"no number, n = {finding.n}"
    said = f"{finding.statistic} {finding.value_text()}".replace(" ,", ",")
    return said.replace("n = ", "n\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")
