"""Pose completion: handles met, free joints free, and the completions that need no network."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.diffusion import completion, denoiser, handles, known_poses, pose_trials, training
from motionlab.diffusion.losses import Weights
from motionlab.diffusion.trained import Recipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError, ShapeError
from motionlab.frames import stuck_root
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD

POSES = Recipe(
    size="tiny", frames=1, contacts=False, linear=True, dropout=0.0, noising=100, steps=60, batch=32, lr=5e-3,
    warm_up=20, average=0.97, weights=Weights(fk=0.05, velocity=0.0, late=0.1), seed=5,
)  # fmt: skip
FIVE = handles.SETS["five effectors"]


@pytest.fixture(scope="module")
def windows():
    clips = scenes.held_out(8)
    return gather([on_standard(replace(clips.clip(i), contacts=None)) for i in range(8)], 1)


@pytest.fixture(scope="module")
def models(windows):
    """A model of poses, and one that hears of handles."""
    with pytest.MonkeyPatch.context() as m:
        m.setitem(denoiser.SIZES, "tiny", {"size": 32, "layers": 1, "heads": 2, "hidden": 32})
        heard = replace(POSES, handles=16, weights=replace(POSES.weights, handles=20.0))
        return [training.Training(recipe, windows).run().shipped for recipe in (POSES, heard)]


@pytest.fixture(scope="module")
def truth(windows):
    """Poses (24, 1), stuck, on the standard body."""
    return stuck_root(replace(windows.evenly(24), skeleton=STANDARD))[0]


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


# ------------------------------------------------------------------------------------------------- with a network
@pytest.mark.parametrize("name", handles.SETS)
@pytest.mark.parametrize("which_model", [0, 1])
def test_handles_are_met_to_the_millimetre(models, truth, name, which_model):
    joints = truth.positions[:, 0]
    which = handles.chosen(handles.SETS[name], len(joints), seeded())
    made = completion.complete(models[which_model], joints, which, seeded(), steps=20)
    assert made.root.shape == (24, 1, 3) and made.rot.isfinite().all()
    assert (made.rot @ made.rot.mT - torch.eye(3)).abs().max() < 1e-4
    assert completion.missed(made, joints, which).nan_to_num().max() < 1e-3
    rough = completion.complete(models[which_model], joints, which, seeded(), steps=20, finish=False)
    assert completion.missed(rough, joints, which).nanmean() > 2e-3  # it is the finish that does it


def test_completions_follow_the_generator_and_the_handles_alone(models, truth):
    joints = truth.positions[:, 0]
    which = handles.chosen(FIVE, len(joints), seeded())
    hidden = torch.where(which[..., None], joints, torch.nan)
    one, same, other = (
        completion.complete(models[1], targets, which, seeded(s), steps=10)
        for targets, s in ((joints, 0), (hidden, 0), (joints, 1))
    )
    assert torch.equal(one.rot, same.rot)
    assert not torch.allclose(one.rot, other.rot, atol=1e-2)


def test_a_model_that_is_told_comes_nearer(models, truth):
    """Than one that is not, and than itself told of the handles of other poses."""
    joints = truth.positions[:, 0]
    which = handles.chosen(FIVE, len(joints), seeded())

    def far(model, said):
        made = completion.complete(model, said, which, seeded(), steps=20, finish=False)
        return completion.missed(made, joints, which).nanmean()

    heard = far(models[1], joints)
    assert heard < 0.9 * far(models[0], joints) and heard < 0.9 * far(models[1], joints.flip(0))


def test_guidance_pulls_the_handles(models, truth):
    joints = truth.positions[:, 0]
    which = handles.chosen(FIVE, len(joints), seeded())
    far = []
    for weight in (0.0, 5.0, 20.0):
        made = completion.complete(models[0], joints, which, seeded(), steps=20, finish=False, guidance=weight)
        far.append(completion.missed(made, joints, which).nanmean())
    assert far[1] < 0.8 * far[0] and far[2] < far[1]


def test_the_pull_is_the_slope_of_the_missing_way(models, truth):
    """Against differences, in float64: d/dx_t of the handles' squared distances after the network."""
    model = models[0]
    joints = truth.positions[:1, 0].double()
    which = handles.chosen(("left_wrist",), 1, seeded())
    inner = replace(model, denoiser=model.denoiser.double())
    try:
        x, stamps, weight = model.encode(truth.clip(slice(0, 1))).double() + 0.3, torch.tensor([40]), 7.0
        pulled = completion.pulled(inner.denoiser, inner, joints, which, weight)(x, stamps)
        plain = inner.denoiser(x, stamps)

        def far(at):
            return (inner.decode(inner.denoiser(at, stamps)).positions[:, 0] - joints)[which].square().sum()

        for column in (1, 5, 20, 100):
            step = torch.zeros_like(x)
            step[..., column] = 1e-5
            slope = (far(x + step) - far(x - step)) / 2e-5
            expected = weight * inner.schedule.alpha_bar[40].sqrt() / 2 * slope
            assert (plain - pulled)[0, 0, column] == pytest.approx(expected.item(), rel=1e-4, abs=1e-9)
    finally:
        model.denoiser.float()


