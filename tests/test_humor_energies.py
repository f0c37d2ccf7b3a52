import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from motionlab.errors import ShapeError
from motionlab.humor import energies
from motionlab.humor.priors import Gaussian
from motionlab.observation import Camera, project
from tests.rolled_inputs import golden_mixture

GOLDEN = np.load(Path(__file__).parent / "golden" / "humor_energies.npz")
F64 = torch.float64


def golden(name: str) -> torch.Tensor:
    return torch.as_tensor(GOLDEN[name], dtype=F64)


def joints() -> torch.Tensor:
    return golden("world_joints").reshape(4, 9, 22, 3)


def keypoints() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    seen = golden("reproj_obs")
    return golden("reproj_uv"), seen[..., :2], energies.body_25_confidence(seen[..., 2])


def contacts() -> torch.Tensor:
    return golden("loss_contact_conf")


INITIAL = torch.tensor([0.0, 0.5, 0.0], dtype=F64).expand(4, 3)  # the official first floor, below the camera
CASES = {
    "joints3d": (energies.joints3d, lambda: (joints(), golden("loss_joints_b"))),
    "smooth": (energies.joints3d_smooth, lambda: (joints(),)),
    "joint_consistency": (energies.joint_consistency, lambda: (joints(), golden("loss_joints_b"))),
    "bone_length": (energies.bone_length, lambda: (joints(),)),
    "contact_vel": (energies.contact_vel, lambda: (joints(), contacts())),
    "contact_height": (energies.contact_height, lambda: (joints(), contacts())),
    "floor_reg": (energies.floor_reg, lambda: (golden("floor3"), INITIAL)),
    "joints2d": (energies.joints2d, keypoints),
}


@pytest.mark.parametrize("name", CASES)
def test_an_energy_is_that_of_each_clip(name):
    """And its sum over all clips is the official one."""
    energy, arguments = CASES[name][0], CASES[name][1]()
    found = energy(*arguments)
    assert found.shape == (4,)
    alone = torch.cat([energy(*(x[i : i + 1] for x in arguments)) for i in range(len(arguments[0]))])
    torch.testing.assert_close(found, alone, rtol=1e-12, atol=0)
    torch.testing.assert_close(found.sum(), golden(f"loss_{name}").squeeze(), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", CASES)
def test_control_what_moves_in_one_clip_changes_that_clip(name, generator):
    energy, (first, *rest) = CASES[name][0], CASES[name][1]()
    moved = first.clone()
    moved[2] += 0.1 * torch.randn(first[2].shape, generator=generator)
    before, after = energy(first, *rest), energy(moved, *rest)
    assert (after[2] / before[2] - 1).abs() > 1e-6 and torch.equal(before[[0, 1, 3]], after[[0, 1, 3]])


def test_gmof_is_bounded():
    found = energies.gmof(golden("gmof_in"))
    torch.testing.assert_close(found, golden("gmof_sigma100"), rtol=1e-10, atol=1e-10)
    assert (energies.gmof(torch.tensor(1e6)) - 1e4).abs() < 1  # bounded by sigma^2
    assert not torch.allclose(energies.gmof(golden("gmof_in"), 50.0), found)


def test_initial_state_is_minus_its_log_probability():
    mixture = SimpleNamespace(log_prob=lambda x: x.sum(-1))
    assert torch.equal(energies.init_motion_prior(golden("gmm_x"), mixture), -golden("gmm_x").sum(-1))
    with pytest.raises(ShapeError, match="features"):
        energies.init_motion_prior(golden("gmm_x")[:, :137], mixture)


def test_priors_of_pose_and_shape(generator):
    latent, betas = torch.randn(3, 5, 32, generator=generator), torch.randn(3, 8, generator=generator)
    assert torch.allclose(energies.pose_prior(latent), latent.norm(dim=(1, 2)) ** 2)
    assert torch.allclose(energies.shape_prior(betas, 60), 60 * betas.norm(dim=1) ** 2)
    assert energies.pose_prior(latent + 1).max() > energies.pose_prior(latent).max()
    assert torch.allclose(
        energies.floor_reg(betas[:, :3], betas[:, 3:6], 7), 7 * energies.floor_reg(betas[:, :3], betas[:, 3:6])
    )


def test_golden_motion_prior():
    rolled = np.load(Path(__file__).parent / "golden" / "humor_rollouts.npz")
    z, mean, var = (torch.as_tensor(rolled[n]).double() for n in ("roll_z", "roll_prior_mean", "roll_prior_var"))
    found, other = (energies.motion_prior(z, Gaussian(mean, x.log())).sum() for x in (var, 2 * var))
    torch.testing.assert_close(found, golden("loss_motion_prior_nll").squeeze(), rtol=1e-10, atol=1e-10)
    assert (other / found - 1).abs() > 0.01


def test_golden_mixture():
    found = golden_mixture().log_prob(golden("gmm_x"))
    torch.testing.assert_close(found, golden("gmm_logprob").reshape(found.shape), rtol=1e-10, atol=1e-10)


def test_golden_projection():
    intrinsics = torch.tensor([[1060.5, 0, 960], [0, 1060.4, 540], [0, 0, 1]], dtype=F64)
    camera = Camera(intrinsics, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64), 1920, 1080)
    pixels, _ = project(camera, golden("reproj_joints3d_op25"))
    torch.testing.assert_close(pixels, golden("reproj_uv"), rtol=1e-7, atol=0)  # kornia adds an epsilon to the depth
    uv, seen, confidence = keypoints()
    torch.testing.assert_close(
        energies.joints2d(pixels, seen, confidence).sum(), golden("loss_joints2d"), rtol=1e-6, atol=0
    )
    with_hips = energies.joints2d(uv, seen, golden("reproj_obs")[..., 2]).sum()
    assert (with_hips / golden("loss_joints2d") - 1).abs() > 0.01


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_unobserved_numbers_reach_neither_value_nor_gradient(bad):
    uv, seen, confidence = keypoints()
    confidence[1, 4] = 0
    visible = torch.ones(4, 9, 22, dtype=torch.bool)
    visible[1, 4] = False
    observed = golden("loss_joints_b")
    for energy, points, data, weight in (
        (energies.joints2d, uv, seen, confidence),
        (energies.joints3d, joints(), observed, visible),
    ):
        results = []
        for hidden in (0.0, bad):
            there = data.clone()
            there[1, 4] = hidden
            free = points.clone().requires_grad_()
            value = energy(free, there, weight)
            (gradient,) = torch.autograd.grad(value.sum(), free)
            assert value.isfinite().all() and gradient.isfinite().all() and gradient[1, 4].abs().max() == 0
            results.append((value, gradient))
        assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
        shown = data.clone()
        shown[1, 5] = 0.0  # the control: what is observed counts
        assert (energy(points, shown, weight) - results[0][0]).abs()[1] > 0


