from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter1d
from scipy.spatial import procrustes

from motionlab import metrics, rotation
from motionlab.errors import DataError, ShapeError

GOLDEN = np.load(Path(__file__).parent / "golden" / "humor_metrics.npz")
F64 = torch.float64


def walks(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, 3, generator=generator, dtype=F64)


def test_golden_acceleration_of_humor():
    joints = np.load(Path(__file__).parent / "golden" / "humor_energies.npz")["world_joints"][0].reshape(-1, 22, 3)
    found = metrics.acceleration(torch.as_tensor(joints).double(), 30.0)
    torch.testing.assert_close(
        found, torch.as_tensor(GOLDEN["metric_accel_mag"]).reshape(found.shape), rtol=1e-10, atol=1e-10
    )


def test_mpjpe_of_a_shift_a_turn_and_a_scale(generator):
    truth = walks(generator, 4, 6, 22)
    shifted = truth + torch.tensor([0.3, 0.0, 0.4])
    assert torch.allclose(metrics.mpjpe(shifted, truth, align="none"), torch.full((4,), 0.5, dtype=F64))
    assert metrics.mpjpe(shifted, truth, align="root").max() < 1e-12
    turned = shifted @ rotation.random((4, 6), generator, dtype=F64)
    assert metrics.mpjpe(turned, truth, align="root").min() > 0.1
    assert metrics.mpjpe(turned, truth, align="rigid").max() < 1e-12
    assert metrics.mpjpe(2 * turned, truth, align="rigid").min() > 0.1
    assert metrics.mpjpe(2 * turned, truth, align="similarity").max() < 1e-12
    mirrored = turned * torch.tensor([-1.0, 1.0, 1.0])
    assert metrics.mpjpe(mirrored, truth, align="similarity").min() > 0.1  # no alignment may reflect


@pytest.mark.parametrize("which", ["predicted", "truth"])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_what_is_not_finite_cannot_be_aligned(generator, which, bad):
    pair = {"predicted": walks(generator, 4, 22), "truth": walks(generator, 4, 22)}
    pair[which][2, 7, 1] = bad
    for align in ("rigid", "similarity"):
        with pytest.raises(DataError, match=rf"{which}\[2, 7, 1\]: cannot be aligned"):
            metrics.mpjpe(**pair, align=align)
    assert not metrics.joint_errors(**pair, align="none").isfinite().all()
    with pytest.raises(ShapeError, match="truth"):
        metrics.align_procrustes(pair["predicted"], pair["truth"][:, :21], scale=False)


def test_similarity_alignment_agrees_with_scipy_where_no_reflection_is_better(generator):
    truth = walks(generator, 10)
    predicted = truth + 0.1 * walks(generator, 10)
    centred = truth - truth.mean(0)
    _, _, disparity = procrustes(truth.numpy(), predicted.numpy())
    ours = (metrics.align_procrustes(predicted, truth, scale=True) - truth).square().sum() / centred.square().sum()
    np.testing.assert_allclose(ours, disparity)


def test_visible_and_occluded_are_split_and_nothing_seen_is_nan(generator):
    truth = walks(generator, 2, 5, 22)
    visible = torch.rand(2, 5, 22, generator=generator) < 0.5
    predicted = truth + torch.where(visible, 0.0, 2.0)[..., None] * torch.tensor([1.0, 0, 0])
    seen, unseen = (metrics.mpjpe(predicted, truth, align="none", mask=which) for which in (visible, ~visible))
    torch.testing.assert_close(seen, torch.zeros(2, dtype=F64))
    torch.testing.assert_close(unseen, torch.full((2,), 2.0, dtype=F64))
    assert metrics.mpjpe(predicted, truth, align="none", mask=torch.zeros(2, 5, 22)).isnan().all()


