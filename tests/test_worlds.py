"""Two layouts of one motion (D02), and measures that tell feet that stand from feet that slide."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD
from studies.shared import small_measures


@pytest.fixture(scope="module")
def clips():
    """Windows (8, 40) of one walking, stopping and turning person."""
    motion = on_standard(perform_sequence(Corpus(seconds=20.0, seed=3), 0).motion)
    return replace(gather([motion], 40).evenly(8), skeleton=STANDARD)


def test_feet_stand_in_walking_and_slide_where_roots_are_others(clips):
    mixed = small_measures.with_others_roots(clips, torch.Generator().manual_seed(0))
    assert small_measures.skating(clips).mean() < 0.1
    assert small_measures.skating(mixed).mean() > 0.2 + small_measures.skating(clips).mean()
    assert small_measures.driven(clips).nanmean() > 0.9
    assert small_measures.slide_mm(mixed).nanmean() > 2 * small_measures.slide_mm(clips).nanmean()
    still = replace(clips, root=clips.root[:, :1].expand_as(clips.root))
    assert small_measures.driven(still).isnan().all()  # who goes nowhere has none
    assert small_measures.travel(still).max() == 0
