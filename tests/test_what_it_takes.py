"""The study of notebook 15: who taught, what is on record, spoilt windows, a squeezed space, and pairs of seeds."""

import pytest
import torch

from motionlab import rotation
from motionlab.bench import cases
from motionlab.bench.person_windows import PersonWindows
from motionlab.diffusion.model import motion_model
from motionlab.diffusion.sampling import cosine
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb15_what_it_takes import figures, latent, learning, ruler
from studies.shared.fill_people import FRAMES
from tests.draws import seeded


def moving(count, seed=0):
    """Windows that turn their joints and walk off smoothly at random."""
    turns = torch.randn(count, FRAMES, len(STANDARD), 3, generator=seeded(seed)).cumsum(1) * 0.02
    steps = torch.randn(count, FRAMES, 3, generator=seeded(seed + 1)).cumsum(1) * 0.01
    contacts = torch.zeros(count, FRAMES, len(STANDARD.contact_names))
    return Motion(STANDARD, steps + torch.tensor([0.0, 0.0, 0.95]), rotation.exp(turns), 30.0, contacts)


def people(count):
    lacks = torch.zeros(count, 1, cases.JOINTS + 2, dtype=torch.bool)
    return PersonWindows(moving(count), torch.arange(count) // 2, lacks)


def test_a_perfect_guess_leaves_nothing_and_only_legs_are_asked_for():
    model, some = motion_model("diffusion_plain"), learning.rows(motion_model("diffusion_plain"), *people(4))
    assert learning.left_cm(model, some, some.x).max() < 1e-3
    off = some.x + 0.1 * torch.randn(some.x.shape, generator=seeded(1))
    made, truth = (learning.filled(model, some, x).positions for x in (off, some.x))
    legs = STANDARD.indices(cases.LOWER)
    above = [j for j in range(len(STANDARD)) if j not in legs]
    assert torch.equal(made[..., above, :], truth[..., above, :])
    assert learning.left_cm(model, some, off).min() > 0.1


def test_middle_windows_are_of_every_person():
    assert learning.middle(people(6)).tolist() == [1, 3, 5]


def test_hours_on_record_are_of_17_people_and_fall():
    for name, by in learning.hours().items():
        assert sorted(by) == [0.2, 0.8, 3.1, 6.1] and {len(x) for x in by.values()} == {17}, name
        means = [float(by[h].mean()) for h in sorted(by)]
        assert means == sorted(means, reverse=True)


def row(arm, seed, error):
    levels = {f"{k}": [error, error + k] for k in range(2)}
    return {"arm": arm, "seed": seed, "estimates": {"x0 error": levels}, "samples": {"frechet": 10 * error}}


def test_pairs_of_seeds_are_compared_in_the_order_of_seeds():
    rows = [row("a", 1, 2.0), row("a", 0, 1.0), row("b", 0, 4.0), row("b", 1, 4.0)]
    mine, luck = learning.against(rows, "a", "b", "frechet")
    assert mine.tolist() == [0.25, 0.5] and luck.tolist() == [1.0, 1.0]
    assert learning.by_seed(rows, "a", "x0 error").tolist() == [1.25, 2.25]


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


def test_the_fault_that_is_seen_least_is_the_one_that_counts():
    def measured(coverage, recall, over):
        return {
            "coverage": torch.tensor([coverage]),
            "recall": torch.tensor([recall]),
            ruler.OVER: torch.tensor([over]),
        }

    found = {ruler.PLAIN: measured(0.8, 0.5, 1.0), ruler.MIRRORED: measured(0.8, 0.5, 1.1)}
    found |= {"x": measured(0.2, 0.6, 3.0), "y": measured(0.7, 0.1, 2.0)}
    by = ruler.tests(found)
    assert by["coverage"][2] == "y" and float(by["coverage"][0]) == pytest.approx(-0.1)
    assert by["recall"][2] == "x" and by["Frechet"][2] == "y"
    assert float(by["Frechet"][0]) == 2.0 and float(by["Frechet"][1]) == pytest.approx(1.1)


def test_squeezing_into_all_parts_loses_nothing_and_keeps_unit_variance():
    model = motion_model("diffusion_plain")
    x = model.encode(moving(12, 5)).flatten(1)
    space = latent.Squeezed.of(model, x, 11, seeded(3))
    assert space.lost_cm(x).max() < 0.1
    assert space.encode(x).std(0, correction=0) == pytest.approx(torch.ones(11), abs=1e-3)
    assert space.of_size(2).lost_cm(x).mean() > space.of_size(6).lost_cm(x).mean() > 0


def test_the_perceptron_learns_a_distribution_that_is_no_gaussian():
    schedule = cosine(50)
    z = torch.sign(torch.randn(512, 1, generator=seeded(4))) + 0.05 * torch.randn(512, 1, generator=seeded(5))
    denoise = latent.learnt(z, schedule, 400, seeded(6))
    noised = schedule.noised(z, 10, torch.randn(z.shape, generator=seeded(8)))
    left = (denoise(noised, schedule.stamps[10].expand(len(z))) - z).square().mean()
    assert left < 0.6 * (1 - schedule.alpha_bar[10])  # which the best linear denoiser leaves


def test_a_curve_leaves_out_what_was_not_trained():
    panel = figures.Panel({"network": {1: torch.tensor([1.0, 2.0]), 2: torch.tensor([])}}, "x", "y")
    ax = figures.curves({"a": panel}, seeded(9)).axes[0]
    assert ax.lines[0].get_xdata().tolist() == [1]