# --------------------------------------------------------------------------------------------- rotations that stay
def test_what_is_kept_of_a_chain(models):
    layout = models[0].layout
    which = handles.chosen(("left_wrist",), 1, seeded())
    chain = ["pelvis", "spine1", "spine2", "spine3", "left_collar", "left_shoulder", "left_elbow", "left_wrist"]
    assert torch.equal(completion.kept(layout, which)[0], layout.mask(1, joints=chain))
    assert torch.equal(completion.kept(layout, which, chains=False)[0], layout.mask(1, joints=["left_wrist"]))
    both = completion.kept(layout, handles.chosen(("pelvis",), 1, seeded()))[0]
    assert torch.equal(both, layout.mask(1, joints=["pelvis"], groups=["root"]))


def test_kept_chains_keep_the_handles_but_for_the_height(models, truth):
    which = handles.chosen(("left_wrist", "head"), len(truth.root), seeded())
    which[:12, 0] = True  # the pelvis of half of them
    at = which.clone()
    made = completion.keep(models[0], truth, which, seeded())
    off = (made.positions - truth.positions)[:, 0]
    assert off[:12][at[:12]].abs().max() < 1e-4
    assert (off - off[:, :1])[at].abs().max() < 1e-4 and off[..., :2][at].abs().max() < 1e-3
    assert off[12:, 0, 2].abs().max() > 1e-3 and completion.unobserved(made, truth, which).min() > 0.02
    loose = completion.keep(models[0], truth, which, seeded(), chains=False)
    assert rotation.geodesic(loose.rot, truth.rot)[:, 0][which].max() < 1e-2
    assert completion.missed(loose, truth.positions[:, 0], which)[:, 1:].nanmean() > 0.02


# --------------------------------------------------------------------------------------------------- the measures
def test_measures_against_loops(truth):
    other = truth.clip(torch.arange(23, -1, -1))
    which = handles.chosen(4, 24, seeded())
    missed, free = (
        completion.missed(other, truth.positions[:, 0], which),
        completion.unobserved(other, truth, which),
    )
    far = (other.positions - truth.positions)[:, 0].norm(dim=-1)
    for b in range(24):
        held = which[b].nonzero()[:, 0].tolist()
        assert missed[b].isfinite().nonzero()[:, 0].tolist() == held
        assert missed[b][held].tolist() == far[b][held].tolist()
        assert free[b] == pytest.approx(far[b][[j for j in range(22) if j not in held]].mean().item(), rel=1e-5)
    three = torch.stack([truth.positions[:, 0], other.positions[:, 0], truth.positions[:, 0] + 1.0])
    pairs = [(three[i] - three[j]).norm(dim=-1) for i, j in ((0, 1), (0, 2), (1, 2))]
    by_hand = torch.stack([torch.stack(pairs).mean(0)[b][~which[b]].mean() for b in range(24)])
    assert (completion.spread(three, which) - by_hand).abs().max() < 1e-5
    assert completion.spread(three[[0, 0]], which).abs().max() == 0


def test_what_cannot_be(models, truth, windows):
    joints, which = truth.positions[:, 0], handles.chosen(3, 24, seeded())
    with pytest.raises(ShapeError, match="targets"):
        completion.complete(models[0], joints[:, :5], which, seeded())
    with pytest.raises(ShapeError, match="bool"):
        completion.complete(models[0], joints, which.float(), seeded())
    with pytest.raises(DataError, match="not finite"):
        completion.complete(models[0], torch.full_like(joints, torch.inf), which, seeded())
    with pytest.raises(DataError, match="60 frames"):
        completion.complete(replace(models[0], recipe=replace(models[0].recipe, frames=60)), joints, which, seeded())


# ---------------------------------------------------------------------------------------------- without a network
@pytest.fixture(scope="module")
def library(windows):
    return known_poses.known(replace(windows.evenly(150), skeleton=STANDARD))


def test_the_nearest_pose(library, truth):
    joints = truth.positions[:, 0]
    which = handles.chosen(3, 24, seeded())
    which[0] = False  # nothing is seen: any pose will do
    found = library.nearest(torch.where(which[..., None], joints, torch.nan), which)
    far = ((library.joints[None] - joints[:, None]) * which[:, None, :, None]).square().sum((-1, -2))
    ours = ((found.positions[:, 0] - joints) * which[..., None]).square().sum((-1, -2))
    assert (ours - far.amin(1)).abs().max() < 1e-5
    own = library.joints[:40]
    again = library.nearest(own, torch.ones(40, 22, dtype=torch.bool))
    assert (again.positions[:, 0] - own).abs().max() < 1e-5


