"""Quality of a prior: models whose errors are known beforehand, and what the shipped one must reach."""

import math

import pytest
import torch

from data_synth.corpus import Recipe, perform_sequence
from motionlab.humor import pretrained, state
from motionlab.humor.priors import Cvae
from motionlab.humor.rollout import infer, rollout, sample_rollout
from motionlab.humor.state import DELTA_SLICES, SLICES, heading, localise
from motionlab.skeleton import STANDARD
from motionlab.training import quality

UNSEEN = Recipe(seconds=22.0, seed=77)  # another seed than the corpus
PERFORMANCES = (1, UNSEEN.sequences - 1)  # the last by the person kept from training


@pytest.fixture(scope="module")
def take():
    motions = [perform_sequence(UNSEEN, index).motion for index in PERFORMANCES]
    x = torch.cat([state.from_motion(m, causal=True).float().unfold(0, 61, 122).mT for m in motions])
    return x, torch.cat([m.contacts.unfold(0, 61, 122).mT for m in motions])


@pytest.fixture
def still():
    """A model that changes nothing, whose z says nothing and whose contacts are open."""
    model = Cvae(64)
    with torch.no_grad():
        for net in (model.encoder, model.prior_net, model.decoder):
            net.net[-1].weight.zero_()
            net.net[-1].bias.zero_()
    return model.frozen()


def touching(model, joints=None):
    part = torch.full((9,), -4.0)
    part[joints if joints is not None else slice(None)] = 4.0
    model.decoder.net[-1].bias[DELTA_SLICES["contacts"]] = part
    return model


def plausibility(model, first):
    """Of twelve frames that a model makes."""
    return quality.looks(first, sample_rollout(model, first, 12, generator=torch.Generator().manual_seed(0)).states)


def test_a_model_that_does_nothing_is_the_held_pose(still, take):
    states, _ = take
    step, way = quality.one_step_errors(still, states), quality.rollout_errors(still, states)
    assert torch.allclose(step["posterior"], step["hold"]) and torch.allclose(step["prior mean"], step["hold"])
    for name in ("posterior z", "closed loop", "prior mean"):
        assert torch.allclose(way[name], way["hold"], atol=1e-2), name
    assert (step["kl"] == 0).all()


