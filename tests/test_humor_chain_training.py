"""Training by chains: causal states, windows made when drawn, what teaches nothing, and a model that goes on."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from motionlab.diffusion.windows import gather
from motionlab.errors import DataError
from motionlab.humor.priors import Cvae
from motionlab.humor.state import (
    SLICES,
    apply,
    from_motion,
    heading,
    localise,
    pack,
    transition_pairs,
    unpack,
)
from motionlab.motion import mirror
from motionlab.skeleton import STANDARD
from motionlab.training import chain_training
from motionlab.training.chain_training import ChainRecipe, ChainTraining, Scales
from tests.draws import seeded

SMALL = ChainRecipe(width=64, steps=8, batch=10, length=3, chain=2, seed=5)
FEET = [STANDARD.index(f"{side}_foot") for side in ("left", "right")]


@pytest.fixture(scope="module")
def data(motions):
    return gather(motions, SMALL.length + 2, missing=[(), ("left_foot",)])


@pytest.fixture
def transitions(motions):
    """Past and now (N, 339) in the frame of the past, doubles."""
    return transition_pairs(from_motion(motions[0].to(torch.float64), causal=True))


def drawn(data, count=60, **change):
    return chain_training.drawn(data, count, seeded(1), **change)


# ----------------------------------------------------------------------------------------------- causal states
def test_causal_velocities_know_the_past_only(motions):
    motion = motions[0].cut(0, 12).to(torch.float64)
    found, places = unpack(from_motion(motion, causal=True)), motion.positions
    for t in range(motion.frames):
        now, before = max(t, 1), max(t, 1) - 1
        for joint in range(22):
            by_hand = [30 * float(places[now, joint, k] - places[before, joint, k]) for k in range(3)]
            assert found["joints_vel"][t, joint].tolist() == pytest.approx(by_hand, abs=1e-9)
        assert found["trans_vel"][t].tolist() == pytest.approx((30 * (motion.root[now] - motion.root[before])).tolist())
        turn = Rotation.from_matrix(motion.rot[now, 0].numpy()) * Rotation.from_matrix(motion.rot[before, 0]).inv()
        assert np.allclose(found["root_orient_vel"][t], 30 * turn.as_rotvec(), atol=1e-6)
    later = replace(motion, root=motion.root + (torch.arange(12) > 8)[:, None] * 0.1)
    for causal in (True, False):  # central differences hear of it a frame before
        same = (from_motion(later, causal=causal) == from_motion(motion, causal=causal)).all(-1)
        assert same.tolist() == [t <= (8 if causal else 7) for t in range(12)]
    assert from_motion(motion.cut(0, 1), causal=True)[0, SLICES["joints_vel"]].eq(0).all()


# ------------------------------------------------------------------------------------------------ windows as states
def test_windows_are_those_of_the_motions_and_their_mirror_images(motions, data):
    states, contacts, offsets, _ = drawn(data, bodies=0.0)
    tables = [(from_motion(m, causal=True), m.contacts) for a in motions for m in (a, mirror(a))]
    which = []
    for window, labels, bones in zip(states, contacts, offsets, strict=True):
        begins = ((k, at) for k, (table, _) in enumerate(tables) for at in range(1, len(table) - 3))
        ((k, at),) = [(k, at) for k, at in begins if (tables[k][0][at, :3] - window[0, :3]).abs().max() < 1e-5]
        assert torch.allclose(tables[k][0][at : at + 4], window, atol=2e-4)
        assert torch.equal(tables[k][1][at : at + 4], labels)
        assert torch.allclose(bones, motions[k // 2].skeleton.offsets, atol=1e-6)
        which.append(k)
    assert 15 < sum(k % 2 for k in which) < 45 and set(which) == {0, 1, 2, 3}


def test_other_bodies_have_the_bones_they_say_and_paths_as_long_as_their_legs(data):
    own, other = drawn(data, bodies=0.0), drawn(data)
    joints = unpack(other[0])["joints"]
    for joint, parent in enumerate(STANDARD.parents[1:], start=1):
        length = (joints[:, :, joint] - joints[:, :, parent]).norm(dim=-1)
        assert torch.allclose(length, other[2][:, joint].norm(dim=-1, keepdim=True).expand(-1, 4), atol=1e-4)
    assert torch.equal(own[1], other[1]) and torch.equal(own[3], other[3])
    for name in ("root_orient", "pose_body", "root_orient_vel"):
        assert torch.allclose(own[0][..., SLICES[name]], other[0][..., SLICES[name]], atol=1e-5)
    legs = STANDARD.indices(["left_knee", "left_ankle"])
    grown = (other[2][:, legs].norm(dim=-1).sum(-1) / own[2][:, legs].norm(dim=-1).sum(-1))[:, None, None]
    for name in ("trans", "trans_vel"):
        assert torch.allclose(other[0][..., SLICES[name]], grown * own[0][..., SLICES[name]], atol=1e-3)
    kept = (own[2] == other[2]).all(-1).all(-1)
    assert 10 <= kept.sum() <= 32 and grown.std() > 0.01


# ---------------------------------------------------------------------------------------------------- the losses
def test_a_joint_that_was_not_recorded_teaches_nothing_of_its_rotation(data):
    run = ChainTraining(SMALL, data)
    states, contacts, offsets, seen = drawn(data)
    judged = 45
    assert seen[:, FEET].all(1).any() and not seen[:, FEET].any(1).all()
    now = localise(states[:, 1:], heading(states[:, :-1]))
    after = (now + 0.01 * torch.randn(now.shape, generator=seeded())).requires_grad_()
    logits = torch.zeros(*after.shape[:2], 9, requires_grad=True)
    parts = run._parts(after, logits, now, contacts[:, 1:], offsets, seen, judged)
    (slope,) = torch.autograd.grad(sum(parts.values()), after, retain_graph=True)
    feet = slope[..., SLICES["pose_body"]].unflatten(-1, (21, 9))[:, :, [j - 1 for j in FEET]].abs().amax((1, 2, 3))
    assert ((feet > 0) == (seen[:, FEET[0]] & (torch.arange(60) < judged))).all()
    compared = parts["reconstruction"] + parts["contact"]
    for slope in torch.autograd.grad(compared, (after, logits)):
        assert slope[judged:].eq(0).all() and slope[:judged].abs().amax((1, 2)).gt(0).all()


def test_the_truth_costs_nothing_and_a_skating_foot_does(data):
    run = ChainTraining(SMALL, data)
    states, contacts, offsets, seen = drawn(data, 20)
    now = localise(states[:, 1:], heading(states[:, :-1]))
    sure = 20 * (2 * contacts[:, 1:] - 1)
    parts = run._parts(now, sure, now, contacts[:, 1:], offsets, seen, 20)
    assert parts["reconstruction"] == 0 and parts["kinematics"] < 1e-4 and parts["contact"] < 1e-6
    faster = now.clone()
    faster[..., SLICES["joints_vel"]] += 1.0
    assert run._parts(faster, sure, now, contacts[:, 1:], offsets, seen, 20)["slide"] > parts["slide"] + 0.5


# ----------------------------------------------------------------------------------------------------- runs
@pytest.mark.parametrize("lr", [1e-2, 0.0])
def test_the_loss_falls(data, lr):
    """With the truth at every step; what the chain is left to itself for grows harder as it learns. At no rate it does
    not fall."""
    how = {"steps": 40, "batch": 20, "sampling_start": 1.0, "sampling_end": 2.0, "kl": 0.002}
    run = ChainTraining(replace(SMALL, lr=lr, **how), data)
    rows = [run.advance() for _ in range(40)]
    first, last = ({name: np.mean([row[name] for row in some]) for name in rows[0]} for some in (rows[:5], rows[-5:]))
    fell = last["loss"] < 0.8 * first["loss"] and last["reconstruction"] < 0.9 * first["reconstruction"]
    assert fell == (lr > 0)


def test_a_stopped_run_goes_on_to_the_bit(motions, data, tmp_path):
    whole, part = (ChainTraining(SMALL, data) for _ in range(2))
    other = ChainTraining(replace(SMALL, seed=6), data).run()
    whole.run(every=4)
    part.run(until=3, keep=tmp_path / "run.pt")
    again = ChainTraining.resume(tmp_path / "run.pt", data).run(every=4)
    assert again.curve[-1] == whole.curve[-1] and again.recipe == SMALL
    assert all(torch.equal(whole.average[name], value) for name, value in again.average.items())
    assert not torch.equal(other.average["skip.weight"], whole.average["skip.weight"])
    with pytest.raises(DataError, match="windows of 6 states for 3 transitions"):
        ChainTraining(SMALL, gather(motions, 7, missing=[(), ()]))


@pytest.mark.parametrize(("opened", "free"), [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5)])
def test_chains_of_every_mix_of_kinds_learn(data, opened, free):
    run = ChainTraining(replace(SMALL, open_loop=opened, free_running=free, steps=3), data)
    rows = [run.advance() for _ in range(3)]
    assert all(np.isfinite(value) for row in rows for value in row.values()) and rows[0]["kl"] > 0
    assert {value.dtype for value in run.averaged.state_dict().values()} == {torch.float32}


# --------------------------------------------------------------------------------------- the layer past the decoder
def model_with_skip(seed=1):
    torch.manual_seed(seed)
    return Cvae(64, skip=True, direct=True)


def onward(past):
    """Where a body is that goes on at its velocity for a thirtieth of a second, part by part."""
    parts = {name: value.clone() for name, value in unpack(past).items()}
    for name in ("trans", "joints"):
        parts[name] += parts[f"{name}_vel"] / 30
    spin = Rotation.from_rotvec(parts["root_orient_vel"].numpy() / 30).as_matrix()
    return pack(parts | {"root_orient": torch.from_numpy(spin) @ parts["root_orient"]})


def test_scales_fold_into_the_weights_exactly(transitions):
    past, now = transitions
    model = model_with_skip().double()
    found = Scales.measure(past.float(), now.float())
    measured = Scales(found.mean.double(), found.std.double(), found.change.double())
    plain, z = measured.folded(model), torch.randn(len(past), 48, generator=seeded(), dtype=torch.float64)
    for a, b in (
        *zip(measured.posterior(model, past, now), plain.posterior(past, now), strict=True),
        (measured.prior(model, past).mean, plain.prior(past).mean),
        (measured.prior(model, past).log_var, plain.prior(past).log_var),
        (measured.decode(model, past, z), plain.decode(past, z)),
    ):
        assert (a - b).abs().max() < 1e-10
    assert not torch.allclose(model.decode(past, z), plain.decode(past, z), atol=1e-3)  # the scales do matter
    again = measured.unfolded(plain).state_dict()
    assert all(torch.allclose(value, again[name], atol=1e-9) for name, value in model.state_dict().items())
    left = now - onward(past)  # what is to be learnt is smaller than the changes
    for name in ("trans", "joints"):
        assert left[:, SLICES[name]].std() < 0.3 * (now - past)[:, SLICES[name]].std()


def test_z_begins_as_the_change(data, transitions, monkeypatch):
    """Shown the answer, a model that has learnt nothing yet makes it to a fifth of what going on at the velocity
    leaves; one with random layers to and from z does not."""
    past, now = (x.float() for x in transitions)
    left = {}
    for begun in (True, False):
        if not begun:
            monkeypatch.setattr(chain_training, "begun_linear", lambda *_: None)
        model = ChainTraining(SMALL, data).averaged
        after, _ = apply(past, model.decode(past, model.posterior(past, now).mean))
        left[begun] = (unpack(after)["joints"] - unpack(now)["joints"]).norm(dim=-1).mean()
    plain = (unpack(onward(transitions[0]))["joints"] - unpack(transitions[1])["joints"]).norm(dim=-1).mean()
    assert left[True] < 0.2 * plain and left[False] > 0.8 * plain


def test_training_goes_on_from_a_models_weights(data):
    first = ChainTraining(SMALL, data)
    for _ in range(3):
        first.advance()
    run = ChainTraining(SMALL, data, first._made(first.model.state_dict()))
    for name, value in first.model.state_dict().items():
        assert torch.allclose(run.model.state_dict()[name], value, atol=1e-3), name
    assert math.isfinite(run.advance()["loss"]) and not torch.equal(run.model.skip.weight, first.model.skip.weight)


def test_a_model_that_says_nothing_goes_on_at_its_velocity(data, transitions):
    past, _ = transitions
    run = ChainTraining(SMALL, data)
    assert run.model.skip.weight.eq(0).all() and run.model.causal and not Cvae(64).causal
    silent = {name: value.clone() for name, value in run.model.state_dict().items()}
    for name in ("decoder.net.9.weight", "decoder.net.9.bias"):
        silent[name].zero_()
    made = run._made(silent).double()
    after, logits = apply(past, made.decode(past, torch.randn(len(past), 48, dtype=torch.float64, generator=seeded())))
    assert torch.allclose(after, onward(past), atol=1e-5) and logits.abs().max() < 1e-5
    assert not torch.allclose(after, past, atol=1e-2)
    whole = run._made(run.model.state_dict()).double()
    near, _ = apply(past, whole.decode(past, torch.zeros(len(past), 48, dtype=torch.float64)))
    assert 0 < (near - onward(past))[:, SLICES["trans"]].abs().max() < 0.02  # and before it learns, nearly so
