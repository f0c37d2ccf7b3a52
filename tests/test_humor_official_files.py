"""Priors from official files: they load, a fit with them runs, and what they know is said of the pelvis."""

import copy

import numpy as np
import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import checkpoint
from motionlab.errors import DataError
from motionlab.humor import pretrained, priors, rollout, state, testops
from motionlab.humor.evidence import Observation3D
from motionlab.humor.pretrained import _NAMES_1
from motionlab.humor.priors import Cvae, PosePrior, official_weights
from studies.nb04_prior import parity
from studies.official import rollout as official_rollout
from studies.shared import savings
from tests.rolled_inputs import golden_mixture

PELVIS = (0.02, -0.3, 0.05)  # of no body in particular


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files as the official releases have them, at full size, with seeded numbers."""
    folder = tmp_path_factory.mktemp("official")
    weights = {f"module.{name}": value.float() for name, value in parity.seeded().state_dict().items()}
    torch.save({"epoch": 7, "model": weights}, folder / "humor.pth")
    torch.manual_seed(0)
    theirs = {}
    for name, value in PosePrior(3).state_dict().items():
        layer, part = name.split(".")
        theirs[f"{_NAMES_1[layer]}.{part}"] = value
    torch.save(theirs, folder / "vposer.pt")
    np.savez(folder / "gmm.npz", **{n: x.numpy() for n, x in golden_mixture().tensors().items()})
    return {"motion": folder / "humor.pth", "pose": folder / "vposer.pt", "initial": folder / "gmm.npz"}


def walk():
    motion = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(2)).motion.cut(10, 17)
    return Observation3D(motion.positions[None], torch.ones(1, 7, 22, dtype=torch.bool)), motion


def test_a_fit_runs_with_official_files(files):
    known = pretrained.load_priors(**files, pelvis=PELVIS)
    assert known.motion.width == 1024 and known.pose.numbers == 3 and len(known.initial.weights) == 3
    seen, _ = walk()
    for mode in ("lean", "official"):
        schedule = testops.Schedule(steps=(1, 1, 1), inner=2, refine=(0, 1))
        fitted = testops.fit(seen, known, schedule=schedule, mode=mode)
        assert 3 in fitted.stages and fitted.stages[3].positions.isfinite().all()
        assert (fitted.results[3][-1].energy < fitted.results[3][-1].history[0]).all()


def test_official_files_alone_leave_the_rest_as_shipped(files):
    ours = pretrained.load_priors()
    mixed = pretrained.load_priors(pose=files["pose"])
    assert mixed.motion is ours.motion and mixed.initial is ours.initial and mixed.pose.numbers == 3
    mixed = pretrained.load_priors(initial=files["initial"], pelvis=PELVIS)
    assert mixed.motion is ours.motion and mixed.pose is ours.pose and len(mixed.initial.weights) == 3
    again = pretrained.load_priors(motion=checkpoint.SHIPPED / "humor_real.safetensors")
    assert torch.equal(again.motion.state_dict()["decoder.net.0.weight"], ours.motion.decoder.net[0].weight)
    mixed = pretrained.load_priors(motion=files["motion"], initial=files["initial"], pelvis=PELVIS)
    assert ours.motion.causal and not mixed.motion.causal and mixed.pose is ours.pose


def test_first_states_that_ship_are_not_those_of_an_official_motion_prior(files, tmp_path):
    """Its states know the next frame, also where a file of ours has its form; the control, of ours, needs no others."""
    own = tmp_path / "own"
    checkpoint.save(own, official_weights(Cvae(64)), {"made by": "hand"})
    for given in ({"motion": files["motion"], "pelvis": PELVIS}, {"motion": own}):
        with pytest.raises(DataError, match=f"{given['motion'].name}.*know the next frame") as caught:
            pretrained.load_priors(**given)
        assert "--initial" in caught.value.remedy
    known = pretrained.load_priors(motion=own, initial=files["initial"], pelvis=PELVIS)
    assert known.motion.width == 64 and len(known.initial.weights) == 3
    checkpoint.save(tmp_path / "causal", official_weights(Cvae(64, skip=True)), {"made by": "hand"})
    assert pretrained.load_priors(motion=tmp_path / "causal").initial is pretrained.load_priors().initial


@pytest.mark.parametrize("given", [PELVIS, (0.0, 0.0, 0.0)], ids=["right", "none"])
def test_an_official_prior_says_of_the_pelvis_what_it_said_of_its_translation(given, monkeypatch):
    """Roll-out, latents and likelihoods of one motion, in the official form and in ours; the control says something
    else."""
    monkeypatch.setitem(official_rollout.rollout.__kwdefaults__, "align", savings.exact_alignment)
    monkeypatch.setattr(official_rollout._frame, "__defaults__", (savings.exact_alignment,))
    official, mixture, j = parity.seeded(alternative=True), golden_mixture(), torch.tensor(PELVIS).double()
    ours = state.from_motion(walk()[1])[None].double()
    parts = state.unpack(ours)
    theirs = state.pack(parts | {"trans": parts["trans"] - j})
    moved = pretrained._at_pelvis(copy.deepcopy(official), given)
    moved_mixture = pretrained._mixture_at_pelvis(mixture, given)
    z = torch.randn(1, 4, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    there, here = official_rollout.rollout(official, theirs[:, 0], z), rollout.rollout(moved, ours[:, 0], z)
    latents = official_rollout.infer(official, theirs), rollout.infer(moved, ours)
    parts = official_rollout.split(theirs[:, 0])
    at = official_rollout._move(parts, *official_rollout._frame(parts), official_rollout._trans_to_joint(parts))
    first = official_rollout._join(at)[:, 0], state.localise(ours[:, 0], state.heading(ours[:, 0]))
    likely = [m.log_prob(priors.first_state_features(x)) for m, x in zip((mixture, moved_mixture), first, strict=True)]
    back = state.unpack(there.states)
    apart = {
        "states": (state.pack(back | {"trans": back["trans"] + j}) - here.states).abs().max(),
        "prior": (there.prior.mean - here.prior.mean).abs().max(),
        "posterior": (latents[0][0].mean - latents[1][0].mean).abs().max(),
        "first": (likely[0] - likely[1]).abs().max(),
    }
    if given == PELVIS:
        assert max(apart.values()) < 1e-6, apart
    else:
        assert min(apart.values()) > 1e-3, apart


def test_official_files_that_do_not_fit_are_refused(files, tmp_path):
    for given in ({"motion": files["motion"]}, {"initial": files["initial"]}):
        with pytest.raises(DataError, match="where the pelvis lies") as caught:
            pretrained.load_priors(**given)
        assert "J_0" in caught.value.remedy
    with pytest.raises(DataError, match="leave it out"):
        pretrained.load_priors(pose=files["pose"], pelvis=PELVIS)
    for wrong in ((float("nan"), 0.0, 0.0), (-1.8, -223.0, 28.0)):
        with pytest.raises(DataError, match="metres"):
            pretrained.load_priors(motion=files["motion"], pelvis=wrong)
    with pytest.raises(DataError, match="prior_net"):
        pretrained.load_priors(motion=files["pose"], pelvis=PELVIS)
    with pytest.raises(DataError, match="VPoser"):
        pretrained.load_priors(pose=files["motion"])
    torch.save({"model": Cvae(32).state_dict() | {"more": torch.zeros(1)}}, tmp_path / "more.pth")
    with pytest.raises(DataError, match="HuMoR's networks"):
        pretrained.load_priors(motion=tmp_path / "more.pth", pelvis=PELVIS)
