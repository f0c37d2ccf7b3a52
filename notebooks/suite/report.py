"""The HTML report of a run of the notebooks: an index page with the scoreboard, and a page per notebook."""

from __future__ import annotations

import html
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from threading import Lock

from suite import execute, findings, ledger
from suite.execute import Run
from suite.findings import Claim, Finding

_COLOURS = {
    findings.HOLDS: "#1a7f37",
    findings.FAILS: "#b3261e",
    findings.UNJUDGED: "#57606a",
    ledger.CONFIRMED: "#1a7f37",
    ledger.REFUTED: "#b3261e",
    ledger.CONDITION: "#9a6700",
    ledger.UNDECIDED: "#57606a",
    ledger.CONSTRUCTION: "#0b6e99",
    ledger.OPEN: "#8c959f",
}
_STYLE = """
:root { color-scheme: light dark; --line: #8883; --soft: #8882 }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem }
h1 { margin-bottom: 0 } h2 { margin-top: 2.2rem } .note { opacity: .75; margin-top: .2rem }
table { border-collapse: collapse; width: 100%; font-size: .92rem }
th, td { text-align: left; padding: .4rem .7rem; border-bottom: 1px solid var(--line); vertical-align: top }
th { font-weight: 600; background: var(--soft) }
.pill { color: white; border-radius: 1rem; padding: .1rem .6rem; font-size: .82rem; white-space: nowrap }
details { margin: 1rem 0 } summary { cursor: pointer }
.wide { overflow-x: auto } pre { background: var(--soft); padding: .6rem; overflow-x: auto; font-size: .8rem }
"""


def write_report(out: Path, profile: str, names: Sequence[str] = ()) -> list[Run]:
    """Runs notebooks side by side, even where some fail, into ``out``: NN.ipynb, NN.html and index.html.

    Numbers measured in this run go to ``out``/results; the committed results stay as they are. Interrupting
    writes the index of what has run, then raises KeyboardInterrupt.
    """
    paths = execute.find_notebooks(names)
    out.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(out / "results", ignore_errors=True)
    ran: list[Run] = []
    one_page_at_a_time = Lock()

    def done(run: Run, notebook: Path) -> None:
        ran.append(run)
        with one_page_at_a_time:
            _to_html(notebook)

    environment = {"MOTIONLAB_PROFILE": profile, "MOTIONLAB_BATCH": "1"} | execute.data_variable()
    try:
        runs = execute.run_side_by_side(
            [(path, out / path.name) for path in paths],
            environment | {"MOTIONLAB_RESULTS": str((out / "results").resolve())},
            done=done,
        )
    finally:
        order = {path.stem: k for k, path in enumerate(paths)}
        _write_index(out, sorted(ran, key=lambda run: order[run.notebook]), profile)
    return runs


def _to_html(notebook: Path) -> None:
    if notebook.exists():
        body, _ = _exporter().from_filename(str(notebook))
        body = body.replace('.ipynb">', '.html">')  # links to other notebooks
        notebook.with_suffix(".html").write_text(body, encoding="utf-8")


@cache
def _exporter():
    from nbconvert import HTMLExporter  # takes seconds to load

    return HTMLExporter()  # with embed_images it would close every fold; what is shown is embedded already


def _write_index(out: Path, runs: Sequence[Run], profile: str) -> Path:
    """The first page: scoreboard, what this run measured, and how each notebook went."""
    claims, recorded = _load_ledger()
    measured = findings.load_results(out / "results")
    failed = sum(not run.ok for run in runs)
    data = os.environ.get("MOTIONLAB_DATA")
    where = f"synthetic motion and the recordings in {data}" if data else "synthetic motion"
    page = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>",
        f"<title>motionlab report</title><style>{_STYLE}</style>",
        "<h1>motionlab</h1>",
        f"<p class='note'>{len(runs)} notebooks, {failed} failed, {sum(run.seconds for run in runs):.0f} s; "
        f"profile <b>{profile}</b>, on {html.escape(where)}; {time.strftime('%Y-%m-%d %H:%M')}.</p>",
        "<h2>Scoreboard</h2>",
        f"<p class='note'>What the thesis claims and what we found. “Recorded” is the committed full run, “this run” "
        f"is what the {profile} profile gives here.</p>",
        *_split_scoreboard(_scoreboard_rows(claims, recorded, measured, runs)),
        "<h2>Notebooks</h2>",
        _table(_notebook_rows(out, runs)),
        *(f"<pre>{html.escape(run.notebook)}: {html.escape(run.error)}</pre>" for run in runs if not run.ok),
        "<h2>Measured</h2>",
        "<p class='note'>Every number of this run; those of profile full are repeated from the record.</p>",
        _table(_finding_rows(measured or recorded)),
        "</html>",
    ]
    index = out / "index.html"
    index.write_text("\n".join(page), encoding="utf-8")
    return index