def test_unmasked_nan_does_not_leak_and_masked_mean_counts(generator):
    values = torch.tensor([[1.0, float("nan")], [3.0, 5.0]])
    mask = torch.tensor([[True, False], [True, True]])
    assert metrics.masked_mean(values, mask, 2) == 3
    assert metrics.masked_mean(values, None, 2).isnan()


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_acceleration_and_jitter_of_known_paths(fps):
    t = torch.arange(40, dtype=F64)[:, None, None] / fps
    parabola = torch.cat((t, 0 * t, -9.81 / 2 * t**2), -1)
    torch.testing.assert_close(metrics.mean_acceleration(parabola, fps), torch.tensor(9.81, dtype=F64))
    torch.testing.assert_close(metrics.acceleration_error(parabola, 0 * parabola, fps), torch.tensor(9.81, dtype=F64))
    assert metrics.jitter(parabola, fps) < 1e-6
    cubic = torch.cat((5 * t**3, 0 * t, 0 * t), -1)
    torch.testing.assert_close(metrics.jitter(cubic, fps), torch.tensor(30.0, dtype=F64), rtol=1e-6, atol=0)


def test_too_few_frames_are_nan_not_zero(generator):
    for frames, measure in ((2, metrics.mean_acceleration), (3, metrics.jitter)):
        assert measure(walks(generator, frames, 22), 30.0).isnan()
        assert measure(walks(generator, frames + 1, 22), 30.0).isfinite()
    one = walks(generator, 1, 2)
    assert metrics.skating_ratio(one, 30.0).isnan()
    assert metrics.slide_in_contact_mm(one, torch.ones(1, 2)).isnan()


def naive_skating(feet, fps):
    """The published code of GMD, transcribed for z up."""
    moving = np.linalg.norm(feet[1:, :, :2] - feet[:-1, :, :2], axis=-1) * fps
    average = uniform_filter1d(moving, axis=0, size=5, mode="constant", origin=0)
    low = (feet[:-1, :, 2] < 0.05) & (feet[1:, :, 2] < 0.05)
    return (low & (moving > 0.5) & (average > 0.5)).any(1).sum() / (len(feet) - 1)


def test_skating_ratio_agrees_with_gmd(generator):
    feet = torch.cumsum(0.02 * walks(generator, 8, 50, 2), dim=1)
    found = metrics.skating_ratio(feet, 20.0)
    np.testing.assert_allclose(found, [naive_skating(x, 20.0) for x in feet.numpy()])
    assert 0.05 < found.mean() < 0.95


def test_slides_are_in_millimetres_per_frame(generator):
    slide = torch.zeros(10, 2, 3, dtype=F64)
    slide[:, 0, 0] = torch.arange(10) * 0.002
    contacts = torch.tensor([1.0, 0.0]).expand(10, 2)
    torch.testing.assert_close(metrics.slide_in_contact_mm(slide, contacts), torch.tensor(2.0, dtype=F64))
    assert metrics.slide_in_contact_mm(slide, 0 * contacts).isnan()
    standing = torch.zeros_like(slide)
    torch.testing.assert_close(metrics.slide_where_truth_stands_mm(slide, standing), torch.tensor(1.0, dtype=F64))
    assert metrics.slide_where_truth_stands_mm(slide, 10 * slide).isfinite()  # foot 1 of the truth stands
    assert metrics.slide_where_truth_stands_mm(slide[:, :1], 10 * slide[:, :1]).isnan()


def test_the_f1_of_contacts_by_hand():
    truth = torch.tensor([[1, 1, 0, 0], [1, 0, 0, 0]])
    predicted = torch.tensor([[1, 0, 1, 0], [1, 0, 0, 0]])
    assert metrics.contact_f1(predicted, truth).item() == pytest.approx(2 / 3)
    assert metrics.contact_f1(0 * predicted, 0 * truth).isnan() and metrics.contact_f1(0 * predicted, truth) == 0


def test_wrong_names_and_shapes_other_than_the_truths_are_refused(generator):
    truth = walks(generator, 4, 6)
    with pytest.raises(ValueError, match="similarity"):
        metrics.mpjpe(truth, truth, align="procrustes")
    with pytest.raises(ShapeError, match="predicted"):
        metrics.mpjpe(torch.zeros(5), torch.zeros(5), align="none")
    for predicted in (truth[:1], truth[:3], truth[:, :1], truth[:, :5]):
        with pytest.raises(ShapeError, match="truth"):
            metrics.mpjpe(predicted, truth, align="none")
        with pytest.raises(ShapeError, match="truth"):
            metrics.acceleration_error(predicted, truth, 30.0)
