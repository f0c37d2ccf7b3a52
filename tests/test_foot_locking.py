"""Feet that stand stay: in synthetic walks that were made to slide, and nothing else moves."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.animate.foot_locking import _FADE, _stands, lock_feet
from motionlab.contact import with_contacts
from motionlab.errors import DataError, ShapeError
from motionlab.skeleton import ANKLES, BALLS, STANDARD
from tests.figures import standing


@pytest.fixture(scope="module")
def walk():
    clips = scenes.held_out(6)
    clips = [with_contacts(clips.clip(i).cut(0, 60)) for i in range(6)]
    return replace(scenes.together(clips), skeleton=clips[0].skeleton)


@pytest.fixture(scope="module")
def sliding(walk):
    """The same people, drifting 15 cm/s to the side, who think that their feet stand."""
    drift = 0.15 * torch.arange(60) / walk.fps
    return replace(walk, root=walk.root + drift[:, None] * torch.tensor([0.0, 1.0, 0.0]))


def steps(motion):
    """Metres that the balls move from frame to frame while both frames stand."""
    skeleton = motion.skeleton
    stands = motion.contacts[..., [skeleton.contact_names.index(n) for n in BALLS]] > 0.5
    moved = motion.positions[..., skeleton.indices(BALLS), :].diff(dim=1).norm(dim=-1)
    return moved[stands[:, 1:] & stands[:, :-1]]


def test_feet_that_stand_stay_where_they_are(sliding):
    made = lock_feet(sliding)
    assert steps(sliding).mean() > 4e-3 and len(steps(sliding)) > 100
    assert steps(made).mean() < 0.05 * steps(sliding).mean()


def test_only_hips_knees_and_ankles_turn_and_a_foot_on_its_ball_keeps_its_orientation(walk, sliding):
    sliding = replace(walk, root=walk.root + 0.1 * (sliding.root - walk.root))  # legs stay long enough
    made, skeleton = lock_feet(sliding), sliding.skeleton
    turned = (made.rot - sliding.rot).abs().amax((0, 1, 3, 4)) > 1e-5
    legs = skeleton.indices([f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle")])
    assert turned.nonzero()[:, 0].tolist() == sorted(legs)
    assert torch.equal(made.root, sliding.root)
    here, there = (m.world[1][..., skeleton.indices(ANKLES), :, :] for m in (made, sliding))
    angles = rotation.geodesic(here, there).rad2deg()
    heels = sliding.positions[..., skeleton.indices(ANKLES), :]
    low = _stands(sliding, ANKLES).float().mT
    away = torch.nn.functional.max_pool1d(low, 2 * _FADE + 3, 1, _FADE + 1).mT == 0  # heels in the air, and no fading
    hips = sliding.positions[..., skeleton.indices(("left_hip", "right_hip")), :]
    bent = (heels - hips).norm(dim=-1) < 0.97 * (heels - hips).norm(dim=-1).max()
    assert (away & bent).sum() > 20 and angles[away & bent].max() < 0.1
    assert angles.mean() < 6 and angles.max() < 45


def test_feet_that_no_label_names_stand_if_they_are_low_and_slow_and_only_then(walk):
    unlabelled = replace(walk, contacts=torch.zeros_like(walk.contacts))
    second = torch.arange(60)[:, None] / 30 * torch.tensor([0.0, 1.0, 0.0])
    creeping, running = (replace(unlabelled, root=walk.root + speed * second) for speed in (0.1, 2.0))
    stands = _stands(walk, BALLS)
    both = stands[:, 1:] & stands[:, :-1]

    def slide(motion):
        return motion.positions[..., STANDARD.indices(BALLS), :].diff(dim=1).norm(dim=-1)

    assert slide(creeping)[both].mean() > 3e-3 and slide(lock_feet(creeping))[both].mean() < 5e-4
    assert (lock_feet(creeping, slow=False).positions - creeping.positions).abs().max() < 1e-3  # nothing says so
    assert (lock_feet(running).positions - running.positions).norm(dim=-1).mean() < 2e-3  # low, but at 2 m/s


def test_true_motion_is_hardly_moved(walk):
    """The control: what a finish takes from motion that needs none."""
    moved = (lock_feet(walk).positions - walk.positions).norm(dim=-1)[..., STANDARD.indices(BALLS)]
    assert moved.mean() < 0.01


def test_a_heel_on_the_floor_stays_though_its_foot_trembles(walk):
    trembling = walk.rot.clone()
    ankles, generator = STANDARD.indices(ANKLES), torch.Generator().manual_seed(0)
    trembling[..., ankles, :, :] @= rotation.exp(0.05 * torch.randn(*walk.root.shape[:2], 2, 3, generator=generator))
    shaken = replace(walk, rot=trembling, root=walk.root + 0.003 * torch.randn(walk.root.shape, generator=generator))
    heels = [STANDARD.contact_names.index(n) for n in ANKLES]
    down = walk.contacts[..., heels] > 0.5
    both = down[:, 1:] & down[:, :-1]

    def slide(motion):
        return motion.positions[..., ankles, :].diff(dim=1).norm(dim=-1)[both].mean()

    assert slide(shaken) > 4e-3 and slide(lock_feet(shaken)) < 0.2 * slide(shaken)


def test_out_of_reach_the_heel_lifts_and_the_ball_stays():
    """Who stands with straight legs and rises by 3 cm without leaving the floor is on the balls of the feet."""
    rises = STANDARD.standing_height() + 0.03 * torch.linspace(0, 1, 60)
    up = standing(60)
    up.root[:, 2] = rises
    said = torch.zeros(1, 60, len(STANDARD.contact_names))
    said[..., [STANDARD.contact_names.index(n) for n in BALLS]] = 1.0
    made = lock_feet(replace(up, root=up.root[None], rot=up.rot[None], contacts=said))
    heels, balls = (made.positions[..., STANDARD.indices(names), 2] for names in (ANKLES, BALLS))
    assert (balls.amax(1) - balls.amin(1)).max() < 1e-4
    assert (heels[:, -1] - heels[:, 0]).min() > 0.01  # the ball rests half-way up
    hips, ankles = (made.positions[..., STANDARD.indices(n), :] for n in (("left_hip", "right_hip"), ANKLES))
    assert ((ankles - hips).norm(dim=-1).diff(dim=1) < 1e-3).all()  # no leg grows


def test_who_never_stands_is_left_alone_and_who_says_nothing_is_refused(sliding):
    up = torch.tensor([0.0, 0.0, 1.0])
    flying = replace(sliding, root=sliding.root + up, contacts=torch.zeros_like(sliding.contacts))
    assert (lock_feet(flying).positions - flying.positions).abs().max() < 1e-3
    with pytest.raises(DataError, match="with_contacts"):
        lock_feet(replace(sliding, contacts=None))
    bodies = replace(sliding.skeleton, offsets=torch.zeros(6, 1, 22, 3))
    for wrong in (sliding.clip(0), replace(sliding, skeleton=bodies)):
        with pytest.raises(ShapeError, match="on one body"):
            lock_feet(wrong)
