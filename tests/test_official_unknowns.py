"""Both modes of a fit see the same energies at the same point."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from motionlab import rotation
from motionlab.errors import ShapeError
from motionlab.humor import energies, state
from motionlab.humor import unknowns as humor_unknowns
from motionlab.humor.cvae import Cvae
from motionlab.humor.evidence import LEVEL, Evidence, View
from motionlab.humor.priors import InitGmm, first_state_features
from motionlab.humor.unknowns import Unknowns, from_matrix, local_first
from motionlab.skeleton import UPRIGHT
from studies.official import unknowns as official_unknowns

FRAMES = 20
FREE = ("trans", "z", "betas", "camera", "latent")


class Mlp(torch.nn.Module):
    """Stands for the pose prior."""

    def __init__(self):
        super().__init__()
        self.net = torch.nn.Linear(32, 126)

    def decode(self, latent):
        return rotation.sixd_to_matrix(self.net(latent).unflatten(-1, (21, 6)) + torch.tensor([1.0, 0, 0, 0, 1, 0]))


@pytest.fixture
def priors():
    torch.manual_seed(0)
    motion = Cvae(64)
    with torch.no_grad():
        for weight in motion.parameters():
            torch.nn.init.normal_(weight, 0, 0.05)
    initial = InitGmm(torch.tensor([0.4, 0.6]), torch.randn(2, 138), torch.eye(138).expand(2, 138, 138))
    return SimpleNamespace(motion=motion.frozen(), pose=Mlp().requires_grad_(requires_grad=False), initial=initial)


def evidence(view: bool, generator: torch.Generator) -> Evidence:
    if not view:
        return Evidence(torch.randn(2, FRAMES, 22, 3, generator=generator), torch.ones(2, FRAMES, 22), 30.0)
    k = torch.tensor([[1060.0, 0, 960], [0, 1060, 540], [0, 0, 1]]).expand(2, 3, 3)
    camera = View(k, LEVEL.expand(2, 3, 3), torch.tensor([0.0, -4, 1.2]).expand(2, 3), (1920, 1080), True)
    pixels = 500 + 300 * torch.rand(2, FRAMES, 25, 2, generator=generator)
    return Evidence(pixels, torch.rand(2, FRAMES, 25, generator=generator), 30.0, camera)


def unknowns(generator: torch.Generator, frames: int) -> tuple[Unknowns, Unknowns]:
    """One point as 6 numbers and as rotation vectors; ``frames`` of root and pose, one where stage 3 is meant."""
    turn = UPRIGHT @ rotation.exp(0.3 * torch.randn(2, 1, frames, 3, generator=generator))
    draw = lambda scale, *shape: scale * torch.randn(2, *shape, generator=generator)  # noqa: E731
    shared = {
        "trans": draw(0.1, 1, frames, 3) + torch.tensor([0.0, 0, 0.9]), "latent": draw(0.3, 1, frames, 32),
        "trans_vel": draw(0.1, 1, 3), "root_orient_vel": draw(0.1, 1, 3), "joints_vel": draw(0.1, 1, 66),
        "z": draw(0.3, 1, FRAMES - 1, 48), "betas": draw(0.5, 8), "camera": draw(0.02, 3),
    }  # fmt: skip
    if frames == 1:
        turn = turn[:, :, 0]
        shared |= {name: shared[name][:, :, 0] for name in ("trans", "latent")}
    return tuple(Unknowns(orient=from_matrix(turn, mode), **shared) for mode in ("lean", "official"))


def data(body, seen: Evidence) -> dict:
    if seen.view is None:
        return {"joints3d": energies.joints3d(body.observed, seen.values, seen.weight)}
    return {"joints2d": energies.joints2d(body.observed, seen.values, seen.weight)}


def stage_2(form, unknown, priors, seen) -> dict:
    body = form.pose(unknown, priors, seen)
    return data(body, seen) | {"smooth": energies.joints3d_smooth(body.joints)}


def stage_3(form, unknown, priors, seen) -> dict:
    states, rolled, body = form.roll(unknown, priors, seen)
    own, touching = state.unpack(states)["joints"], energies.contact_probabilities(rolled.contact_logits)
    first = first_state_features(local_first(states[:, 0]))
    return data(body, seen) | {
        "motion_prior": energies.motion_prior(rolled.z, rolled.prior),
        "init_motion_prior": energies.init_motion_prior(first, priors.initial),
        "joint_consistency": energies.joint_consistency(body.joints, own),
        "bone_length": energies.bone_length(own),
        "contact_vel": energies.contact_vel(body.joints, touching),
        "contact_height": energies.contact_height(body.joints, touching),
    }


@pytest.mark.parametrize("view", [True, False], ids=["2-D", "3-D"])
@pytest.mark.parametrize(("terms", "frames"), [(stage_2, FRAMES), (stage_3, 1)], ids=["stage 2", "stage 3"])
def test_every_energy_agrees_to_1e_4(generator, priors, terms, frames, view):
    seen, (lean, faithful) = evidence(view, generator), unknowns(generator, frames)
    ours, theirs = terms(humor_unknowns, lean, priors, seen), terms(official_unknowns, faithful, priors, seen)
    assert ours.keys() == theirs.keys() and len(ours) >= 2
    for name in ours:
        torch.testing.assert_close(theirs[name], ours[name], rtol=1e-4, atol=0, msg=lambda m, n=name: f"{n}: {m}")
    elsewhere = replace(faithful, betas=faithful.betas + 0.1)  # the control
    moved = terms(official_unknowns, elsewhere, priors, seen)
    assert max(((moved[n] / ours[n]) - 1).abs().max() for n in ours) > 1e-3


def test_gradients_agree_where_they_exist(generator, priors):
    seen, (lean, faithful) = evidence(True, generator), unknowns(generator, 1)
    slopes = []
    for form, unknown in ((humor_unknowns, lean), (official_unknowns, faithful)):
        free = {name: getattr(unknown, name).clone().requires_grad_() for name in FREE}
        terms = stage_3(form, replace(unknown, **free), priors, seen)
        total = sum(x.sum() for n, x in terms.items() if n != "init_motion_prior")
        slopes.append(dict(zip(free, torch.autograd.grad(total, free.values()), strict=True)))
    for name in FREE:
        apart = (slopes[0][name] - slopes[1][name]).norm() / slopes[0][name].norm()
        assert apart < 0.02, f"{name}: {apart:.1e}"


def test_wrong_shapes_are_named(generator, priors):
    _, faithful = unknowns(generator, 1)
    with pytest.raises(ShapeError, match="z"):
        official_unknowns.rollout(replace(faithful, z=faithful.z[..., :47]), priors)