def _load_ledger() -> tuple[dict[str, Claim], list[Finding]]:
    """The claims of this checkout and the findings committed with it."""
    ledger = execute.NOTEBOOKS / "claims.toml"
    claims = findings.load_claims(ledger) if ledger.exists() else {}
    return claims, findings.load_results(execute.NOTEBOOKS / "results")


def _scoreboard_rows(
    claims: dict[str, Claim], recorded: Sequence[Finding], measured: Sequence[Finding], runs: Sequence[Run]
) -> list[dict[str, str]]:
    """One row per claim, as HTML: the recorded verdict, this run's, and a link to the notebook if it ran."""
    ran = {run.notebook for run in runs}
    now = {row["claim"]: row for row in ledger.scoreboard(claims, measured, answers=False)}
    rows = []
    for row in ledger.scoreboard(claims, recorded):
        notebook = next((name for name in ran if name.startswith(row["notebook"] + "_")), None)
        rows.append(
            {
                "claim": f"<b>{html.escape(row['claim'])}</b>",
                "thesis": html.escape(row["thesis"]),
                "in short": html.escape(row["in short"]),
                "recorded": _pill(row["verdict"]),
                "answer": html.escape(row["answer"]) + _rest(row),
                "this run": _pill(now[row["claim"]]["verdict"]),
                "notebook": f"<a href='{notebook}.html'>{notebook}</a>" if notebook else html.escape(row["notebook"]),
            }
        )
    return rows


def _rest(row: Mapping[str, str]) -> str:
    """The condition, or what would decide, as a line of its own."""
    return "" if row["in full"] == row["verdict"] else f"<br><i>{html.escape(row['in full'])}</i>"


def _split_scoreboard(rows: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """The claims that something is known about; the others folded away."""
    pill = _pill(ledger.OPEN)
    waiting = [row for row in rows if row["recorded"] == row["this run"] == pill]
    yield _table([row for row in rows if row not in waiting])
    if waiting:
        rest = [{name: row[name] for name in ("claim", "thesis", "in short", "notebook")} for row in waiting]
        yield f"<details><summary>Not measured yet: {len(waiting)}</summary>{_table(rest)}</details>"


def _notebook_rows(out: Path, runs: Sequence[Run]) -> list[dict[str, str]]:
    return [
        {
            "notebook": f"<a href='{run.notebook}.html'>{run.notebook}</a>"
            if (out / f"{run.notebook}.html").exists()
            else run.notebook,
            "status": run.status() if run.ok else f"<b style='color:{_COLOURS[findings.FAILS]}'>{run.status()}</b>",
            "seconds": f"{run.seconds:.0f}",
        }
        for run in runs
    ]


def _finding_rows(found: Sequence[Finding]) -> list[dict[str, str]]:
    return [
        {
            "test": html.escape(f.test),
            "source": html.escape(f.source),
            "measured (95 % interval)": html.escape(f"{f.statistic} {f.value_text()}"),
            "bound": html.escape(f.bound),
            "baseline": ""
            if f.baseline_value is None
            else html.escape(f"{f.baseline}: {f.baseline_value:.3g} {f.unit}"),
            "profile": f.profile,
            "verdict": _pill(f.verdict),
        }
        for f in found
    ]


def _pill(verdict: str) -> str:
    return f"<span class='pill' style='background:{_COLOURS[verdict]}'>{html.escape(verdict)}</span>"


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    if not rows:
        return "<p>Nothing yet.</p>"
    head = "".join(f"<th>{name}</th>" for name in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row.values()) + "</tr>\n" for row in rows)
    return f"<div class='wide'><table><tr>{head}</tr>\n{body}</table></div>"
