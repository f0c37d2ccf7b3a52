"""Runs the suite's notebooks: side by side, in place to regenerate what is committed, or for their fingerprints."""

import asyncio
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

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


class Run(NamedTuple):
    """How one notebook went: "ran", or where it failed ("failed at cell 2"), and why, if it did."""

    notebook: str
    status: str = "ran"
    error: str = ""


def find_notebooks(names: Sequence[str] = ()) -> list[Path]:
    """Returns the suite in its order, or those of it whose file name starts with one of ``names`` ("02").

    Raises:
        MissingData: a name fits no notebook.
    """
    suite, heads = sorted(NOTEBOOKS.glob("[0-9][0-9]*_*.ipynb")), tuple(Path(name).name for name in names)
    for head in heads:
        if not any(path.name.startswith(head) for path in suite):
            raise MissingData(f"notebook {head!r}", f"There are: {', '.join(path.stem for path in suite)}.")
    return [path for path in suite if not heads or path.name.startswith(heads)]


async def _execute(path: Path, out: Path, environment: Mapping[str, str]) -> Run:
    """Runs one notebook into another file (or its own), with these variables set beside those of this process. Whatever
    happens in it is reported, not raised. ``out`` gets the outputs up to the cell that failed; where ``out`` is
    ``path`` itself, nothing unless it ran to its end."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    run, book = Run(path.stem), None
    try:
        book = nbformat.read(path, 4)
        client = NotebookClient(  # "immediate" ends a second sooner; what the kernel leaves lies in ``bench``
            book, timeout=None, startup_timeout=120, kernel_name="python3", record_timing=False,
            store_widget_state=False, shutdown_kernel="immediate", resources={"metadata": {"path": str(path.parent)}},
            extra_arguments=["--log-level=40"],  # its advice on encrypting its own sockets is not for the reader
        )  # fmt: skip
        with tempfile.TemporaryDirectory(prefix="motionlab-", ignore_cleanup_errors=True) as bench:
            own = {"TMPDIR": bench, "MOTIONLAB_BATCH": "1", "PYTHONSTARTUP": str(NOTEBOOKS / "suite" / "startup.py")}
            await client.async_execute(env={**os.environ, **own, **environment})
    except CellExecutionError as error:
        last = max((cell.get("execution_count") or 0 for cell in book.cells), default=0)
        run = Run(path.stem, f"failed at cell {last}", f"{error.ename}: {error.evalue}")
    except Exception as error:  # a kernel that dies, a notebook that is no notebook: report it, run the others
        run = Run(path.stem, "failed", f"{type(error).__name__}: {error}")
    if book is not None and (not run.error or out != path):
        spec = {"display_name": "Python 3", "language": "python", "name": "python3"}
        book.metadata = {"kernelspec": spec, "language_info": {"name": "python"}}  # none of what differs run by run
        nbformat.write(book, out)
    return run


def run_side_by_side(jobs: Sequence[tuple[Path, Path]], environment: Mapping[str, str], ran: list[Run]) -> None:
    """Runs notebooks (from, to) on as many processes as there are cores, one thread each; appends how each went to
    ``ran``, and prints it, as it ends. Those that took longest when last recorded begin first."""
    queue = sorted(jobs, key=lambda job: -float(findings.record_of(job[0]).provenance.get("smoke seconds", "inf")))

    async def worker() -> None:
        while queue:
            (path, out), start = queue.pop(0), time.perf_counter()
            ran.append(run := await _execute(path, out, ONE_THREAD | environment))
            took = f"{time.perf_counter() - start:5.0f} s"
            print(f"[{len(ran)}/{len(jobs)}] {path.stem:<30} {took}  {run.status}", flush=True)

    async def everything() -> None:
        await asyncio.gather(*(worker() for _ in range(min(parallel.cores(), len(jobs)))))

    asyncio.run(everything())


def regenerate(names: Sequence[str] = ()) -> list[Run]:
    """Runs notebooks in place with the full profile and takes fingerprints: what is committed is what the code gives.

    A notebook that fails keeps its file.
    """
    runs, environment = [], {"MOTIONLAB_PROFILE": "full", "MOTIONLAB_RESULTS": str(NOTEBOOKS / "results")}
    for path in find_notebooks(names):
        print(f"{path.stem} ...", flush=True)
        start = time.perf_counter()
        run = asyncio.run(_execute(path, path, environment))
        runs.append(run if run.error else take_fingerprint(path, again=True))
        print(f"      {runs[-1].status}, {time.perf_counter() - start:.0f} s", flush=True)
    return runs


def take_fingerprint(path: Path, *, again: bool = False) -> Run:
    """Runs a notebook in the smoke profile and writes what it measures, and a hash of its cells, into its record.

    The full findings stay as they are. A record that has a fingerprint is only confirmed: a smoke run on synthetic
    motion and, where $MOTIONLAB_DATA names some, one on recordings must agree with it. A new one is what the smoke
    profile measures in six runs on synthetic motion and three on recordings, as it is and with other rounding, so that
    the numbers say how far rounding moves them.

    again: take it also where it differs from the recorded one, as where a budget of the smoke profile was changed.
    """
    try:
        record = findings.load_record(findings.record_path(path))
        confirm = bool(record.fingerprint) and not again
        others, data = () if confirm else OTHER_ROUNDINGS, os.environ.get("MOTIONLAB_DATA")
        runs = _measured(path, "", others)
        with_data = _measured(path, data, others[:2]) if data else []
        last = (with_data or runs)[0]
        if confirm:
            moved = staleness.differences(record.fingerprint, runs[0].fingerprint)
            moved += staleness.differences(record.expected(last.recordings), last.fingerprint) if with_data else []
            if moved:
                raise staleness.StaleRecord(path.stem, list(dict.fromkeys(moved)), record.provenance)
        else:
            found, unsteady = staleness.merged([run.fingerprint for run in runs])
            real, more = staleness.merged([run.fingerprint for run in with_data] or [{}])
            for name in dict.fromkeys(unsteady + more):
                print(f"      {name}: differs too much with other rounding, not in the fingerprint", flush=True)
            real = {name: mark for name, mark in real.items() if name not in found or not mark.agrees(found[name])}
            record = replace(record, fingerprint=found, fingerprint_on_recordings=real, recordings=last.recordings)
        took = record.provenance | {"smoke seconds": runs[0].provenance["seconds"]}
        now = {"source_hash": staleness.code_hash(path), "weights": last.weights, "provenance": took}
        findings.save_record(findings.record_path(path), replace(record, **now))
    except DataError as error:
        return Run(path.stem, "failed", str(error))
    return Run(path.stem)


def _measured(path: Path, data: str, others: Sequence[dict[str, str]]) -> list[Record]:
    """The records of smoke runs of one notebook, one after the other: as it is, and with other roundings."""
    found = []
    for rounding in ({"OMP_NUM_THREADS": "1"}, *others):
        with tempfile.TemporaryDirectory() as folder:
            smoke = {"MOTIONLAB_PROFILE": "smoke", "MOTIONLAB_RESULTS": folder, "MOTIONLAB_DATA": data}
            run = asyncio.run(_execute(path, Path(folder) / path.name, smoke | rounding))
            if run.error:
                raise DataError(f"{run.status}: {run.error}", path=path, remedy="mend it, then take its fingerprint")
            found.append(findings.load_record(Path(folder) / findings.record_path(path).name))
    return found
