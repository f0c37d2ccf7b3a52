"""Runs the suite's notebooks: side by side, in place to regenerate what is committed, or for their fingerprints."""

from __future__ import annotations

import asyncio
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from motionlab import parallel
from motionlab.doctor import ROOT
from motionlab.errors import DataError, MissingData
from suite import findings, staleness

NOTEBOOKS = ROOT / "notebooks"
_QUIET = ["--log-level=40"]  # the kernel's advice on encrypting its own sockets is not for the reader
#: Of one process among several: linear algebra, compiled loops, and the software that draws where there is no card.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
_NARROW = {
    "ATEN_CPU_CAPABILITY": "default", "MKL_ENABLE_INSTRUCTIONS": "SSE4_2", "MKL_CBWR": "COMPATIBLE",
    "ONEDNN_MAX_CPU_ISA": "SSE41", "NUMBA_CPU_NAME": "generic",
}  # fmt: skip
#: Other rounding on the same machine, as on another one: fewer wide instructions that sums are made of, two threads,
#: and weights whose last digits differ. The first two are also tried on recordings.
OTHER_ROUNDINGS = (
    _NARROW | {"OMP_NUM_THREADS": "2"},
    {"MOTIONLAB_NUDGE": "1", "OMP_NUM_THREADS": "1"},
    {"MOTIONLAB_NUDGE": "2", "OMP_NUM_THREADS": "1"},
    _NARROW | {"OMP_NUM_THREADS": "1"},
    {
        "ATEN_CPU_CAPABILITY": "avx2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "OMP_NUM_THREADS": "1",
    },
)


@dataclass(frozen=True)
class Run:
    """How one notebook went: seconds it took, and where and why it stopped, if it did."""

    notebook: str
    seconds: float
    failed_cell: int | None = None
    error: str = ""

    @property
    def ok(self) -> bool:
        """It ran to its end."""
        return not self.error

    def status(self) -> str:
        """Returns "ran", or where it failed."""
        if self.ok:
            return "ran"
        return "failed" if self.failed_cell is None else f"failed at cell {self.failed_cell}"


def find_notebooks(names: Sequence[str] = ()) -> list[Path]:
    """Returns the suite in its order, or those of it whose file name starts with one of ``names`` ("02").

    Raises:
        MissingData: this is not a checkout, or a name fits no notebook.
    """
    suite = sorted(NOTEBOOKS.glob("[0-9][0-9]*_*.ipynb"))
    if not suite:
        raise MissingData(f"{NOTEBOOKS}/NN_*.ipynb", "Run this in a checkout of motionlab.")
    unknown = [name for name in names if not any(path.name.startswith(Path(name).name) for path in suite)]
    if unknown:
        raise MissingData(f"notebook {unknown[0]!r}", f"There are: {', '.join(path.stem for path in suite)}.")
    chosen = [path for path in suite if any(path.name.startswith(Path(name).name) for name in names)]
    return chosen if names else suite


