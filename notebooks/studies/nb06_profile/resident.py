"""How much memory closures of stage 3 need: of a fresh process its resident set size (RSS), and their live tensors.

    python -m studies.nb06_profile.resident faithful 4     # from notebooks/: form and clips; prints bytes

The sum of live tensors (``peak_memory``) is the least that a program can hold. The resident set is what the
machine must have: interpreter, libraries, tensors, and what the allocator keeps between them.
"""

import argparse
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from data_synth import clips
from motionlab.parallel import cores
from studies.shared.savings import FORMS
from studies.shared.workload import Part, random_priors, workload

os.environ.setdefault("KINETO_LOG_LEVEL", "6")  # torch's profiler announces itself on stderr at any lower one
_CLOSURES = 3  # the first one leaves pieces behind that later ones may not fit into


def peaks(form: str, batches: Sequence[int], *, frames: int = 60, width: int = 1024) -> list[int]:
    """Measures the most bytes that a process held which ran a few closures and nothing else, for each batch.

    Every batch has a process of its own; they run side by side, which changes their time and not their memory.
    """

    def one(batch: int) -> int:
        command = [sys.executable, "-m", __name__, form, str(batch), "--frames", str(frames), "--width", str(width)]
        here, environment = Path(__file__).parents[2], os.environ | {"OMP_NUM_THREADS": "1"}
        ran = subprocess.run(command, cwd=here, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        return int(ran.stdout)

    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(one, batches))


def main(form: str, batch: int, frames: int, width: int) -> int:
    """Runs the closures in this process; returns the most bytes that it ever held."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    walk = clips.draw(1, generator, actions=("walk",))[0].motion
    work = workload(walk.cut(0, frames), random_priors(generator, width), generator, batch)
    closure = work.closure(Part(3, frames), FORMS[form])
    for _ in range(_CLOSURES):
        closure()
    return _most()


def _most() -> int:
    """Most bytes that this process held since it began. Linux's ru_maxrss also knows those of the process that started
    it, before ``exec``: hence VmHWM."""
    status = Path("/proc/self/status")
    if status.exists():
        return 1024 * int(re.search(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="ascii"))[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


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


if __name__ == "__main__":
    about = __doc__.splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m studies.nb06_profile.resident", description=about)
    parser.add_argument("form", choices=FORMS)
    parser.add_argument("batch", type=int)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--width", type=int, default=1024)
    print(main(**vars(parser.parse_args())))
