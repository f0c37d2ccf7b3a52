"""The study of notebook 11: chains along one noise, copies, splices, and measures by person."""

from types import SimpleNamespace

import pytest
import torch

from motionlab import rotation
from motionlab.diffusion import sampling
from motionlab.metrics import generation
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD
from studies.nb11_new_motion import copies, walks
from studies.shared import generated as measures
from tests.draws import seeded

SCHEDULE = sampling.cosine(1000)
POWER = torch.tensor([4.0, 0.25])


def model(frames=3):
    """A stand-in whose data is Gaussian with variances ``POWER``: the best x_0 estimate is a Wiener filter."""

    def denoise(x, stamps):
        left = SCHEDULE.alpha_bar[stamps].to(x)[:, None, None]
        return left.sqrt() * POWER / (left * POWER + 1 - left) * x

    def noise(count, generator):
        return torch.randn(count, frames, len(POWER), generator=generator)

    return SimpleNamespace(schedule=SCHEDULE, denoiser=denoise, noise=noise)


def test_the_longest_chain_is_the_library_s_sampler():
    made, _ = walks.ddpm(model(), (10, 1000), 4, seeded(1))
    generator = seeded(1)
    start = model().noise(4, generator)
    assert torch.allclose(made[1000], sampling.ddpm(model().denoiser, SCHEDULE, start, generator), atol=1e-4)


def moving(seed, frames, count=None):
    """A recording (or windows) that turns its joints and walks off smoothly at random."""
    shape = (frames,) if count is None else (count, frames)
    generator = seeded(seed)
    turns = torch.randn(*shape, len(STANDARD), 3, generator=generator).cumsum(-3) * 0.02
    steps = torch.randn(*shape, 3, generator=generator).cumsum(-2) * 0.02
    return Motion(STANDARD, steps + torch.tensor([0.0, 0.0, 0.95]), rotation.exp(turns), 30.0)


def turned(motion, angle, shift):
    turn = rotation.rotation_about("z", angle)
    rot = motion.rot.clone()
    rot[..., 0, :, :] = turn @ rot[..., 0, :, :]
    return Motion(STANDARD, motion.root @ turn.mT + shift, rot, motion.fps)


def test_a_copy_is_found_at_its_shift_turned_moved_and_mirrored():
    library = [moving(6, 90), moving(7, 40), moving(8, 100)]
    window = library[2].cut(23, 83)
    away = turned(window, torch.tensor(1.1), torch.tensor([3.0, -2.0, 0.0]))
    asked = {"moved": away, "mirrored": mirror(away), "new": moving(9, 60)}
    asked = {name: Motion(STANDARD, m.root[None], m.rot[None], m.fps) for name, m in asked.items()}
    found = copies.nearest(asked, library)
    assert found["moved"] < 1e-4 and found["mirrored"] < 1e-4 and found["new"] > 0.05


def judged(latent, travel=None):
    ones = torch.ones(len(latent))
    return measures.Judged(latent.double(), ones if travel is None else travel, ones, ones)


def test_shares_by_person_are_the_library_s_measures_taken_apart():
    x, y = torch.randn(60, 4, generator=seeded(12)), torch.randn(60, 4, generator=seeded(13)) + 0.4
    found = measures.shares(judged(x), judged(y), torch.arange(6).repeat_interleave(10))
    assert found["coverage"].mean() == pytest.approx(generation.density_coverage(x, y).coverage)
    assert found["recall"].mean() == pytest.approx(generation.precision_recall(x, y).recall)


def test_pseudo_values_of_a_mean_are_the_groups_own_means():
    travel = torch.rand(30, generator=seeded(14)).double()
    groups = torch.arange(5).repeat(6)
    values = measures.pseudo(lambda x: float(x.travel.mean()), [judged(torch.zeros(30, 1), travel)], groups)
    assert values == pytest.approx(torch.stack([travel[groups == k].mean() for k in range(5)]))


def test_the_classifier_is_a_coin_on_equal_sets_and_sure_on_others():
    x, y = (torch.randn(400, 3, generator=seeded(s)) for s in (15, 16))
    assert measures.told_apart(judged(x), judged(y), seeded(17)).mean() == pytest.approx(0.5, abs=0.06)
    assert measures.told_apart(judged(x), judged(y + 8), seeded(17)).mean() > 0.99
    assert measures.told_apart(judged(x), judged(x + 1e-3), seeded(17)).mean() == pytest.approx(
        0.5, abs=0.06
    )  # one noise
