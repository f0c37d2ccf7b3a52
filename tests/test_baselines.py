import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import twins

from motionlab import baselines, rotation
from motionlab.errors import DataError, ShapeError
from motionlab.metrics import jitter, mean_acceleration
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from studies.nb12_filling_in.noise import one_euro

F64 = torch.float64


def swinging(generator: torch.Generator, batch: tuple[int, ...] = (), frames: int = 60) -> Motion:
    """A motion with constant velocity of the root and constant turning rate of every joint."""
    time = torch.arange(frames, dtype=F64)[:, None, None] / 30
    rate = torch.randn(*batch, 1, 22, 3, generator=generator, dtype=F64) * 0.5
    start = rotation.exp(torch.randn(*batch, 1, 22, 3, generator=generator, dtype=F64) * 0.3)
    rot = start @ rotation.exp(rate * time)
    speed = torch.randn(*batch, 1, 3, generator=generator, dtype=F64)
    return Motion(STANDARD.to(F64), speed * time[..., 0], UPRIGHT.to(F64) @ rot, 30.0)


def scrambled(motion: Motion, known: torch.Tensor, generator: torch.Generator) -> Motion:
    """What is unknown replaced by noise: a baseline may not look at it."""
    known = baselines._mask(known, motion)
    noise = rotation.random(motion.rot.shape[:-2], generator, dtype=F64)
    root = torch.where(known[..., :1], motion.root, torch.full_like(motion.root, 99.0))
    return replace(motion, root=root, rot=torch.where(known[..., None, None], motion.rot, noise))


@pytest.mark.parametrize("per_joint", [False, True])
def test_interpolation_is_exact_at_constant_speed_and_keeps_the_known(generator, per_joint):
    motion = swinging(generator, (2,))
    known = torch.rand(*((2, 60, 22) if per_joint else (60,)), generator=generator) < 0.3
    ends = (..., [0, -1], slice(None)) if per_joint else [0, -1]
    known[ends] = True
    filled = baselines.interpolate(scrambled(motion, known, generator), known)
    torch.testing.assert_close(filled.root, motion.root)
    torch.testing.assert_close(filled.rot, motion.rot)
    mask = baselines._mask(known, motion)
    assert torch.equal(filled.rot[mask], motion.rot[mask])


def test_ends_hold(generator):
    motion = swinging(generator, frames=6)
    known = torch.tensor([False, True, False, False, True, False])
    ends = baselines.interpolate(scrambled(motion, known, generator), known)
    torch.testing.assert_close(ends.rot[[0, -1]], motion.rot[[1, 4]])


def test_nothing_known_and_wrong_masks_are_refused(generator):
    motion = swinging(generator, frames=6)
    with pytest.raises(ShapeError, match="no frame"):
        baselines.interpolate(motion, torch.zeros(6))
    for wrong in (torch.ones(5), torch.ones(6, 21), torch.ones(2, 6, 22), torch.ones(())):
        with pytest.raises(ShapeError, match="expected"):
            baselines.interpolate(motion, wrong)


def test_a_mask_says_by_its_axes_whether_it_hides_frames_or_joints(generator):
    """22 frames, 22 joints, 22 clips: (22, 22) hides frames of clips, or joints of the frames of one."""
    motion = swinging(generator, (22,), frames=22)
    known = torch.ones(22, 22, dtype=torch.bool)
    known[3, 5] = False
    lost = replace(motion, root=motion.root.clone(), rot=motion.rot.clone())
    lost.root[3, 5], lost.rot[0, 3, 5] = 9.0, torch.eye(3)
    filled = baselines.interpolate(lost, known)
    assert filled.root[3, 5].max() < 9 and torch.equal(filled.root[4], lost.root[4])
    single, filled = lost.clip(0), baselines.interpolate(lost.clip(0), known)
    assert not torch.equal(filled.rot[3, 5], single.rot[3, 5]) and torch.equal(filled.rot[3, 4], single.rot[3, 4])


def test_noise_has_the_size_it_says_and_lasts_as_long(generator):
    motion, lasts = swinging(generator, (240,), 20).to(torch.float32), lambda x: (x[:, 1:] * x[:, :-1]).mean()
    noisy = baselines.Noise.of(5, 2, lasting=0.9).on(motion, generator)
    angle = rotation.geodesic(noisy.rot, motion.rot)
    assert angle.square().mean().sqrt().rad2deg() == pytest.approx(5 * 3**0.5, rel=0.02)
    shift = noisy.root - motion.root
    assert shift.std() == pytest.approx(0.02, rel=0.05)
    assert lasts(shift) / shift.square().mean() == pytest.approx(0.9, abs=0.02)
    fresh = baselines.Noise.of(5, 2).on(motion, generator).root - motion.root
    assert lasts(fresh) / fresh.square().mean() == pytest.approx(0, abs=0.05)