def test_errors_are_centimetres_and_baselines_are_what_they_say(still, take):
    states, _ = take
    joints = states[..., SLICES["joints"]].unflatten(-1, (22, 3))
    moved = 100 * (joints[:, 1:] - joints[:, :-1]).norm(dim=-1).mean(-1)
    assert torch.allclose(quality.one_step_errors(still, states)["hold"], moved.flatten(), atol=1e-3)
    steady = states[:, :1].repeat(1, 61, 1)
    speed = torch.tensor([0.3, -0.2, 0.1])
    for name in ("joints_vel", "trans_vel"):
        steady[..., SLICES[name]] = speed.repeat(len(range(*SLICES[name].indices(339))) // 3)
    way = (torch.arange(61) / 30)[:, None] * speed
    for name in ("joints", "trans"):
        part = SLICES[name]
        steady[..., part] += way.repeat(1, (part.stop - part.start) // 3)
    assert quality.one_step_errors(still, steady)["constant velocity"].max() < 1e-3
    hold = quality.rollout_errors(still, steady)["hold"][:, -1]
    assert torch.allclose(hold, torch.tensor(100 * 2 * float(speed.norm())).expand(len(hold)), rtol=1e-3)


def test_a_shift_of_the_prior_costs_what_it_must(still, take):
    states, contacts = take
    still.encoder.net[-1].bias[:5] = 1.0  # five means one standard deviation off
    cost = quality.one_step_errors(still, states)["kl"]
    assert torch.allclose(cost[:, :5], torch.tensor(0.5)) and (cost[:, 5:] == 0).all()
    row = quality.quality_row(still, states, contacts)
    assert row["active"] == 5 and row["kl, nats"] == pytest.approx(2.5)


def test_a_still_body_is_plausible_and_a_sunk_one_is_not(still, take):
    first = take[0][:2, 0]
    first = on_its_feet(first)
    calm = plausibility(touching(still), first)
    assert calm["slide"].max() < 1e-2 and calm["bones"].max() < 1e-2 and calm["acceleration"].max() < 0.05
    assert (calm["penetration"] == 0).all()
    for part in ("joints", "trans"):
        first[:, SLICES[part].start + 2 : SLICES[part].stop : 3] -= 1.5
    assert (plausibility(still, first)["penetration"] == 1).all()


def on_its_feet(first):
    """The same states with both balls of the feet 1 cm above their resting height."""
    first, part = first.clone(), SLICES["joints"]
    for name in ("left_foot", "right_foot"):
        first[:, part.start + 3 * STANDARD.index(name) + 2] = STANDARD.sole + 0.01
    return first


def test_a_gliding_body_slides_whatever_it_says_of_its_contacts(still, take):
    first, shift = on_its_feet(take[0][:2, 0]), DELTA_SLICES["joints"]
    still.decoder.net[-1].bias[shift.start + 1 : shift.stop : 3] = 0.004  # all joints 4 mm a frame ahead
    for said in (None, []):
        assert torch.allclose(plausibility(touching(still, said), first)["slide"], torch.tensor(4.0), atol=1e-2)
    first[:, SLICES["joints"].start + 2 : SLICES["joints"].stop : 3] += 0.5
    assert plausibility(still, first)["slide"].isnan().all()


def test_contact_f1_of_constant_answers(still, take):
    states, contacts = (x[:2] for x in take)
    truth = contacts[:, 1:]
    right = STANDARD.contact_indices.index(STANDARD.index("left_ankle"))

    def f1(model, of="one step, posterior, contact F1"):
        return quality.quality_row(model, states, contacts)[of]

    assert f1(touching(still, [])) in (0.0, pytest.approx(0.0, nan_ok=True))
    share = float(truth.mean())
    assert f1(touching(still)) == pytest.approx(2 * share / (1 + share), abs=1e-4)
    assert 0 < f1(touching(still, [right])) < 1
    both = 2 * float((truth * contacts[:, :-1]).sum() / (truth.sum() + contacts[:, :-1].sum()))  # F1 by its definition
    assert f1(still, "contact F1, as one frame before") == pytest.approx(both, abs=1e-4)


def test_effective_rank_counts_the_directions_that_z_has(still, take):
    """Three directions of one size are three; a fourth that is tiny is hardly one; more of the same are none."""
    past = localise(take[0][:2, 0], heading(take[0][:2, 0]))
    weight = still.decoder.net[-1].weight.data
    weight.zero_()
    joints, z = DELTA_SLICES["joints"].start, weight.shape[1] - 48
    for k in range(3):
        weight[joints + k, z + k] = 1.0
    assert quality.effective_rank(still, past) == pytest.approx(3.0, abs=1e-2)
    weight[joints + 2, z + 2] = 0.5  # shares .4, .4, .2: by hand
    by_hand = math.exp(-(2 * 0.4 * math.log(0.4) + 0.2 * math.log(0.2)))
    assert quality.effective_rank(still, past) == pytest.approx(by_hand, abs=1e-2)
    weight[joints + 2, z + 2], weight[joints + 3, z + 3] = 1.0, 1e-3
    assert quality.effective_rank(still, past) == pytest.approx(3.0, abs=0.05)
    weight[joints + 3, z + 3], weight[joints, z + 4] = 0.0, 1.0
    assert quality.effective_rank(still, past) < 3.0


def test_more_samples_come_closer_and_a_still_body_has_one(still, take):
    states, _ = take
    held = quality.rollout_errors(still, states)["hold"][:, -1]
    assert torch.allclose(quality.best_of(still, states, 3, torch.Generator().manual_seed(0)), held, atol=1e-2)
    model = pretrained.load_motion_prior("humor_real")
    few, many = (quality.best_of(model, states, n, torch.Generator().manual_seed(0)).mean() for n in (1, 8))
    assert many < few


# ---------------------------------------------------------------------------------------------- what ships
@pytest.fixture(scope="module")
def row(take):
    """Of the prior that ships."""
    return quality.quality_row(pretrained.load_motion_prior("humor_real"), *take)


def test_the_shipped_prior_knows_more_than_its_baselines(row):
    assert row["one step, posterior, cm"] < 0.5 < row["one step, hold, cm"]
    for name in ("hold", "prior mean"):
        assert row["2 s, posterior z, cm"] < 0.6 * row[f"2 s, {name}, cm"], name
    assert row["2 s, closed loop, cm"] < row["2 s, posterior z, cm"]
    assert row["one step, posterior, contact F1"] > 0.85
    assert row["samples' bones"] < 10


def test_control_z_of_another_motion_leads_astray(take, row):
    """z carries information: that of other clips does not lead back to this one."""
    states, model = take[0], pretrained.load_motion_prior("humor_real")
    assert row["active"] >= 16 and 4 < row["kl, nats"] < 60
    z = infer(model, states)[0].mean
    ends = rollout(model, states[:, 0], z.roll(1, 0), with_prior=False).states[:, -1]
    astray = 100 * (ends - states[:, -1])[:, SLICES["joints"]].unflatten(-1, (22, 3)).norm(dim=-1).mean()
    assert astray > 2 * row["2 s, posterior z, cm"]
