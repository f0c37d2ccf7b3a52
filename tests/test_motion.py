from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from motionlab import rotation
from motionlab.errors import ShapeError
from motionlab.motion import Motion, mirror, resample, velocity, windows
from motionlab.skeleton import STANDARD, Skeleton

F64 = torch.float64


def random_motion(generator: torch.Generator, batch: tuple[int, ...] = (), frames: int = 10) -> Motion:
    rot = rotation.random((*batch, frames, 22), generator, dtype=F64)
    root = torch.randn(*batch, frames, 3, generator=generator, dtype=F64)
    contacts = (torch.rand(*batch, frames, 9, generator=generator) < 0.5).double()
    return Motion(STANDARD.to(F64), root, rot, 30.0, contacts, "test")


def test_velocity_of_a_parabola_is_exact_inside(generator):
    t = torch.arange(12, dtype=F64)[:, None] / 50
    torch.testing.assert_close(velocity(3 * t**2, 50.0, dim=0)[1:-1], 6 * t[1:-1])
    assert (velocity(torch.ones(1, 3), 30.0, dim=0) == 0).all()


def test_wrong_parts_are_refused(generator):
    motion = random_motion(generator)
    for change in ({"root": motion.root[1:]}, {"contacts": motion.contacts[:, 1:]}, {"fps": 0.0},
                   {"fps": float("nan")}, {"fps": float("inf")}, {"rot": motion.rot[:, 1:]}):  # fmt: skip
        with pytest.raises(ShapeError):
            replace(motion, **change)


def test_cut_takes_frames_and_a_step_divides_the_rate(generator):
    motion = random_motion(generator, (2,))
    part = motion.cut(2, 9, 3)
    assert part.frames == 3 and part.fps == 10 and part.seconds == pytest.approx(0.3)
    assert torch.equal(part.positions, motion.positions[:, 2:9:3])
    assert torch.equal(part.contacts, motion.contacts[:, 2:9:3])


def test_clip_takes_its_own_skeleton_along(generator):
    scale = torch.tensor([1.0, 1.3], dtype=F64)[:, None, None, None]
    bodies = Skeleton(STANDARD.names, STANDARD.parents, STANDARD.offsets * scale, STANDARD.contact_names)
    motion = replace(random_motion(generator, (2,)), skeleton=bodies)
    for i in range(2):
        assert motion.clip(i).positions.shape == (10, 22, 3)
        torch.testing.assert_close(motion.clip(i).positions, motion.positions[i])
    torch.testing.assert_close(motion.clip(slice(1, 2)).positions, motion.positions[1:])
    part = windows(motion, 4, 3)
    torch.testing.assert_close(part.clip(1).positions, motion.positions[:, 3:7])
    for offsets in (bodies.offsets, bodies.offsets[1:]):  # one body each, or one for both
        alone = replace(motion, skeleton=replace(bodies, offsets=offsets)).clip(1)
        assert alone.skeleton.offsets.shape == (22, 3)
        torch.testing.assert_close(alone.positions, motion.positions[1])
    single = motion.clip(slice(1, 2)).clip(0)
    assert single.positions.shape == (10, 22, 3)
    torch.testing.assert_close(single.positions, motion.positions[1])


def test_resample_agrees_with_scipy_slerp_and_keeps_its_samples(generator):
    motion = random_motion(generator, frames=8)
    fine = resample(motion, 45.0)
    assert fine.fps == 45 and fine.frames == 11
    torch.testing.assert_close(fine.root[::3], motion.root[::2])
    torch.testing.assert_close(fine.rot[::3], motion.rot[::2])
    times = np.arange(11) / 45
    for joint in (0, 7):
        track = Slerp(np.arange(8) / 30, Rotation.from_matrix(motion.rot[:, joint].numpy()))
        torch.testing.assert_close(fine.rot[:, joint], torch.as_tensor(track(times).as_matrix()))
    for axis in range(3):
        expected = np.interp(times, np.arange(8) / 30, motion.root[:, axis])
        np.testing.assert_allclose(fine.root[:, axis], expected, atol=1e-12)
    assert set(fine.contacts.unique().tolist()) <= {0.0, 1.0}
    assert resample(motion, 30.0) is motion


def swinging(fps, frames):
    """A root on a cubic path, and every joint swinging at 2 Hz about an axis of its own, at any rate."""
    t = torch.arange(frames, dtype=F64)[:, None] / fps
    path = torch.tensor([[0.1, 0.5, -0.3], [1.0, -0.2, 0.4], [0.3, 0.1, 0.9]], dtype=F64)
    axes = torch.nn.functional.normalize(torch.randn(22, 3, generator=torch.Generator().manual_seed(4), dtype=F64))
    rot = rotation.exp((2.9 + 0.6 * (4 * torch.pi * t).sin())[..., None] * axes)  # 2.9 rad: signs of quaternions matter
    return Motion(STANDARD.to(F64), t * path[0] + t**2 * path[1] + t**3 * path[2], rot, fps)


