"""What every test shares. Imports nothing heavy: the process that only hands out the tests reads it, too."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    import torch

ROOT = Path(__file__).resolve().parents[1]
os.environ.setdefault("MOTIONLAB_BATCH", "1")  # nobody sits in front of a test
gc.set_threshold(50_000)  # imports make many objects and hardly any garbage


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """The suite runs in parallel processes."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _no_drafts_after(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test that opens a smoke notebook leaves pictures as it found them."""
    from motionlab import viz

    monkeypatch.setattr(viz, "draft", viz.draft)


@pytest.fixture
def generator() -> torch.Generator:
    """A fresh generator, the same in every run."""
    import torch

    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def motions():
    """Two performances of the corpus, 6 s each."""
    from data_synth.corpus import Recipe, perform_sequence

    return [perform_sequence(Recipe(seconds=6.0, seed=3), index).motion for index in (0, 1)]


@pytest.fixture(scope="session")
def kit():
    """The priors that ship."""
    from motionlab.humor import pretrained

    return pretrained.load_priors()


@pytest.fixture(scope="session")
def walk():
    """Two clips of 24 frames."""
    from tests.fit_inputs import two_walks

    return two_walks()


@pytest.fixture(scope="session")
def camera():
    """A camera that sees them from the side."""
    from tests.fit_inputs import side_camera

    return side_camera()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to train in, with a cache of its own."""
    monkeypatch.setenv("MOTIONLAB_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A scheduler and two workers as a person starts them, none of which comes back; its address, and the workers."""
    pytest.importorskip("distributed")
    from tests import jobs

    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}", "OMP_NUM_THREADS": "1"}
    processes = []

    def start(program, *words):
        log = (tmp_path / f"{program}{len(processes)}.log").open("wb")
        command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *words]
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=log, stderr=log)
        processes.append(process)
        log.close()

    found = tmp_path / "scheduler.json"
    start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", found)
    jobs.come(found)
    while not (text := found.read_text()):
        time.sleep(0.01)
    address = json.loads(text)["address"]
    for _ in range(2):
        start("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
    yield address, processes
    for process in processes:
        process.kill()
        process.wait()
