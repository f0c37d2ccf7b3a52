"""What every test shares."""

import os

import pytest
import torch

os.environ.setdefault("MOTIONLAB_BATCH", "1")  # nobody sits in front of a test
torch.set_num_threads(1)  # the suite runs in parallel processes

TOLERANCE = {torch.float64: 1e-10, torch.float32: 1e-5}  # exceptions stand beside their test, with the reason


@pytest.fixture
def generator() -> torch.Generator:
    """A fresh generator, the same in every run."""
    return torch.Generator().manual_seed(0)
