"""Run the notebooks of the suite: into a folder, or in place to regenerate what is committed."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from motionlab.doctor import ROOT
from motionlab.errors import MissingData

NOTEBOOKS = ROOT / "notebooks"
_QUIET = ["--log-level=40"]  # the kernel's advice on encrypting its own sockets is not for the reader


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
        """Ran, or where it failed."""
        if self.ok:
            return "ran"
        return "failed" if self.failed_cell is None else f"failed at cell {self.failed_cell}"


def find_notebooks(names: Sequence[str] = ()) -> list[Path]:
    """The suite in its order, or those of it whose file name starts with one of ``names`` ("02").

    Raises:
        MissingData: this is not a checkout, or a name fits no notebook.
    """
    suite = sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"))
    if not suite:
        raise MissingData(f"{NOTEBOOKS}/NN_*.ipynb", "Run this in a checkout of motionlab.")
    unknown = [name for name in names if not any(path.name.startswith(Path(name).name) for path in suite)]
    if unknown:
        raise MissingData(f"notebook {unknown[0]!r}", f"There are: {', '.join(path.stem for path in suite)}.")
    chosen = [path for path in suite if any(path.name.startswith(Path(name).name) for name in names)]
    return chosen if names else suite


@contextmanager
def environment(**values: str | None) -> Iterator[None]:
    """Environment variables (None: unset) for the kernels that start inside the block."""
    before = {name: os.environ.get(name) for name in values}
    _set_environment(values)
    try:
        yield
    finally:
        _set_environment(before)


def _set_environment(values: Mapping[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def execute(path: Path, out: Path) -> Run:
    """Run one notebook into another file, cell by cell; whatever happens is reported, not raised."""
    import papermill  # slow to import, and needed by this line alone
    from papermill.exceptions import PapermillExecutionError

    start = time.perf_counter()
    failed: dict = {}
    try:
        papermill.execute_notebook(
            path,
            out,
            cwd=path.parent,
            kernel_name="python3",
            progress_bar=sys.stderr.isatty(),
            start_timeout=120,
            extra_arguments=_QUIET,
        )
    except PapermillExecutionError as error:
        failed = {"failed_cell": error.exec_count, "error": f"{error.ename}: {error.evalue}"}
    except Exception as error:  # a kernel that dies, a notebook that is no notebook: report it, run the others
        failed = {"error": f"{type(error).__name__}: {error}"}
    return Run(path.stem, time.perf_counter() - start, **failed)


def regenerate(names: Sequence[str] = ()) -> list[Run]:
    """Run notebooks in place with the full profile, so that what is committed is what the code gives.

    A notebook that fails keeps its file. What differs from run to run (times, kernel details) is not stored.
    """
    runs = []
    with environment(
        MOTIONLAB_PROFILE="full", MOTIONLAB_BATCH="1", MOTIONLAB_RESULTS=None, MOTIONLAB_DATA=data_folder()
    ):
        for path in find_notebooks(names):
            print(f"{path.stem} ...", flush=True)
            runs.append(execute_in_place(path))
            print(f"      {runs[-1].status()}, {runs[-1].seconds:.0f} s", flush=True)
    return runs


def execute_in_place(path: Path) -> Run:
    """Run one notebook and store its outputs in it, if it runs to its end."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    start = time.perf_counter()
    failed: dict = {}
    try:
        book = nbformat.read(path, as_version=4)
        NotebookClient(
            book,
            timeout=None,
            kernel_name="python3",
            record_timing=False,
            store_widget_state=False,
            extra_arguments=_QUIET,
            resources={"metadata": {"path": str(path.parent)}},
        ).execute()
        book.metadata = {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
        nbformat.write(book, path)
    except CellExecutionError as error:
        failed = {"error": f"{error.ename}: {error.evalue}"}
    except Exception as error:  # as above
        failed = {"error": f"{type(error).__name__}: {error}"}
    return Run(path.stem, time.perf_counter() - start, **failed)


def data_folder() -> str | None:
    """$MOTIONLAB_DATA as an absolute path: notebooks run in their own folder, not in the caller's."""
    folder = os.environ.get("MOTIONLAB_DATA")
    return str(Path(folder).expanduser().resolve()) if folder else None


def summary(runs: Sequence[Run]) -> str:
    """How it went, as a person reads it in a terminal."""
    width = max((len(run.notebook) for run in runs), default=0)
    lines = [f"{'ok ' if r.ok else '-- '} {r.notebook:<{width}} {r.seconds:6.0f} s  {r.status()}" for r in runs]
    lines += [f"    {run.notebook}: {run.error.splitlines()[0]}" for run in runs if not run.ok]
    return "\n".join([*lines, f"{sum(run.ok for run in runs)} of {len(runs)} notebooks ran"])
