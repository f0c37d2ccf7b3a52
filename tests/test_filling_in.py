"""What could be silently wrong in notebook 12: where B is put, the cut, and what tells a seam."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.bench import cases
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD
from studies.nb12_filling_in import flaws, switching
from studies.shared import fill_people as people


@pytest.fixture(scope="module")
def windows():
    motion = on_standard(perform_sequence(Corpus(seconds=12.0, seed=3), 0).motion)
    return replace(gather([motion], people.FRAMES, mirrored=False).evenly(4), skeleton=STANDARD)


def test_who_goes_on_as_before_arrives_where_it_would():
    """Two straight glides at one speed: behind the gap the second goes on along the first one's line."""
    rot = torch.eye(3).expand(1, people.FRAMES, len(STANDARD), 3, 3)
    time = torch.arange(people.FRAMES)[:, None] / 30.0
    glide = switching.Motion(
        STANDARD, (time * torch.tensor([0.0, 1.5, 0.0]) + torch.tensor([0.3, 0.1, 0.9]))[None], rot, 30.0
    )
    given, known = switching.asked(glide, replace(glide, root=glide.root + 7.0 * torch.tensor([1.0, 1.0, 0.0])))
    where = known[0, :, -2]
    assert (given.root - glide.root)[0, where].abs().max() < 1e-5 and int((~where).sum()) == switching.GAP


def test_the_best_cut_of_a_motion_into_itself_is_that_motion(windows):
    cut = switching.cut_and_faded(windows, windows)
    assert (cut.positions - windows.positions).norm(dim=-1).max() < 1e-3


def test_control_another_motion_makes_another_cut(windows):
    other = windows.clip(torch.tensor([1, 2, 3, 0]))
    cut = switching.cut_and_faded(windows, other)
    end = (people.FRAMES + switching.GAP) // 2
    assert torch.equal(cut.rot[:, : end - switching.GAP], windows.rot[:, : end - switching.GAP])
    assert (cut.rot[:, end:, 1:] - other.rot[:, end:, 1:]).abs().max() < 1e-4


def test_a_shifted_middle_jumps_at_the_seams_and_the_truth_does_not(windows):
    known = cases.gap(len(windows.root), people.FRAMES, 30)
    shift = 0.1 * (~known[..., -2:-1]).float() * torch.tensor([1.0, 0.0, 0.0])
    ends = flaws.seams({"truth": windows, "shifted": replace(windows, root=windows.root + shift)}, known)
    more = ends["shifted"][flaws.JUMP] - ends["truth"][flaws.JUMP]
    assert (more > 0.1 * 30 / 2).all() and ends["truth"][flaws.OFF].max() == 0
    assert torch.allclose(ends["shifted"][flaws.LEAVES], torch.tensor(10.0), atol=1e-3)
