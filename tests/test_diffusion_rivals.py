"""The rivals: the conditional mean of a Gaussian in closed form, planted neighbours, filters that are tuned."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion import cases, rivals
from motionlab.diffusion.denoising import Noise
from motionlab.diffusion.rivals import Rivals
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.frames import stuck_root
from motionlab.skeleton import STANDARD

FRAMES = 16


@pytest.fixture(scope="module")
def takes():
    """Training windows and others of the same person, 16 frames each."""
    cut = [
        gather([on_standard(perform_sequence(Corpus(seconds=12.0, seed=seed), 0).motion)], FRAMES).evenly(count)
        for seed, count in ((3, 80), (4, 6))
    ]
    return [replace(m, skeleton=STANDARD) for m in cut]


@pytest.fixture(scope="module")
def fitted(takes):
    return Rivals.fit(takes[0], torch.Generator().manual_seed(0), parts=24)


WAYS = ("mean", "nearest", "regression")


def test_the_factor_is_the_covariance_of_what_it_was_fitted_to(fitted):
    rows = fitted.rows - fitted.mean_row
    exact = torch.linalg.svdvals(rows).square()[:24] / len(rows)
    found = torch.linalg.svdvals(fitted.factor).square()
    assert torch.allclose(found, exact, rtol=0.02)
    few = Rivals.fit(replace_windows(fitted), torch.Generator().manual_seed(0), parts=500)
    assert few.factor.shape[1] <= 500


def replace_windows(fitted):
    """The windows that rivals were fitted to, from their rows."""
    return fitted.layout.decode(fitted.normaliser.undo(fitted.rows.unflatten(1, (FRAMES, -1))), 30.0)


@pytest.mark.parametrize("ridge", [0.01, 1.0])
def test_regression_is_the_conditional_mean_of_the_gaussian(fitted, ridge):
    generator = torch.Generator().manual_seed(1)
    mask = torch.rand(fitted.factor.shape[0], generator=generator) < 0.4
    x = torch.randn(2, len(mask), generator=generator)
    z = fitted._explained(x - fitted.mean_row, mask / ridge)
    factor = fitted.factor.double()
    covariance = factor @ factor.mT
    inside = covariance[mask][:, mask] + ridge * torch.eye(int(mask.sum()))
    gain = torch.linalg.solve(inside, covariance[mask][:, ~mask]).mT
    expected = (x - fitted.mean_row).double()[:, mask] @ gain.mT
    assert torch.allclose((z @ fitted.factor.mT)[:, ~mask], expected.float(), atol=2e-4)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("case", ["legs", "every_frame", "whole_window", "gap"])
def test_what_is_known_stays_and_what_is_hidden_is_never_read(takes, fitted, way, case, generator):
    truth, count = takes[1], len(takes[1].root)
    known = {
        "legs": lambda: cases.legs(count, FRAMES),
        "every_frame": lambda: cases.every_frame(count, FRAMES, 0.5, generator),
        "whole_window": lambda: cases.whole_window(count, FRAMES, 0.5, generator),
        "gap": lambda: cases.gap(count, FRAMES, 6),
    }[case]()
    made = getattr(fitted, way)(truth, known)
    joints, place = known[..., : cases.JOINTS], known[..., cases.JOINTS]
    assert torch.equal(made.rot[joints], truth.rot[joints]) and torch.equal(made.root[place], truth.root[place])
    joints, place = joints.clone(), place.clone()
    joints[:, 0, 0] = place[:, 0] = True  # the first frame's place and heading are given
    other = takes[0].clip(slice(0, count))
    spoilt = replace(
        truth,
        rot=torch.where(joints[..., None, None], truth.rot, other.rot),
        root=torch.where(place[..., None], truth.root, other.root),
    )
    again = getattr(fitted, way)(spoilt, known)
    assert torch.allclose(again.positions, made.positions, atol=1e-5)
    assert (made.positions - truth.positions).norm(dim=-1).max() > 0.01  # it did have to guess


def test_nearest_finds_a_window_of_its_own_by_half_of_it(takes, fitted):
    mine = takes[0].clip(slice(5, 9))
    for known in (cases.legs(4, FRAMES), cases.gap(4, FRAMES, 10)):
        assert (fitted.nearest(mine, known).positions - mine.positions).abs().max() < 1e-3
        assert (fitted.mean(mine, known).positions - mine.positions).abs().max() > 0.05


def test_the_mean_is_the_mean_of_the_legs(takes, fitted):
    made = fitted.mean(takes[1], cases.legs(6, FRAMES))
    knees = STANDARD.indices(("left_knee", "right_knee"))
    local = stuck_root(made)[0].rot[:, :, knees]
    assert (local - local[:1]).abs().max() < 1e-4  # the same whoever walks
    assert (made.rot[:, :, 9] - made.rot[:1, :, 9]).abs().max() > 0.01  # but not what is known


def test_regression_beats_the_mean_and_is_tuned_to_the_least_error(takes, fitted):
    known = cases.legs(6, FRAMES)

    def error(rival, how="regression"):
        return cases.error_cm(getattr(rival, how)(takes[1], known), takes[1], known).mean()

    best = fitted.tuned(takes[1], known)
    every = [error(replace(fitted, ridge=w)) for w in rivals.RIDGES]
    assert best.ridge in rivals.RIDGES and error(best) == min(every) < max(every)
    assert error(best) < 1.02 * error(fitted, "mean")  # so much ridge that nothing is left but the mean is among them
    again, known = takes[0].clip(slice(20, 40)), cases.legs(20, FRAMES)  # what it has seen
    found = [getattr(replace(fitted, ridge=0.1), how)(again, known) for how in ("regression", "mean")]
    assert cases.error_cm(found[0], again, known).mean() < 0.5 * cases.error_cm(found[1], again, known).mean()


def test_a_window_may_not_be_told_of_another_ones_mask(takes, fitted):
    with pytest.raises(ShapeError, match="windows"):
        fitted.mean(takes[1], cases.legs(5, FRAMES))


def test_the_linear_estimate_takes_noise_away_by_how_much_there_is(takes, fitted):
    truth, noise = takes[0].clip(slice(0, 20)), Noise.of(8, 3)
    noisy = noise.on(truth, torch.Generator().manual_seed(2))
    sure = replace(fitted, ridge=1e-4)

    def error(made):
        return (made.positions - truth.positions).norm(dim=-1).mean()

    assert error(sure.wiener(noisy, truth, noise.turn, noise.shift)) < 0.7 * error(noisy)
    trusting = sure.wiener(noisy, truth, 1e-3, 1e-3)  # believes what is measured: a projection onto the factor
    assert error(sure.wiener(noisy, truth, noise.turn, noise.shift)) < error(trusting)


@pytest.mark.parametrize("name", rivals.FILTERS)
def test_a_tuned_filter_takes_noise_away_and_a_bad_setting_does_worse(takes, name):
    truth = takes[1]
    truth = replace(truth, root=truth.root.repeat(1, 2, 1), rot=truth.rot.repeat(1, 2, 1, 1, 1), contacts=None)
    truth = rivals.filtered(truth, "Savitzky-Golay", window=9, degree=2)  # 32 frames for the longest window
    noisy = Noise.of(8, 3).on(truth, torch.Generator().manual_seed(3))

    def error(settings):
        return (rivals.filtered(noisy, name, **settings).positions - truth.positions).norm(dim=-1).mean()

    settings = rivals.tune(name, noisy, truth)
    _, grid = rivals.FILTERS[name]
    first = {key: values[0] for key, values in grid.items()}
    last = {key: values[-1] for key, values in grid.items()}
    assert error(settings) < 0.8 * (noisy.positions - truth.positions).norm(dim=-1).mean()
    assert error(settings) <= min(error(first), error(last)) < max(error(first), error(last))


def test_interpolation_and_hold_read_the_same_masks(takes, generator):
    truth = takes[1]
    known = cases.gap(6, FRAMES, 6)
    errors = [cases.error_cm(fill(truth, known), truth, known).mean() for fill in (rivals.interpolated, rivals.held)]
    assert 0 < errors[0] < errors[1]
    every = cases.every_frame(6, FRAMES, 0.5, generator)
    made = rivals.interpolated(truth, every)
    joints = every[..., : cases.JOINTS]
    assert torch.allclose(made.rot[joints], truth.rot[joints], atol=1e-6)
