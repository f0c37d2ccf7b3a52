"""Measures how long a call takes, and counts the steps of autograd behind it."""

from __future__ import annotations

import gc
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

Name = TypeVar("Name", bound=Hashable)


class Timing(NamedTuple):
    """Seconds per call."""

    median: float
    iqr: float  #: spread: third quartile minus first
    n: int  #: calls measured


def _timed(
    call: Callable[[], object], *, n: int = 7, warm_up: int = 1, clock: Callable[[], float] = time.perf_counter
) -> Timing:
    """Wall time of ``call()``, garbage collection off, after ``warm_up`` calls that do not count.

    Waits for the GPU where there is one. The median, because a shared machine only ever adds time. With
    ``time.process_time`` as the clock only the time counts in which the processor worked for this process.

    Raises:
        ValueError: n is less than one.
    """
    if n < 1:
        raise ValueError(f"n: expected at least one measured call, got {n}")
    wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    for _ in range(warm_up):
        call()
    seconds = []
    was_on = gc.isenabled()
    gc.disable()
    try:
        for _ in range(n):
            wait()
            start = clock()
            call()
            wait()
            seconds.append(clock() - start)
    finally:
        if was_on:
            gc.enable()
    low, median, high = torch.tensor(seconds, dtype=torch.float64).quantile(torch.tensor([0.25, 0.5, 0.75]).double())
    return Timing(median.item(), (high - low).item(), n)


def interleaved(
    calls: Mapping[Name, Callable[[], object]],
    *,
    n: int = 7,
    warm_up: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Name, Tensor]:
    """Measures seconds (n,) of every call, by name: n rounds through all, so that a machine that slows down slows all.

    Garbage collection is off; each call runs ``warm_up`` times before the first round. clock: as for :func:`_timed`.

    Raises:
        ValueError: n is less than one.
    """
    if n < 1:
        raise ValueError(f"n: expected at least one measured round, got {n}")
    seconds = {name: torch.zeros(n, dtype=torch.float64) for name in calls}
    for call in calls.values():
        for _ in range(warm_up):
            call()
    for k in range(n):
        for name, call in calls.items():
            seconds[name][k] = _timed(call, n=1, warm_up=0, clock=clock).median
    return seconds


class Stopwatch:
    """Seconds by label, added up: ``with watch("chain"): ...``; unlike a profiler it slows nothing down."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock, self.seconds = clock, defaultdict(float)

    @contextmanager
    def __call__(self, label: str) -> Iterator[None]:
        """Time what happens inside."""
        wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
        wait()
        start = self.clock()
        yield
        wait()
        self.seconds[label] += self.clock() - start


def graph_nodes(*outputs: Tensor) -> int:
    """Counts the autograd nodes behind the outputs: the steps of one backward pass, leaves included."""
    seen, queue = set(), [y.grad_fn for y in outputs if y.grad_fn is not None]
    while queue:
        node = queue.pop()
        if node not in seen:
            seen.add(node)
            queue.extend(parent for parent, _ in node.next_functions if parent is not None)
    return len(seen)
