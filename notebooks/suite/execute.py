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
from motionlab.commands.doctor import ROOT
from motionlab.errors import DataError, MissingData
from suite import findings, staleness
from suite.findings import Record

NOTEBOOKS = ROOT / "notebooks"
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
    {"ATEN_CPU_CAPABILITY": "avx2", "MKL_ENABLE_INSTRUCTIONS": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2",
     "OMP_NUM_THREADS": "1"},
)  # fmt: skip


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
        where = "" if self.failed_cell is None else f" at cell {self.failed_cell}"
        return "ran" if self.ok else f"failed{where}"


def find_notebooks(names: Sequence[str] = ()) -> list[Path]:
    """Returns the suite in its order, or those of it whose file name starts with one of ``names`` ("02").

    Raises:
        MissingData: this is not a checkout, or a name fits no notebook.
    """
    suite = sorted(NOTEBOOKS.glob("[0-9][0-9]*_*.ipynb"))
    if not suite:
        raise MissingData(f"{NOTEBOOKS}/NN_*.ipynb", "Run this in a checkout of motionlab.")
    chosen = set() if names else set(suite)
    for name in names:
        if not (found := [path for path in suite if path.name.startswith(Path(name).name)]):
            raise MissingData(f"notebook {name!r}", f"There are: {', '.join(path.stem for path in suite)}.")
        chosen |= set(found)
    return sorted(chosen)