def test_ridge_regression_against_its_normal_equations(library, truth):
    """For one subset: the weights that least squares with a penalty finds, on centred numbers."""
    which = handles.chosen(("head", "left_foot"), 24, seeded())
    joints = truth.positions[:, 0]
    sixd = rotation.matrix_to_sixd(library.poses.rot[:, 0]).flatten(1)
    made = torch.cat((library.poses.root[:, 0], sixd), -1).double()
    seen = library.joints[:, which[0]].flatten(1).double()
    x, y = seen - seen.mean(0), made - made.mean(0)
    weights = torch.linalg.solve(x.mT @ x + len(x) * 1e-3 * torch.eye(6).double(), x.mT @ y)
    said = made.mean(0) + (joints[:, which[0]].flatten(1).double() - seen.mean(0)) @ weights
    found = library.regressed(torch.where(which[..., None], joints, torch.nan), which, ridge=1e-3)
    assert (found.root[:, 0] - said[:, :3]).abs().max() < 1e-5
    assert (found.rot[:, 0] - rotation.sixd_to_matrix(said[:, 3:].unflatten(-1, (-1, 6)))).abs().max() < 1e-4


def test_regression_knows_more_the_more_it_sees(library, truth):
    joints = truth.positions[:, 0]
    errors = [(library.mean(24).positions - truth.positions).norm(dim=-1).mean()]
    for handle in (("head", "left_wrist"), (*FIVE, "pelvis"), STANDARD.names):
        which = handles.chosen(handle, 24, seeded())
        errors.append((library.regressed(joints, which).positions - truth.positions).norm(dim=-1).mean())
    assert all(more < less for less, more in pairwise(errors))
    assert library.mean(3).rot.shape == (3, 1, 22, 3, 3)


def test_distance_to_known_poses(library, truth):
    some = library.poses.clip(slice(0, 20))
    turn = rotation.rotation_about("z", torch.tensor(1.0))
    rot = torch.cat((turn @ some.rot[..., :1, :, :], some.rot[..., 1:, :, :]), -3)
    elsewhere = replace(some, root=some.root + torch.tensor([5.0, 1.0, 0.0]), rot=rot)
    assert library.distance(elsewhere).max() < 1e-4
    assert library.distance(mirror(some)).max() < 1e-4
    lifted = replace(some, root=some.root + torch.tensor([0.0, 0.0, 0.01]))
    assert 0 < library.distance(lifted).min() and library.distance(lifted).max() <= 0.01 + 1e-5


def test_known_poses_are_single_and_on_one_body(windows):
    with pytest.raises(ShapeError, match="one body"):
        known_poses.known(windows.evenly(4))
    motion = Motion(STANDARD, torch.zeros(2, 5, 3), torch.eye(3).expand(2, 5, 22, 3, 3), 30.0)
    with pytest.raises(ShapeError, match="one body"):
        known_poses.known(motion)


# ------------------------------------------------------------------------------------------------------ all ways
def test_every_way_on_the_same_handles(models, truth, library):
    ways = pose_trials.rivals(library) | {
        "kept": pose_trials.kept(models[0], 5),
        "told": pose_trials.completed(models[1], 5),
        "told again": pose_trials.completed(models[1], 5),
    }
    sets = {"hands": handles.SETS["hands"], "two": 2}
    found = pose_trials.all_tried(ways, truth, library, lambda name: seeded(len(name)), sets)
    assert list(found) == [(name, way) for name in sets for way in ways]
    one = found["hands", "nearest neighbour"]
    which = handles.chosen(sets["hands"], 24, seeded())
    rough = library.nearest(truth.positions[:, 0], which)
    assert torch.allclose(
        one.before, (rough.positions - truth.positions)[:, 0].norm(dim=-1)[which].reshape(24, 2).mean(1)
    )
    assert torch.allclose(one.free, completion.unobserved(one.poses, truth, which))
    assert torch.equal(one.known, library.distance(rough)) and one.after.max() < 1e-3
    assert torch.equal(found["two", "told"].poses.rot, found["two", "told again"].poses.rot)
    both = (found["hands", "told"].before + found["two", "told"].before) / 2
    assert torch.allclose(pose_trials.over_sets(found, "told", "before"), both)
    row = pose_trials.table(found, ways)[4]
    assert row["way"] == "told" and row["handles, cm"] == pytest.approx(100 * both.mean().item(), rel=1e-5)
    assert row["after the finish, worst, mm"] < 1
