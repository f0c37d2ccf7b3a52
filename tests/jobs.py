"""Jobs for other processes, which load this file and no more; each takes a folder that they share."""

import os
import time
from pathlib import Path

import torch

from motionlab.errors import MissingData

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
