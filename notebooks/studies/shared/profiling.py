"""Measures how long a call takes, and counts the steps of autograd behind it."""

import gc
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor

Name = TypeVar("Name", bound=Hashable)


def interleaved(
    calls: Mapping[Name, Callable[[], object]], *, n: int = 7, warm_up: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Name, Tensor]:  # fmt: skip
    """Measures seconds (n,) of every call, by name: n rounds through all, so that a machine that slows down slows all.

    Garbage collection is off; each call runs ``warm_up`` times before the first round. Waits for the GPU where there is
    one. With ``time.process_time`` only the time counts in which the processor worked for this process.
    """
    for call in calls.values():
        for _ in range(warm_up):
            call()
    seconds = {name: torch.zeros(n, dtype=torch.float64) for name in calls}
    gc.disable()
    try:
        for k in range(n):
            for name, call in calls.items():
                watch = Stopwatch(clock)
                with watch("call"):
                    call()
                seconds[name][k] = watch.seconds["call"]
    finally:
        gc.enable()
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
