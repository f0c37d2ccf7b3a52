"""Runs independent jobs on several processes, one thread each; more threads only where a batch is large enough."""

import os
import pickle
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import active_children, get_context

import torch

#: Rows of a batch that gets more than one thread: beside other work, fewer lose by it (commit 42ccf110 measured it).
WIDE = 256


@contextmanager
def threads_for(rows: int) -> Iterator[None]:
    """Limits torch to one thread inside the block, unless ``rows`` is at least ``WIDE``."""
    before = torch.get_num_threads()
    if rows < WIDE:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def cores() -> int:
    """Counts the cores that this process may use: in a container, fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_jobs(
    jobs: Sequence[Callable], workers: int, done: Callable = lambda k, found: None, apart: bool = False
) -> list:
    """Runs jobs in ``workers`` processes, one thread each; returns their results in order. With one worker they run
    here, one after the other, unless ``apart``. One that fails, or Ctrl-C, ends them all.

    done: called here with the number of a job and what it returned, as soon as it has."""
    found = {}
    if workers == 1 and not apart:
        with threads_for(1):
            for k, job in enumerate(jobs):
                found[k] = job()
                done(k, found[k])
        return list(found.values())
    others = set(active_children())
    with ProcessPoolExecutor(workers, get_context("spawn"), _worker) as pool:
        futures = {pool.submit(_called, pickle.dumps(job)): k for k, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                k = futures[future]
                found[k] = pickle.loads(future.result())
                done(k, found[k])
            return [found[k] for k in range(len(jobs))]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in (left := set(active_children()) - others):
                worker.terminate()
            while any(worker.is_alive() for worker in left):  # not join: the pool waits, too, and one of two is told
                time.sleep(0.01)
            raise


def _worker() -> None:
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a fit would take it for "stop at your best"; who waits ends it


def _called(job: bytes) -> bytes:
    """Bytes, since tensors between processes would keep a file open each."""
    return pickle.dumps(pickle.loads(job)())
