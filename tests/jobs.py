"""Jobs for other processes, which load this file and no more; each takes a folder that they share."""

import json
import os
import signal
import time
from pathlib import Path

import torch

from motionlab.errors import DataError, MissingData
from motionlab.files import write_whole

LIMIT = 120.0  # seconds that a machine with much else to do may take; nothing waits for as long
copied = False  # said of the process that the tests run in


def come(flag: Path) -> None:
    """Wait until somebody says that he was there."""
    limit = time.monotonic() + LIMIT
    while not flag.exists():
        assert time.monotonic() < limit, f"nobody touched {flag.name}"
        time.sleep(0.01)


def first(folder: Path) -> tuple:
    """Ends after somebody has heard of the second."""
    come(folder / "heard")
    return os.getpid(), torch.get_num_threads(), copied


def second() -> tuple:
    return os.getpid(), torch.get_num_threads(), copied


def endless(folder: Path) -> None:
    (folder / "begun").touch()
    come(folder / "never")


def missing(folder: Path) -> None:
    come(folder / "begun")
    raise MissingData("a body", "Download it.")


def begin(flag: Path) -> bool:
    """True, and the process named in the flag, for who comes first."""
    try:
        with flag.open("x") as file:
            file.write(str(os.getpid()))
    except FileExistsError:
        return False
    return True


def clip(job: tuple[Path, int]) -> list[float]:
    """Deterministic numbers, kept in a file that is written last. Number 7 waits to be killed, the first time; 11
    cannot be read; 13 has a bug; 17 kills its process whenever there is a file that says so."""
    folder, number = job
    if number == 7 and (folder / "kill").exists() and begin(folder / "begun"):
        come(folder / "never")
    if number == 17 and (folder / "poison").exists():
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 11 and (folder / "faulty").exists():
        raise DataError("not one frame", path=f"clip {number}", remedy="record it again")
    if number == 13 and (folder / "faulty").exists():
        raise ZeroDivisionError
    noise = torch.randn(48, 48, generator=torch.Generator().manual_seed(number))
    found = torch.linalg.svdvals(noise).tolist()
    write_whole(folder / f"{number}.json", json.dumps(found))
    return found


def kept(job: tuple[Path, int]) -> bool:
    return (job[0] / f"{job[1]}.json").exists()
