"""`make test`: lint, unit tests, notebooks; every step runs, and a table at the end says how each went."""

import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
PYTEST = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "no:nbval"]  # nbval takes seconds to load
END_TO_END = [
    *(f"tests/test_humor_{name}.py" for name in ("testops", "fit_cli", "training")),
    "tests/test_diffusion_training.py",
]
STEPS = {
    "lint": [BIN / "ruff", "check", "."],
    "format": [BIN / "ruff", "format", "--check", "--quiet", "."],
    "spelling": [BIN / "codespell"],
    # a file's tests on one worker: what they share is made once
    "unit tests": [*PYTEST, "--dist", "loadfile", *(f"--ignore={name}" for name in END_TO_END)],
    "end to end (fits, training)": [*PYTEST, *END_TO_END],
    "notebooks (nbval, smoke)": [
        *(sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadscope", "notebooks"),
        # lax: only cells that say so are compared. Warnings: those of the kernel are judged by
        # test_notebook_hygiene, those of the machinery around it are not ours.
        *("--nbval-lax", "--nbval-current-env", "--nbval-cell-timeout=300", "-W", "default"),
    ],
}


def main() -> int:
    environment = {**os.environ, "MOTIONLAB_PROFILE": "smoke", "MOTIONLAB_BATCH": "1"}
    environment |= {name: str(Path(os.environ[name]).resolve()) for name in ["MOTIONLAB_DATA"] if os.environ.get(name)}
    # two workers on the cores: without this each would start as many threads as there are cores
    environment.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 2) // 2)))
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # our modules are compiled once, not by every process
    rows = []
    for name, command in STEPS.items():
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