def test_inf_marks_what_was_not_observed_in_3d():
    observed = golden("loss_joints_b")
    hidden = observed.clone()
    hidden[:, :, 4:9] = math.inf
    visible = torch.ones(4, 9, 22)
    visible[:, :, 4:9] = 0
    torch.testing.assert_close(energies.joints3d(joints(), hidden), energies.joints3d(joints(), observed, visible))
    assert (energies.joints3d(joints(), hidden) < energies.joints3d(joints(), observed)).all()


def test_nine_contacts_are_those_of_the_nine_joints(generator):
    logits = torch.randn(4, 8, 9, generator=generator, dtype=F64)
    nine = energies.contact_probabilities(logits)
    assert nine.shape == (4, 9, 9) and torch.equal(nine[:, 0], nine[:, 1])
    full = torch.zeros(4, 9, 22, dtype=F64)
    full[:, :, [0, 4, 5, 7, 8, 10, 11, 20, 21]] = nine
    for energy in (energies.contact_vel, energies.contact_height):
        torch.testing.assert_close(energy(joints(), nine), energy(joints(), full))
        assert not torch.allclose(energy(joints(), nine), energy(joints(), full.flip(2)))
        with pytest.raises(ShapeError, match="contacts"):
            energy(joints(), nine[:, :, :8])


def test_coincident_joints_have_a_finite_gradient():
    still = torch.zeros(1, 3, 22, 3, requires_grad=True)
    energies.bone_length(still).sum().backward()
    assert still.grad.isfinite().all()


def test_weights_by_stage():
    rgb = energies.RGB
    assert rgb.of(1) == {"joints2d": 0.001}
    assert rgb.of(1, listed=True)["joints3d_smooth"] == 100.0
    assert rgb.of(2) == {"joints2d": 0.001, "joints3d_smooth": 100.0, "pose_prior": 0.04, "shape_prior": 0.05}
    assert "pose_prior" not in rgb.of(3) and rgb.of(3)["bone_length"] == 2000.0
    assert rgb.of(3, frames=60)["init_motion_prior"] == pytest.approx(4 * rgb.of(3)["init_motion_prior"])
    assert rgb.of(3, frames=60)["motion_prior"] == rgb.of(3)["motion_prior"]
    assert energies.JOINTS.of(1) == {"joints3d": 1.0} and "floor_reg" not in energies.JOINTS.of(3)
    assert energies.KEYPOINTS.of(2)["joints3d_smooth"] == 0.1 and energies.KEYPOINTS.of(3)["motion_prior"] == 5e-4
