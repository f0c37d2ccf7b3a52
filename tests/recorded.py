"""The recordings that some tests read; without them these say so and are left out."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("MOTIONLAB_DATA") or "no recordings")
needs_data = pytest.mark.skipif(
    not os.environ.get("MOTIONLAB_DATA"), reason="set MOTIONLAB_DATA to the unpacked recordings"
)
