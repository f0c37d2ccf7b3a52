"""Where the time of a call goes, and how much memory it holds, by torch's profiler."""

import os
from collections.abc import Callable
from itertools import accumulate

import torch
from torch.profiler import ProfilerActivity, profile

os.environ.setdefault("KINETO_LOG_LEVEL", "6")  # torch's profiler announces itself on stderr at any lower one


def peak_memory(call: Callable[[], object]) -> int:
    """Most bytes of tensors that ``call()`` held at once beyond those before it, on the CPU.

    It adds up torch's own record of every allocation and release, so neither Python's objects nor what the allocator
    keeps in reserve count.
    """
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        call()
    events = [e for e in record.profiler.kineto_results.events() if e.name() == "[memory]"]
    held = accumulate((e.nbytes() for e in sorted(events, key=lambda e: e.start_ns())), initial=0)
    return max(held)


def time_shares(call: Callable[[], object], labels: tuple[str, ...]) -> dict[str, float]:
    """Share (0..1) of the wall time of ``call()`` spent inside each ``torch.profiler.record_function(label)``.

    Labels that lie inside each other count twice; "other" is what no label holds, so with labels side by side
    the shares add up to 1. A label that never ran has share 0. Profiling slows short operations down: trust
    shares, not seconds.
    """
    with profile(activities=[ProfilerActivity.CPU]) as record, torch.profiler.record_function("__whole__"):
        call()
    total = {row.key: row.cpu_time_total for row in record.key_averages() if row.key in (*labels, "__whole__")}
    shares = {label: total.get(label, 0.0) / total["__whole__"] for label in labels}
    return shares | {"other": max(0.0, 1 - sum(shares.values()))}