def test_a_spline_keeps_its_samples_and_is_nearer_between_them():
    slow, truth = swinging(24.0, 49), swinging(30.0, 61)
    fine = resample(slow, 30.0, "spline")
    assert fine.fps == 30 and fine.frames == truth.frames
    torch.testing.assert_close(fine.root, truth.root)  # cubics exactly
    torch.testing.assert_close(fine.rot[::5], slow.rot[::4])
    torch.testing.assert_close(fine.rot.mT @ fine.rot, torch.eye(3, dtype=F64).expand_as(fine.rot))
    errors = [rotation.geodesic(each.rot, truth.rot)[3:-3].mean() for each in (fine, resample(slow, 30.0))]
    assert errors[0] < 0.1 * errors[1]
    pair = replace(slow, root=torch.stack((slow.root, -slow.root)), rot=torch.stack((slow.rot, slow.rot.mT)))
    both = resample(pair, 30.0, "spline")
    torch.testing.assert_close(both.rot[0], fine.rot)
    torch.testing.assert_close(both.root[1], -fine.root)
    assert torch.equal(resample(slow.cut(0, 3), 30.0, "spline").rot, resample(slow.cut(0, 3), 30.0).rot)
    with pytest.raises(ValueError, match="'linear' or 'spline', got 'cubic'"):
        resample(slow, 30.0, "cubic")


@pytest.mark.parametrize("fps", [7.0, 29.97, 30.0, 60.0, 119.88])
@pytest.mark.parametrize("frames", [1, 2, 31])
def test_resample_ends_inside_the_recording(generator, fps, frames):
    found = resample(random_motion(generator, frames=frames), fps)
    assert 0 <= (frames - 1) / 30 - (found.frames - 1) / fps < 1 / fps + 1e-6


def test_frames_that_last_differently_are_brought_to_even_times(generator):
    """Between frames it goes straight: frames are left out where it is, and come back."""
    motion = random_motion(generator, frames=3)
    whole = resample(motion, 120.0)  # four steps for one
    some = [0, 1, 3, 4, 7, 8]
    pick = replace(whole.cut(0, 6), root=whole.root[some], rot=whole.rot[some], contacts=whole.contacts[some])
    back = resample(pick, 120.0, times=[n / 120 for n in some])
    torch.testing.assert_close(back.root, whole.root)
    torch.testing.assert_close(back.rot, whole.rot)
    assert back.fps == 120 and torch.equal(back.contacts[some], whole.contacts[some])
    assert not torch.allclose(resample(pick, 60.0).root, whole.root[:6:2])  # negative control


@pytest.mark.parametrize("fps", [0.0, -30.0, float("nan"), float("inf")])
def test_resample_to_a_senseless_rate_is_refused(generator, fps):
    with pytest.raises(ShapeError, match="fps"):
        resample(random_motion(generator), fps)


def test_windows_are_slices(generator):
    motion = random_motion(generator, (2,))
    found = windows(motion, 4, 3)
    assert found.root.shape == (3, 2, 4, 3) and found.rot.shape == (3, 2, 4, 22, 3, 3)
    for n in range(3):
        part = motion.cut(3 * n, 3 * n + 4)
        assert torch.equal(found.root[n], part.root) and torch.equal(found.rot[n], part.rot)
        assert torch.equal(found.contacts[n], part.contacts)
    with pytest.raises(ShapeError, match="test: 10 frames"):
        windows(motion, 11, 1)
    for length, stride in ((0, 1), (4, 0), (4, -1)):
        with pytest.raises(ShapeError, match="at least 1"):
            windows(motion, length, stride)


def test_mirror_mirrors_every_joint_and_twice_is_nothing(generator):
    motion = random_motion(generator, (2,))
    found = mirror(motion)
    flip = torch.tensor([-1.0, 1.0, 1.0])
    partner = STANDARD.mirror_indices
    torch.testing.assert_close(found.positions, motion.positions[..., partner, :] * flip)
    left, right = (STANDARD.contact_names.index(f"{side}_foot") for side in ("left", "right"))
    assert torch.equal(found.contacts[..., left], motion.contacts[..., right])
    again = mirror(found)
    assert torch.equal(again.root, motion.root) and torch.equal(again.rot, motion.rot)
    torch.testing.assert_close(torch.linalg.det(found.rot), torch.ones(2, 10, 22, dtype=F64))


def test_mirror_gives_a_lopsided_body_its_partners_bones(generator):
    offsets = STANDARD.offsets.double().clone()
    offsets[STANDARD.index("left_knee")] *= 1.5
    motion = replace(random_motion(generator), skeleton=replace(STANDARD, offsets=offsets))
    flip = torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(mirror(motion).positions, motion.positions[..., STANDARD.mirror_indices, :] * flip)


def test_a_body_whose_sides_are_spelled_otherwise_is_not_half_mirrored(generator):
    names = tuple(name.replace("left_", "L").replace("right_", "R") for name in STANDARD.names)
    motion = random_motion(generator)
    other = replace(motion, skeleton=Skeleton(names, STANDARD.parents, motion.skeleton.offsets), contacts=None)
    with pytest.raises(ShapeError, match="retarget first"):
        mirror(other)
