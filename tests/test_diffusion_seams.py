"""The seam between given and made frames: its measures, the ends of a cure, and the table."""

from dataclasses import replace

import pytest
import torch
from tiny_diffusion import FRAMES, smooth, tiny

from studies.nb13_steps import seams

KNOWN = seams.gap(FRAMES, 8)


def from_seed(name, seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def truth():
    return smooth(6, seed=3)


@pytest.mark.parametrize("frame", ["stuck", "world"])
def test_ends_are_exact_or_left(truth, frame):
    made = seams.ended(tiny(frame=frame), truth, KNOWN, from_seed(""), seams.CURES["overwrite (thesis)"][1])
    scale = seams.natural(truth)
    off = {end: seams.measure(motion, truth, KNOWN, scale)["known off"].max() for end, motion in made.items()}
    assert off["pasted"] < 1e-6 and off["faded"] < 1e-6 < 1e-4 < off["left"]
    inside = made["left"].positions[:, ~KNOWN] - made["pasted"].positions[:, ~KNOWN]
    assert inside.abs().max() < 1e-5  # pasting touches nothing else; fading does
    assert (made["faded"].positions[:, ~KNOWN] - made["left"].positions[:, ~KNOWN]).abs().max() > 1e-4


def test_a_shifted_gap_jumps(truth):
    """A body that stands, in the gap 10 cm aside: 0.1 m x 30 / s at each seam, 100 mm of error."""
    still = replace(truth, root=truth.root[:, :1].expand_as(truth.root), rot=truth.rot[:, :1].expand_as(truth.rot))
    shift = torch.where(KNOWN[:, None], 0.0, torch.tensor([0.1, 0.0, 0.0]))
    found = seams.measure(replace(still, root=still.root + shift), still, KNOWN, torch.linspace(0, 4, 101))
    assert found["gap error"] == pytest.approx(torch.full((6,), 100.0), abs=1e-3)
    assert found["jump"] == pytest.approx(torch.full((6,), 3.0), abs=1e-4)
    assert found["jump / natural"] == pytest.approx(torch.full((6,), 3 / 3.8), abs=1e-4)
    assert found["percentile"] == pytest.approx(torch.full((6,), 100 * 76 / 101), abs=1.0)
