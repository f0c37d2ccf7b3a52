"""Measures of notebooks 13 and 15: windows spoilt on purpose, a squeezed space, and feet that stand or slide."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import bench, rotation
from motionlab.bench import PersonWindows
from motionlab.diffusion.model import motion_model
from motionlab.diffusion.windows import gather, on_standard
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb15_what_it_takes import latent, learning, ruler
from studies.shared import small_measures
from studies.shared.fill_people import FRAMES
from tests.draws import seeded


def moving(count, seed=0):
    """Windows that turn their joints and walk off smoothly at random."""
    turns = torch.randn(count, FRAMES, len(STANDARD), 3, generator=seeded(seed)).cumsum(1) * 0.02
    steps = torch.randn(count, FRAMES, 3, generator=seeded(seed + 1)).cumsum(1) * 0.01
    contacts = torch.zeros(count, FRAMES, len(STANDARD.contact_names))
    return Motion(STANDARD, steps + torch.tensor([0.0, 0.0, 0.95]), rotation.exp(turns), 30.0, contacts)


def test_a_perfect_guess_leaves_nothing_and_only_legs_are_asked_for():
    people = PersonWindows(moving(4), torch.arange(4) // 2, torch.zeros(4, 1, bench.JOINTS + 2, dtype=torch.bool))
    some = learning.rows(model := motion_model("diffusion_plain"), *people)
    assert learning.left_cm(model, some, some.x).max() < 1e-3
    off = some.x + 0.1 * torch.randn(some.x.shape, generator=seeded(1))
    made, truth = (learning.filled(model, some, x).positions for x in (off, some.x))
    legs = STANDARD.indices(bench.LOWER)
    above = [j for j in range(len(STANDARD)) if j not in legs]
    assert torch.equal(made[..., above, :], truth[..., above, :])
    assert learning.left_cm(model, some, off).min() > 0.1


def test_spoilt_windows_are_spoilt_in_one_way_only():
    plain = moving(6, 3)
    made = ruler.spoilt(plain, seeded(2))
    slid = made["sliding 20 cm/s"].root - plain.root
    assert torch.allclose(slid.diff(dim=1).norm(dim=-1) * 30, torch.tensor(0.2), atol=1e-4)
    assert torch.equal(made["sliding 20 cm/s"].rot, plain.rot) and slid[..., 2].abs().max() == 0
    assert made["frozen"].positions.diff(dim=1).abs().max() == 0
    assert torch.allclose(made["floating 15 cm"].positions - plain.positions, torch.tensor([0.0, 0.0, 0.15]), atol=1e-5)
    angle = rotation.log(plain.rot.mT @ made["trembling 2 deg"].rot).square().mean().sqrt()
    assert torch.rad2deg(angle) == pytest.approx(2.0, rel=0.05)
    legs = [j for j, name in enumerate(STANDARD.names) if name.endswith(("hip", "knee", "ankle", "foot"))]
    swapped = made["legs of another"].rot
    assert torch.equal(swapped[0, :, legs], plain.rot[3, :, legs]) and torch.equal(swapped[:, :, 0], plain.rot[:, :, 0])


def test_squeezing_into_all_parts_loses_nothing_and_keeps_unit_variance():
    model = motion_model("diffusion_plain")
    x = model.encode(moving(12, 5)).flatten(1)
    space = latent.Squeezed.of(model, x, 11, seeded(3))
    assert space.lost_cm(x).max() < 0.1
    assert space.encode(x).std(0, correction=0) == pytest.approx(torch.ones(11), abs=1e-3)
    assert space.of_size(2).lost_cm(x).mean() > space.of_size(6).lost_cm(x).mean() > 0


# --------------------------------------------------------------------------------------------- feet of notebook 13
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
