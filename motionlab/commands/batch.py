"""Runs a function over many clips, on this machine or on a Dask cluster: finished ones are skipped, one that fails or
kills its process is named and the others go on, and what is done stays done."""

import argparse
import sys
import traceback
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from motionlab.errors import DataError, MissingData, NotConverged, ShapeError
from motionlab.parallel import run_jobs, threads_for

Job = tuple[str, Path | None, Path | None, Path]  # name, what it is read from (one or two paths), and where it goes
PATIENCE = 60.0  # seconds that a cluster has to answer, and to have a worker


class Failed(NamedTuple):
    """Why a clip failed. trace: where, if it was no error that names the clip's own fault."""

    message: str
    trace: str = ""


class Batch(NamedTuple):
    """What became of the jobs, each by its place in the list: what the function returned, what had been finished
    before, and what failed."""

    results: dict[int, Any]
    skipped: tuple[int, ...]
    failed: dict[int, Failed]

    def __str__(self) -> str:
        """What became of them in numbers: "20 clips: 18 done, 2 failed"."""
        counts = {"done": self.results, "finished before": self.skipped, "failed": self.failed}
        said = ", ".join(f"{len(those)} {word}" for word, those in counts.items() if those or word == "done")
        return f"{sum(map(len, counts.values()))} clips: {said}"


def run_many(
    function: Callable[[Any], Any], jobs: Sequence[Any], *, finished: Callable[[Any], bool] | None = None,
    jobs_at_once: int = 1, cluster: str | None = None, name: Callable[[Any], str] = str,
) -> Batch:  # fmt: skip
    """Runs a function on every job that is not finished yet, each on one thread; shows progress.

    A job that raises is reported when it does and at the end, and so is one whose process is killed, and again while
    it is alone; all others are done. Nothing is shared between jobs. A single job runs in this process, where Ctrl-C
    means to a fit that it should end at its best; of several, Ctrl-C ends those that have begun, without a result. A
    cluster drops what has not begun; what its workers have begun they finish, unseen from here.

    function: of one job; both are pickled, so a module's function, or a ``functools.partial`` of one. finished: whether
    a job has been, by what its function writes last; asked before, and after. jobs_at_once: processes on this machine.
    cluster: instead of these, address of a Dask scheduler, tcp://HOST:PORT, whose workers do them, one thread each;
    they need this library, and the folders of the jobs under the same names. name: of a job, for messages.

    Raises:
        DataError: no such cluster, one without workers, with workers of several threads, or one that went away; what
            is done stays done. MissingData: a cluster without the package ``distributed``.
    """
    left = [k for k, job in enumerate(jobs) if finished is None or not finished(job)]
    batch = Batch({}, tuple(sorted({*range(len(jobs))} - {*left})), {})
    with tqdm(total=len(jobs), initial=len(batch.skipped), desc="clips", disable=len(jobs) < 2) as progress:

        def done(k: int, found: Any) -> None:
            if not isinstance(found, Failed) and finished is not None and not finished(jobs[k]):
                unshared = "done, but what it writes last is not here: do its workers share this folder?"
                found = Failed("stopped before it was done" if cluster is None else unshared)
            if isinstance(found, Failed):
                batch.failed[k] = found
                progress.write(f"{name(jobs[k])}: {found.message}\n{found.trace}".rstrip(), file=sys.stderr)
                progress.set_postfix(failed=len(batch.failed))
            else:
                batch.results[k] = found
            progress.update()

        work = {k: partial(_attempt, function, jobs[k]) for k in left}
        if cluster is None:
            _on_processes(work, jobs_at_once, done, apart=len(jobs) > 1)
        else:
            _on_cluster(work, cluster, done)
    return batch


