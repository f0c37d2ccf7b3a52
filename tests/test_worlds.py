"""Two layouts of one motion (D02), and measures that tell feet that stand from feet that slide."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD
from studies.nb13_worlds import layouts
from studies.shared import small_measures


@pytest.fixture(scope="module")
def clips():
    """Windows (8, 40) of one walking, stopping and turning person."""
    motion = on_standard(perform_sequence(Corpus(seconds=20.0, seed=3), 0).motion)
    return replace(gather([motion], 40).evenly(8), skeleton=STANDARD)


def test_a_moved_clip_is_the_same_body_elsewhere(clips):
    there = layouts.moved(clips, 90.0, 3.0)
    x, y, z = clips.positions.unbind(-1)
    torch.testing.assert_close(there.positions, torch.stack((3.0 - y, x, z), -1), atol=1e-5, rtol=0)


def test_every_layout_is_read_back_exactly_and_the_stuck_root_does_not_see_where_a_clip_is(clips):
    there, loose = layouts.lost(clips)
    assert there.shape == (len(layouts.LAYOUTS) * 8,)
    assert there.max() < 1e-5 < 0.01 < loose.max()  # the control forgets to put the first frame back
    change = layouts.changes(clips, 75.0, 10.0)
    assert change["stuck"].max() < 1e-9
    assert change["world"].min() > 1.0


def test_feet_stand_in_walking_and_slide_where_roots_are_others(clips):
    mixed = small_measures.with_others_roots(clips, torch.Generator().manual_seed(0))
    assert small_measures.skating(clips).mean() < 0.1
    assert small_measures.skating(mixed).mean() > 0.2 + small_measures.skating(clips).mean()
    assert small_measures.driven(clips).nanmean() > 0.9
    assert small_measures.slide_mm(mixed).nanmean() > 2 * small_measures.slide_mm(clips).nanmean()
    still = replace(clips, root=clips.root[:, :1].expand_as(clips.root))
    assert small_measures.driven(still).isnan().all()  # who goes nowhere has none
    assert small_measures.travel(still).max() == 0
