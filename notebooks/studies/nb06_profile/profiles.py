"""Where the time of a call goes, and how much memory it holds, by torch's profiler."""

import os
from collections.abc import Callable

import torch
from torch.profiler import ProfilerActivity, profile

os.environ.setdefault("KINETO_LOG_LEVEL", "6")  # torch's profiler announces itself on stderr at any lower one


def peak_memory(call: Callable[[], object]) -> int:
    """Most bytes of tensors that ``call()`` held at once beyond those before it; on the GPU where there is one.

    On the CPU it adds up torch's own record of every allocation and release, so neither Python's objects nor
    what the allocator keeps in reserve count.
    """
    if torch.cuda.is_available():
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        call()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        call()
    held, peak = 0, 0
    events = [e for e in record.profiler.kineto_results.events() if e.name() == "[memory]"]
    for event in sorted(events, key=lambda e: e.start_ns()):
        held += event.nbytes()
        peak = max(peak, held)
    return peak


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