def run_clips(
    function: Callable, clips: Sequence[Job], finished: Callable, options: argparse.Namespace, compared: bool = False
) -> int:
    """Runs a command on every clip that is not finished; prints what was done, and every note once.

    function: of a clip, to its notes; a module's function or a partial of one. compared: whether ``finished`` asks for
    the same options. Returns 1 where a clip failed, else 0. Raises what :func:`run_many` does.
    """
    clips = [(name, *(path and path.resolve() for path in paths)) for name, *paths in clips]  # for other machines
    jobs = 1 if options.jobs is None else options.jobs
    how = {"jobs_at_once": jobs, "cluster": options.cluster, "name": itemgetter(0)}
    found = run_many(function, clips, finished=finished, **how)
    said = defaultdict(list)
    for k, notes in sorted(found.results.items()):
        for note in notes:
            said[note].append(clips[k][0])
    for note, names in said.items():
        print(f"note: {note} ({names[0] if len(names) == 1 else f'{len(names)} clips'})")
    print(found)
    if found.skipped:
        how = "" if compared else ", perhaps made with other options"
        print(f"note: clips that were finished before{how}, stay as they are; to make one again, delete what it wrote")
    if found.failed:  # why was said when it happened
        print(f"failed: {', '.join(clips[k][0] for k in sorted(found.failed))}", file=sys.stderr)
    return 1 if found.failed else 0


def _attempt(function: Callable[[Any], Any], job: Any) -> Any:
    """What the function returns, or why it does not: errors themselves may not survive the way between processes."""
    try:
        with threads_for(1):
            return function(job)
    except (DataError, MissingData, ShapeError, NotConverged) as error:
        return Failed(str(error))
    except Exception as error:  # one clip's, and there are others
        return Failed(f"{type(error).__name__}: {error}", traceback.format_exc())


def _on_processes(work: dict[int, Callable], count: int, done: Callable[[int, Any], None], apart: bool) -> None:
    """Do all of it. Where a process is killed, its pool is lost: those that had begun go on one by one, where whoever
    loses its process again is the one to blame."""
    left = dict(work)

    def ended(k: int, found: Any) -> None:
        del left[k]
        done(k, found)

    def together(keys: list[int], workers: int) -> bool:
        try:
            run_jobs([work[k] for k in keys], workers, lambda i, found: ended(keys[i], found), apart)
        except BrokenProcessPool:
            return False
        return True

    while left and not together(list(left), min(count, len(left))):
        for k in list(left)[:count]:  # they begin in their order
            if not together([k], 1):
                ended(k, Failed("its process was killed twice: is there enough memory?"))


def _on_cluster(work: dict[int, Callable[[], Any]], address: str, done: Callable[[int, Any], None]) -> None:
    """Do all of it. Dask gives what a lost worker had begun, or held, to another."""
    try:
        import distributed
    except ImportError as error:
        how = "Install it in the checkout: pip install -e '.[cluster]'."
        raise MissingData("the package distributed, which speaks to a Dask cluster,", how) from error
    try:
        client = distributed.Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        message = f"no Dask scheduler answers: {error}"
        raise DataError(message, path=address, remedy="start `dask scheduler`, which says its address") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as error:
            remedy = f"start `dask worker {address} --nthreads 1` on each machine, one a core"
            raise DataError("the cluster has no worker", path=address, remedy=remedy) from error
        several = [name for name, worker in client.scheduler_info()["workers"].items() if worker["nthreads"] > 1]
        if several:  # torch counts its threads per process: jobs beside each other would change each other's numbers
            message = f"{len(several)} workers have several threads, such as {several[0]}"
            raise DataError(message, path=address, remedy="start each with --nthreads 1, one a core")
        futures = {client.submit(each, pure=False): k for k, each in work.items()}
        try:
            for future in distributed.as_completed(list(futures)):
                k = futures.pop(future)
                error = None if future.status == "finished" else future.exception()
                if future.cancelled() or isinstance(error, distributed.CancelledError):
                    remedy = "start it and run the same command again: what is finished is skipped"
                    raise DataError("the cluster went away", path=address, remedy=remedy)
                done(k, future.result() if error is None else Failed(f"{type(error).__name__}: {error}"))
        finally:
            client.cancel(list(futures))