# ------------------------------------------------------------------------------------------------------- one notebook
async def _execute(path: Path, out: Path, environment: Mapping[str, str]) -> Run:
    """Runs one notebook into another file (or its own), with these variables set beside those of this process.

    Whatever happens in it is reported, not raised. ``out`` gets the outputs up to the cell that failed; where ``out``
    is ``path`` itself, nothing unless it ran to its end.
    """
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    start = time.perf_counter()
    failed: dict = {}
    book = None
    try:
        book = nbformat.read(path, as_version=4)
        client = NotebookClient(
            book,
            timeout=None,
            startup_timeout=120,
            kernel_name="python3",
            record_timing=False,
            store_widget_state=False,
            shutdown_kernel="immediate",  # a second less for every notebook; what it leaves lies in ``bench``
            extra_arguments=_QUIET,
            resources={"metadata": {"path": str(path.parent)}},
        )
        with tempfile.TemporaryDirectory(prefix="motionlab-", ignore_cleanup_errors=True) as bench:
            await client.async_execute(env={**os.environ, "TMPDIR": bench, **environment})
    except CellExecutionError as error:
        failed = {"failed_cell": _last_cell(book), "error": f"{error.ename}: {error.evalue}"}
    except Exception as error:  # a kernel that dies, a notebook that is no notebook: report it, run the others
        failed = {"error": f"{type(error).__name__}: {error}"}
    if book is not None and (not failed or out != path):
        book.metadata = {  # what differs from run to run (kernel details) is not stored
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
        nbformat.write(book, out)
    return Run(path.stem, time.perf_counter() - start, **failed)


def _last_cell(book) -> int:
    return max((cell.get("execution_count") or 0 for cell in book.cells if cell.cell_type == "code"), default=0)


# ------------------------------------------------------------------------------------------------------ several of them
def run_side_by_side(
    jobs: Sequence[tuple[Path, Path]],
    environment: Mapping[str, str],
    *,
    done: Callable[[Run, Path], object] = lambda run, out: None,
    processes: int | None = None,
) -> list[Run]:
    """Runs notebooks (from, to) on as many processes as there are cores, one thread each; prints a line for each.

    Those that took longest when last recorded begin first. done: called with every run as it ends. ``processes``:
    unless given, the cores of this machine.

    Returns:
        how they went, in the order of ``jobs``.
    """
    processes = processes or parallel.cores()
    environment = ONE_THREAD | dict(environment)
    runs: dict[Path, Run] = {}

    async def worker(queue: list[tuple[Path, Path]]) -> None:
        while queue:
            path, out = queue.pop(0)
            runs[path] = await _execute(path, out, environment)
            run = runs[path]
            print(f"[{len(runs)}/{len(jobs)}] {path.stem:<30} {run.seconds:5.0f} s  {run.status()}", flush=True)
            await asyncio.to_thread(done, run, out)

    async def everything() -> None:
        queue = sorted(jobs, key=lambda job: -_smoke_seconds(job[0]))
        await asyncio.gather(*(worker(queue) for _ in range(min(processes, len(jobs)))))

    asyncio.run(everything())
    return [runs[path] for path, _ in jobs]


def _smoke_seconds(path: Path) -> float:
    """Seconds that a notebook's smoke run took when its fingerprint was taken; infinite where nobody knows."""
    try:
        return float(findings.load_record(_record_path(path)).provenance["smoke seconds"])
    except (DataError, KeyError, ValueError):
        return float("inf")


def _record_path(notebook: Path) -> Path:
    """Where the record of a notebook lies: results/NN.json beside it."""
    return notebook.parent / "results" / f"{staleness.number_of(notebook.stem)}.json"


def regenerate(names: Sequence[str] = ()) -> list[Run]:
    """Runs notebooks in place with the full profile and takes fingerprints: what is committed is what the code gives.

    A notebook that fails keeps its file.
    """
    runs = []
    environment = {"MOTIONLAB_PROFILE": "full", "MOTIONLAB_BATCH": "1", "MOTIONLAB_RECORD": "1"} | data_variable()
    for path in find_notebooks(names):
        print(f"{path.stem} ...", flush=True)
        runs.append(asyncio.run(_execute(path, path, environment)))
        if runs[-1].ok:
            runs[-1] = _with_fingerprint(path, runs[-1], again=True, apart={})
        print(f"      {runs[-1].status()}, {runs[-1].seconds:.0f} s", flush=True)
    return runs


# -------------------------------------------------------------------------------------------------------- fingerprints
def take_fingerprints(names: Sequence[str] = (), *, again: bool = False) -> list[Run]:
    """Runs notebooks in the smoke profile and writes what they measure, and a hash of their cells, into their records.

    For a record without a fingerprint, or whose cells were reworded: the full findings stay as they are.

    again: take it also where it differs from the recorded one, as where a budget of the smoke profile was changed.
    """
    apart = {"fingerprint": f"taken again on {date.today()}, apart from the full run"} if again else {}
    how = {"again": again, "apart": apart}
    return [_with_fingerprint(path, Run(path.stem, 0.0), **how) for path in find_notebooks(names)]


def _with_fingerprint(path: Path, run: Run, **how) -> Run:
    """Take the fingerprint of one notebook; the run with its seconds, or with what went wrong."""
    began = time.perf_counter()
    try:
        _write_fingerprint(path, **how)
    except DataError as error:
        run = replace(run, error=str(error))
    return replace(run, seconds=run.seconds + time.perf_counter() - began)


def _write_fingerprint(path: Path, *, again: bool = False, apart: Mapping[str, str] | None = None) -> None:
    """Take the fingerprint of a notebook and put it into its record.

    A record that has one is only confirmed: a smoke run on synthetic motion and, where $MOTIONLAB_DATA names some, one
    on recordings must agree with it. A new one is what the smoke profile measures in six runs on synthetic motion and
    three on recordings, as it is and with other rounding, so that the numbers say how far rounding moves them. apart:
    what the record's provenance says of one that was not taken together with the full run.

    Raises:
        StaleRecord: the record has another fingerprint, and ``again`` is not given.
        DataError: there is no record, or a run failed.
    """
    place = _record_path(path)
    record = findings.load_record(place)
    confirm = bool(record.fingerprint) and not again
    plain, nothing, data = {"OMP_NUM_THREADS": "1"}, {"MOTIONLAB_DATA": ""}, data_variable()
    runs = _measured(path, [nothing | each for each in (plain, *(() if confirm else OTHER_ROUNDINGS))])
    with_data = (
        _measured(path, [data | each for each in (plain, *OTHER_ROUNDINGS[: 2 * (1 - confirm)])]) if data else []
    )
    last = (with_data or runs)[0]
    if confirm:
        moved = staleness.differences(record.fingerprint, runs[0].fingerprint)
        moved += staleness.differences(record.expected(last.recordings), last.fingerprint) if with_data else []
        if moved:
            raise staleness.StaleRecord(path.stem, list(dict.fromkeys(moved)), record.seconds)
    else:
        made = [run.fingerprint for run in runs]
        there = [run.fingerprint for run in with_data]
        found, unsteady = staleness.merged(made)
        real, more = staleness.merged(there) if there else ({}, [])
        for name in dict.fromkeys((*unsteady, *more)):
            print(f"      {name}: differs too much with other rounding, not in the fingerprint", flush=True)
        real = {name: mark for name, mark in real.items() if name not in found or not mark.agrees(found[name])}
        record = replace(record, fingerprint=found, fingerprint_on_recordings=real, recordings=last.recordings)
    findings.save_record(
        place,
        replace(
            record,
            source_hash=staleness.code_hash(path),
            weights=last.weights,
            modules=last.modules,
            provenance=record.provenance | {"smoke seconds": runs[0].provenance["seconds"]} | dict(apart or {}),
        ),
    )


def _measured(path: Path, environments: Sequence[Mapping[str, str]]) -> list[findings.Record]:
    """The records of smoke runs of one notebook, one after the other."""
    found = []
    for environment in environments:
        with tempfile.TemporaryDirectory() as folder:
            smoke = {"MOTIONLAB_PROFILE": "smoke", "MOTIONLAB_BATCH": "1"}
            smoke |= {"MOTIONLAB_RESULTS": folder, "MOTIONLAB_RECORD": "1"}
            run = asyncio.run(_execute(path, Path(folder) / path.name, smoke | dict(environment)))
            if not run.ok:
                raise DataError(f"{run.status()}: {run.error}", path=path, remedy="mend it, then take its fingerprint")
            found.append(findings.load_record(Path(folder) / f"{staleness.number_of(path.stem)}.json"))
    return found


def data_variable() -> dict[str, str]:
    """Returns $MOTIONLAB_DATA as an absolute path, if set: notebooks run in their own folder, not in the caller's."""
    folder = os.environ.get("MOTIONLAB_DATA")
    return {"MOTIONLAB_DATA": str(Path(folder).expanduser().resolve())} if folder else {}


def run_summary(runs: Sequence[Run]) -> str:
    """Returns a text for the terminal that says how the runs went."""
    width = max((len(run.notebook) for run in runs), default=0)
    lines = [f"{'ok ' if r.ok else '-- '} {r.notebook:<{width}} {r.seconds:6.0f} s  {r.status()}" for r in runs]
    lines += [f"    {run.notebook}: {run.error.splitlines()[0]}" for run in runs if not run.ok]
    return "\n".join([*lines, f"{sum(run.ok for run in runs)} of {len(runs)} notebooks ran"])


def changed_behind(root: Path = ROOT) -> str:
    """Says what changed in the code behind the records since their fingerprints were taken. For information: whether
    it matters says the smoke run of ``make test``."""
    touched: dict[str, list[str]] = {}
    paths = sorted((root / "notebooks" / "results").glob("[0-9][0-9]*.json"))
    for path in paths:
        for module in staleness.changed_modules(findings.load_record(path).modules, root):
            touched.setdefault(module, []).append(path.stem)
    lines = [f"  {module} ({' '.join(books)})" for module, books in sorted(touched.items())]
    return "\n".join([f"{len(paths)} records; changed behind them: {len(touched) or 'nothing'}", *lines])