def test_savitzky_golay_keeps_its_polynomials(generator):
    t = torch.linspace(-1, 1, 40, dtype=F64)[:, None]
    cubic = torch.cat((t**3 - t, 2 * t**2), -1)
    torch.testing.assert_close(baselines.savitzky_golay(cubic, 9, 3), cubic)
    assert (baselines.savitzky_golay(cubic, 9, 1) - cubic).abs().max() > 1e-2
    for window in (8, 3, 41):
        with pytest.raises(ShapeError, match="odd"):
            baselines.savitzky_golay(cubic, window, 3)


def test_one_euro_agrees_with_its_twin(generator):
    x = torch.randn(50, 3, generator=generator, dtype=F64).cumsum(0)
    found = one_euro(x, 30.0, 1.2, 0.3)
    for d in range(3):
        np.testing.assert_allclose(found[:, d], twins.one_euro(x[:, d].tolist(), 30.0, 1.2, 0.3, 1.0))


def dense_smoother(z, dt, noise, acceleration):
    """The same posterior mean by one dense least-squares solve over all states [p, v]."""
    frames = len(z)
    q = acceleration**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    whiten = np.linalg.inv(np.linalg.cholesky(q))
    rows, right = [], []
    for t in range(frames - 1):
        row = np.zeros((2, 2 * frames))
        row[:, 2 * t : 2 * t + 2], row[:, 2 * t + 2 : 2 * t + 4] = -whiten @ [[1, dt], [0, 1]], whiten
        rows, right = [*rows, *row], [*right, 0, 0]
    for t in range(frames):
        row = np.zeros(2 * frames)
        row[2 * t] = 1 / noise
        rows, right = [*rows, row], [*right, z[t] / noise]
    return np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0][::2]


def test_kalman_smoother_agrees_with_dense_least_squares(generator):
    x = torch.randn(25, 2, generator=generator, dtype=F64).cumsum(0)
    found = baselines.kalman(x, 30.0, 0.5, 20.0)
    for d in range(2):
        np.testing.assert_allclose(found[:, d], dense_smoother(x[:, d].numpy(), 1 / 30, 0.5, 20.0), atol=1e-7)


@pytest.mark.parametrize("name", ["fps", "noise", "acceleration"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_kalman_refuses_what_leaves_nothing_to_weigh(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected a finite number above zero"):
        baselines.kalman(torch.zeros(5, 2), **{"fps": 30.0, "noise": 0.1, "acceleration": 1.0, name: value})


def test_kalman_refuses_nan():
    x = torch.arange(10.0).reshape(5, 2)
    x[2, 1] = torch.nan
    with pytest.raises(DataError, match="NaN"):
        baselines.kalman(x, 30.0, 0.1, 1.0)


SMOOTHERS = {
    "savitzky-golay": partial(baselines.savitzky_golay, window=9, degree=2),
    "one-euro": partial(one_euro, fps=30.0, min_cutoff=2.0, beta=0.1),
    "kalman": partial(baselines.kalman, fps=30.0, noise=0.02, acceleration=1.0),
}


@pytest.mark.parametrize("name", SMOOTHERS)
def test_smoothers_remove_jitter_and_keep_rotations(generator, name):
    motion = swinging(generator, (2,), frames=40)
    noise = rotation.exp(0.03 * torch.randn(2, 40, 22, 3, generator=generator, dtype=F64))
    shake = 0.02 * torch.randn(2, 40, 3, generator=generator, dtype=F64)
    noisy = replace(motion, root=motion.root + shake, rot=motion.rot @ noise)
    smoothed = baselines.smooth(noisy, SMOOTHERS[name])
    assert (jitter(smoothed.positions, 30.0) < 0.3 * jitter(noisy.positions, 30.0)).all()
    assert (mean_acceleration(smoothed.positions, 30.0) < 0.5 * mean_acceleration(noisy.positions, 30.0)).all()
    eye = torch.eye(3, dtype=F64).expand_as(smoothed.rot)
    torch.testing.assert_close(smoothed.rot @ smoothed.rot.mT, eye)
    if name != "one-euro":  # causal: it lags
        before, after = (rotation.geodesic(m.rot, motion.rot).mean() for m in (noisy, smoothed))
        assert after < 0.7 * before


def test_smoothing_follows_a_spin_round(generator):
    """Two full turns: averaging plain rotation vectors would cut across the jump at pi."""
    turn = torch.linspace(0, 4 * math.pi, 80, dtype=F64)
    spin = rotation.rotation_about("z", turn)[:, None]
    smoother = SMOOTHERS["savitzky-golay"]
    motion = replace(swinging(generator, frames=80), rot=spin.repeat(1, 22, 1, 1))
    assert rotation.geodesic(baselines.smooth(motion, smoother).rot, spin).max() < 1e-6
    naive = rotation.exp(smoother(rotation.log(spin).flatten(-2)).unflatten(-1, (-1, 3)))
    assert rotation.geodesic(naive, spin).max() > 1