# ------------------------------------------------------------------------------------------------------- one notebook
async def _execute(path: Path, out: Path, environment: Mapping[str, str]) -> Run:
    """Runs one notebook into another file (or its own), with these variables set beside those of this process. Whatever
    happens in it is reported, not raised. ``out`` gets the outputs up to the cell that failed; where ``out`` is
    ``path`` itself, nothing unless it ran to its end."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    start, failed, book = time.perf_counter(), {}, None
    try:
        book = nbformat.read(path, 4)
        client = NotebookClient(  # "immediate" ends a second sooner; what the kernel leaves lies in ``bench``
            book, timeout=None, startup_timeout=120, kernel_name="python3", record_timing=False,
            store_widget_state=False, shutdown_kernel="immediate", resources={"metadata": {"path": str(path.parent)}},
            extra_arguments=["--log-level=40"],  # its advice on encrypting its own sockets is not for the reader
        )  # fmt: skip
        with tempfile.TemporaryDirectory(prefix="motionlab-", ignore_cleanup_errors=True) as bench:
            await client.async_execute(env={**os.environ, "TMPDIR": bench, **environment})
    except CellExecutionError as error:
        last = max((cell.get("execution_count") or 0 for cell in book.cells), default=0)
        failed = {"failed_cell": last, "error": f"{error.ename}: {error.evalue}"}
    except Exception as error:  # a kernel that dies, a notebook that is no notebook: report it, run the others
        failed = {"error": f"{type(error).__name__}: {error}"}
    if book is not None and (not failed or out != path):
        spec = {"display_name": "Python 3", "language": "python", "name": "python3"}
        book.metadata = {"kernelspec": spec, "language_info": {"name": "python"}}  # none of what differs run by run
        nbformat.write(book, out)
    return Run(path.stem, time.perf_counter() - start, **failed)


# ------------------------------------------------------------------------------------------------------ several of them
def run_side_by_side(
    jobs: Sequence[tuple[Path, Path]], environment: Mapping[str, str], *, done: Callable[[Run], object]
) -> list[Run]:
    """Runs notebooks (from, to) on as many processes as there are cores, one thread each, and returns how they went in
    the order of ``jobs``; prints a line for each, and calls ``done`` with each as it ends. Those that took longest when
    last recorded begin first."""
    environment, runs = ONE_THREAD | dict(environment), {}
    queue = sorted(jobs, key=lambda job: -float(findings.record_of(job[0]).provenance.get("smoke seconds", "inf")))

    async def worker() -> None:
        while queue:
            path, out = queue.pop(0)
            run = runs[path] = await _execute(path, out, environment)
            print(f"[{len(runs)}/{len(jobs)}] {path.stem:<30} {run.seconds:5.0f} s  {run.status()}", flush=True)
            done(run)

    async def everything() -> None:
        await asyncio.gather(*(worker() for _ in range(min(parallel.cores(), len(jobs)))))

    asyncio.run(everything())
    return [runs[path] for path, _ in jobs]


def regenerate(names: Sequence[str] = ()) -> list[Run]:
    """Runs notebooks in place with the full profile and takes fingerprints: what is committed is what the code gives.

    A notebook that fails keeps its file.
    """
    environment = {"MOTIONLAB_PROFILE": "full", "MOTIONLAB_BATCH": "1", "MOTIONLAB_RECORD": "1"} | data_variable()
    runs = []
    for path in find_notebooks(names):
        print(f"{path.stem} ...", flush=True)
        run = asyncio.run(_execute(path, path, environment))
        runs.append(_with_fingerprint(path, run, again=True) if run.ok else run)
        print(f"      {runs[-1].status()}, {runs[-1].seconds:.0f} s", flush=True)
    return runs


# -------------------------------------------------------------------------------------------------------- fingerprints
def take_fingerprints(names: Sequence[str] = (), *, again: bool = False) -> list[Run]:
    """Runs notebooks in the smoke profile and writes what they measure, and a hash of their cells, into their records.

    For a record without a fingerprint, or whose cells were reworded: the full findings stay as they are.

    again: take it also where it differs from the recorded one, as where a budget of the smoke profile was changed.
    """
    apart = f"taken again on {date.today()}, apart from the full run" if again else ""
    return [_with_fingerprint(path, Run(path.stem, 0.0), again, apart) for path in find_notebooks(names)]


def _with_fingerprint(path: Path, run: Run, again: bool, apart: str = "") -> Run:
    """Take the fingerprint of one notebook; the run with its seconds, or with what went wrong."""
    began = time.perf_counter()
    try:
        _write_fingerprint(path, again, apart)
    except DataError as error:
        run = replace(run, error=str(error))
    return replace(run, seconds=run.seconds + time.perf_counter() - began)


def _write_fingerprint(path: Path, again: bool = False, apart: str = "") -> None:
    """Take the fingerprint of a notebook and put it into its record.

    A record that has one is only confirmed: a smoke run on synthetic motion and, where $MOTIONLAB_DATA names some, one
    on recordings must agree with it. A new one is what the smoke profile measures in six runs on synthetic motion and
    three on recordings, as it is and with other rounding, so that the numbers say how far rounding moves them. apart:
    what the record's provenance says of one that was not taken together with the full run.

    Raises:
        StaleRecord: the record has another fingerprint, and ``again`` is not given.
        DataError: there is no record, or a run failed.
    """
    record = findings.load_record(findings.record_path(path))
    confirm = bool(record.fingerprint) and not again
    others, data = () if confirm else OTHER_ROUNDINGS, data_variable()
    runs = _measured(path, {"MOTIONLAB_DATA": ""}, others)
    with_data = _measured(path, data, others[:2]) if data else []
    last = (with_data or runs)[0]
    if confirm:
        moved = staleness.differences(record.fingerprint, runs[0].fingerprint)
        moved += staleness.differences(record.expected(last.recordings), last.fingerprint) if with_data else []
        if moved:
            raise staleness.StaleRecord(path.stem, list(dict.fromkeys(moved)), record.seconds)
    else:
        found, unsteady = staleness.merged([run.fingerprint for run in runs])
        real, more = staleness.merged([run.fingerprint for run in with_data])
        for name in dict.fromkeys(unsteady + more):
            print(f"      {name}: differs too much with other rounding, not in the fingerprint", flush=True)
        real = {name: mark for name, mark in real.items() if name not in found or not mark.agrees(found[name])}
        record = replace(record, fingerprint=found, fingerprint_on_recordings=real, recordings=last.recordings)
    said = {"smoke seconds": runs[0].provenance["seconds"]} | ({"fingerprint": apart} if apart else {})
    now = {"source_hash": staleness.code_hash(path), "weights": last.weights}
    findings.save_record(findings.record_path(path), replace(record, **now, provenance=record.provenance | said))


def _measured(path: Path, environment: dict[str, str], others: Sequence[dict[str, str]]) -> list[Record]:
    """The records of smoke runs of one notebook, one after the other: as it is, and with other roundings."""
    found = []
    for rounding in ({"OMP_NUM_THREADS": "1"}, *others):
        with tempfile.TemporaryDirectory() as folder:
            smoke = {"MOTIONLAB_PROFILE": "smoke", "MOTIONLAB_BATCH": "1", "MOTIONLAB_RESULTS": folder}
            run = asyncio.run(_execute(path, Path(folder) / path.name, smoke | environment | rounding))
            if not run.ok:
                raise DataError(f"{run.status()}: {run.error}", path=path, remedy="mend it, then take its fingerprint")
            found.append(findings.load_record(Path(folder) / findings.record_path(path).name))
    return found


def data_variable() -> dict[str, str]:
    """Returns $MOTIONLAB_DATA as an absolute path, if set: notebooks run in their own folder, not in the caller's."""
    folder = os.environ.get("MOTIONLAB_DATA")
    return {"MOTIONLAB_DATA": str(Path(folder).expanduser().resolve())} if folder else {}


def run_summary(runs: Sequence[Run]) -> str:
    """Says for the terminal how many notebooks ran, and why the others did not."""
    failed = [f"-- {run.notebook} {run.status()}: {run.error.splitlines()[0]}" for run in runs if not run.ok]
    return "\n".join([*failed, f"{len(runs) - len(failed)} of {len(runs)} notebooks ran"])
