"""`make bench`: run every bench_<part>.py, each in a process of its own; or those named on the command line."""

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
#: Where benches find the studies, and what was there before.
BESIDE = [str(HERE.parents[1] / "notebooks"), *filter(None, [os.environ.get("PYTHONPATH")])]


def main(names: list[str]) -> int:
    paths = [path for path in sorted(HERE.glob("bench_*.py")) if not names or path.stem.removeprefix("bench_") in names]
    failed = []
    for path in paths:
        print(f"== {path.stem.removeprefix('bench_')}", flush=True)
        # one thread: ratios of algorithms, not of thread pools
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(BESIDE)}
        if subprocess.run([sys.executable, path], env=environment).returncode:
            failed.append(path.stem)
    print(f"{len(paths)} benches, {len(failed)} failed{': ' + ', '.join(failed) if failed else ''}")
    return 1 if failed or not paths else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
