"""The priors together, and checkpoints that are missing or of something else."""

import shutil

import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import checkpoint
from motionlab.errors import DataError
from motionlab.humor import pretrained, priors, state
from motionlab.training import chain_training, recipes


def first_states(seed: int = 5) -> torch.Tensor:
    """Features of the held-out subject, made for this test alone."""
    takes = [ACTIONS[name](SUBJECTS[3], torch.Generator().manual_seed(seed)) for name in ("walk", "sit", "kick")]
    return recipes._first_states([take.motion for take in takes], 5)


def test_unknown_name():
    with pytest.raises(DataError, match=r"humor_nobody.*train"):
        pretrained.load_priors("nobody")


def test_mixture_tells_people_from_nonsense(generator):
    gmm, real = pretrained.load_initial("init_gmm_real"), first_states()
    likely = gmm.log_prob(real)
    shuffled = real[:, torch.randperm(138, generator=generator)]
    assert likely.isfinite().all()
    assert (likely.median() - gmm.log_prob(shuffled).median()) > 100
    noisy = real + 0.05 * torch.randn(real.shape, generator=generator)
    assert (gmm.log_prob(noisy) < likely).float().mean() > 0.95


def test_mixture_beats_a_single_gaussian_on_what_was_held_out():
    gmm, real = pretrained.load_initial("init_gmm_real"), first_states()
    away = gmm.means - (gmm.weights @ gmm.means)
    covariance = torch.einsum("k,kij->ij", gmm.weights, gmm.covariances + away[:, :, None] * away[:, None])
    single = priors.InitGmm(torch.ones(1), (gmm.weights @ gmm.means)[None], covariance[None])  # the same two moments
    assert gmm.log_prob(real).mean() > single.log_prob(real).mean() + 5


def test_components_stay_positive_definite_as_stored():
    tensors, _ = checkpoint.load(checkpoint.SHIPPED / "init_gmm_real")
    smallest = torch.linalg.eigvalsh(tensors["covariances"].double()).amin()
    assert smallest > 0.5 * recipes.MIXTURE_RIDGE


def test_other_bodies_keep_angles_and_feet(generator):
    motion = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(2)).motion.cut(0, 60)
    other = chain_training.random_body(motion, generator)
    assert torch.equal(other.rot, motion.rot)
    assert (other.skeleton.offsets.norm(dim=-1) / motion.skeleton.offsets.norm(dim=-1).clamp(min=1e-9))[1:].std() > 0.01
    lowest = [m.positions[..., 2].amin(-1) for m in (motion, other)]
    assert (lowest[0] - lowest[1]).abs().max() < 0.04
    made = recipes._first_states([motion], 10, generator)
    assert made.shape == (24, 138)  # itself, its mirror image, and both on other bodies
    world = state.from_motion(motion, causal=True)[::10]
    assert torch.allclose(made[:6], priors.first_state_features(state.localise(world, state.heading(world))), atol=1e-6)


def copy(name: str, folder) -> None:
    for suffix in (".safetensors", ".json"):
        shutil.copy(checkpoint.SHIPPED / f"{name}{suffix}", folder / f"{name}{suffix}")


def test_foreign_checkpoints(tmp_path):
    copy("pose_prior_real", tmp_path)
    copy("init_gmm_real", tmp_path)
    with pytest.raises(DataError, match="pose prior"):
        pretrained.load_pose_prior(str(tmp_path / "init_gmm_real"))
    with pytest.raises(DataError, match="weights"):
        pretrained.load_initial(str(tmp_path / "pose_prior_real"))


def test_numbers_that_are_not_finite(tmp_path):
    tensors, recipe = checkpoint.load(checkpoint.SHIPPED / "pose_prior_real")
    checkpoint.save(tmp_path / "spoilt", tensors | {"mean.bias": torch.full((32,), torch.inf)}, recipe)
    with pytest.raises(DataError, match="finite"):
        pretrained.load_pose_prior(str(tmp_path / "spoilt"))
