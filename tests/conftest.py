"""What every test shares. Imports nothing heavy: the process that only hands out the tests reads it, too."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    import torch

os.environ.setdefault("MOTIONLAB_BATCH", "1")  # nobody sits in front of a test


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

    return pretrained.load_priors("compact")


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
