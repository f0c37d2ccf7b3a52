"""`make test`: lint, unit tests, notebooks; every step runs, and a table at the end says how each went."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
CORES = str(max(2, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1))
#: A file's tests on one worker, as what they share is made once; files in the order they are given in.
BY_FILE = ["-n", CORES, "--dist", "loadfile", "--no-loadscope-reorder"]
#: What takes longest begins first, so that no core waits for it at the end.
_LONG = "own_footage commands_many humor_testops_missing readme humor_shooting humor_testops humor_fit_cli viz"
LONGEST = [f"tests/test_{name}.py" for name in _LONG.split()]
ONE_THREAD = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "LP_NUM_THREADS")  # of each worker


def smoke_seconds(notebook: Path) -> float:
    """Seconds of the notebook's smoke run when its fingerprint was taken; infinite where nobody knows."""
    record = notebook.parent / "results" / f"{notebook.name[:2]}.json"
    try:
        return float(json.loads(record.read_text(encoding="utf-8"))["provenance"]["smoke seconds"])
    except (OSError, ValueError, KeyError):
        return float("inf")


def in_order(paths: Iterable[Path], first: Callable[[Path], float]) -> list[str]:
    """Paths as pytest is given them: those with the least ``first`` first."""
    return [path.relative_to(ROOT).as_posix() for path in sorted(paths, key=lambda path: (first(path), path.name))]


TESTS = in_order((ROOT / "tests").glob("test_*.py"), lambda path: f"tests/{path.name}" not in LONGEST)
NOTEBOOKS = in_order((ROOT / "notebooks").glob("[0-9][0-9]*_*.ipynb"), lambda path: -smoke_seconds(path))
NOTEBOOK_STEP = "notebooks (nbval, smoke)"
STEPS = {
    "lint": [BIN / "ruff", "check", "."],
    "format": [BIN / "ruff", "format", "--check", "--quiet", "."],
    "spelling": [BIN / "codespell"],
    "tests": [sys.executable, "-m", "pytest", "-q", "-p", "no:nbval", *BY_FILE, *TESTS],  # nbval takes seconds to load
    NOTEBOOK_STEP: [
        *(sys.executable, "-m", "pytest", "-q", *BY_FILE, *NOTEBOOKS),
        # lax: only cells that say so are compared. Warnings: those of the kernel are judged by
        # test_notebook_hygiene, those of the machinery around it are not ours.
        *("--nbval-lax", "--nbval-current-env", "--nbval-cell-timeout=300", "-W", "default"),
    ],
}


def main() -> int:
    environment = {**os.environ, "MOTIONLAB_PROFILE": "smoke", "MOTIONLAB_BATCH": "1", "MOTIONLAB_VERIFY": "1"}
    environment |= {name: str(Path(os.environ[name]).resolve()) for name in ["MOTIONLAB_DATA"] if os.environ.get(name)}
    environment["PYTHONSTARTUP"] = str(ROOT / "notebooks" / "suite" / "startup.py")  # of the notebooks' kernels
    environment |= {name: "1" for name in ONE_THREAD if not environment.get(name)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # our modules are compiled once, not by every process
    rows = []
    for name, command in STEPS.items():
        if name == NOTEBOOK_STEP and environment.get("MOTIONLAB_DATA"):
            print("== recordings, prepared once by all cores, not within the time of a cell", flush=True)
            prepare = (sys.executable, "-m", "motionlab", "prepare", environment["MOTIONLAB_DATA"])
            subprocess.run(prepare, cwd=ROOT, env=environment)  # a notebook that needs what is missing says so
        print(f"== {name}", flush=True)
        start = time.perf_counter()
        status = subprocess.run([str(part) for part in command], cwd=ROOT, env=environment).returncode
        rows.append((name, status, time.perf_counter() - start))
    print("\n== make test")
    for name, status, seconds in rows:
        print(f"{'ok ' if status == 0 else '-- '} {name:<27} {seconds:6.1f} s{'' if status == 0 else '  failed'}")
    failed = [name for name, status, _ in rows if status]
    data = environment.get("MOTIONLAB_DATA")
    print(f"on {'the recordings in ' + data + ' and ' if data else ''}synthetic motion")
    print(f"{len(failed)} of {len(rows)} steps failed: {', '.join(failed)}" if failed else "all passed")
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("stopped")
