"""Two layouts of one motion (D02), and which samples notebook 13 keeps to show."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion.windows import gather, on_standard
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb13_worlds import films, layouts
from studies.shared import small_measures, small_models


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


def test_the_samples_shown_skate_little_middling_and_much_and_travel(clips):
    still = replace(clips, root=clips.root[:, :1].expand_as(clips.root), rot=clips.rot)
    sliding = [replace(clips, root=clips.root * torch.tensor([k, k, 1.0])) for k in (1.0, 1.6, 2.5)]
    every = [still, *sliding]
    made = Motion(STANDARD, *(torch.cat([getattr(m, name) for m in every]) for name in ("root", "rot")), clips.fps)
    shown = films.typical(made)
    skating = small_measures.skating(shown)
    assert len(skating) == 3 and (skating.diff() >= 0).all() and skating[0] < skating[2]
    assert small_measures.travel(shown).min() >= 0.2


def test_what_is_kept_to_show_is_of_the_arms_and_small():
    found = films.kept()
    assert set(found) == {arm.name for arm in small_models.SETS["frames"]}
    for motion in found.values():
        assert motion.rot.shape == (3, 60, len(STANDARD), 3, 3)
        assert motion.root[:, 0, :2].abs().max() < 1e-4  # from the first frame on
    assert (small_models.RECORDS / "small_frames_films.npz").stat().st_size < 200_000
