"""The pose prior: parts, training, VPoser's files, and what the shipped weights are worth."""

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from data_synth import anatomy
from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import rotation
from motionlab.errors import DataError, ShapeError
from motionlab.humor import pretrained
from motionlab.humor.priors import PosePrior
from motionlab.skeleton import STANDARD
from motionlab.training import recipes


@pytest.fixture(scope="module")
def model() -> PosePrior:
    torch.manual_seed(0)
    return PosePrior().eval().requires_grad_(False)


def _varied(rot, share):
    seen = torch.ones(rot.shape[:2], dtype=torch.bool)
    return recipes._varied_poses(rot, seen, torch.Generator().manual_seed(0), share)[0]


def unseen() -> torch.Tensor:
    """Poses (N, 21, 3, 3) of the held-out subject, made for this test alone."""
    takes = [ACTIONS[name](SUBJECTS[3], torch.Generator().manual_seed(77)) for name in ("walk", "sit", "kick", "reach")]
    return torch.cat([take.motion.rot[::10, 1:] for take in takes])


def test_shapes_and_rotations(model, generator):
    rot = rotation.random((2, 5, 21), generator)
    latent = model.encode(rot)
    assert latent.mean.shape == latent.log_var.shape == (2, 5, 32)
    found = model.decode(latent.mean)
    assert found.shape == (2, 5, 21, 3, 3)
    assert torch.allclose(found @ found.mT, torch.eye(3).expand_as(found), atol=1e-5)
    alone = model.encode(rot[0, 0]).mean
    assert alone.shape == (32,) and torch.allclose(alone, latent.mean[0, 0], atol=1e-5)
    with pytest.raises(ShapeError):
        model.decode(torch.zeros(2, 31))
    with pytest.raises(ShapeError):
        model.encode(rot[..., :20, :, :])


def test_training_learns_and_repeats():
    rot = unseen()
    seen, odds = torch.ones(rot.shape[:2], dtype=torch.bool), torch.ones(len(rot))
    runs = [recipes.PosePriorTraining(rot, seen, odds, torch.Generator().manual_seed(0), 60, 64) for _ in "ab"]
    first, second = (run.run(every=1).averaged for run in runs)
    assert runs[0].curve[-1]["miss"] < 0.3 * runs[0].curve[0]["miss"]
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert not any(p.requires_grad for p in first.parameters())


def test_mirror_of_a_pose_is_the_mirrored_motion():
    from motionlab.motion import mirror

    take = ACTIONS["kick"](SUBJECTS[0], torch.Generator().manual_seed(1)).motion.cut(0, 8)
    rot = take.rot[:, 1:].repeat(40, 1, 1, 1)
    made = _varied(rot, 0.0)
    flipped = mirror(take).rot[:, 1:].repeat(40, 1, 1, 1)
    as_was, as_flipped = ((made - x).abs().amax((1, 2, 3)) < 1e-6 for x in (rot, flipped))
    assert (as_was | as_flipped).all() and as_was.any() and as_flipped.any()


def test_limbs_of_other_people_leave_the_trunk():
    rot = unseen()
    made = _varied(rot, 1.0)
    spine = [STANDARD.index(name) - 1 for name in ("spine1", "spine2", "spine3", "neck", "head")]
    whole = _varied(rot, 0.0)
    assert torch.equal(made[:, spine], whole[:, spine])
    assert not torch.equal(made, whole)


class VPoser2(nn.Module):
    """VPoser 2.0 as published, for its names: a referee."""

    def __init__(self):
        super().__init__()
        heads = nn.Module()
        heads.mu, heads.logvar = nn.Linear(512, 32), nn.Linear(512, 32)
        self.encoder_net = nn.ModuleList(
            [nn.Flatten(), nn.BatchNorm1d(63), nn.Linear(63, 512), nn.LeakyReLU(), nn.BatchNorm1d(512), nn.Dropout(0.1),
             nn.Linear(512, 512), nn.Linear(512, 512), heads]
        )  # fmt: skip
        self.decoder_net = nn.ModuleList(
            [nn.Linear(32, 512), nn.LeakyReLU(), nn.Dropout(0.1), nn.Linear(512, 512), nn.LeakyReLU(),
             nn.Linear(512, 126)]
        )  # fmt: skip

    def encode(self, x):
        for layer in self.encoder_net[:-1]:
            x = layer(x)
        heads = self.encoder_net[-1]
        return heads.mu(x), F.softplus(heads.logvar(x))

    def decode(self, x):
        for layer in self.decoder_net:
            x = layer(x)
        return official_rotation(x)


class VPoser1(nn.Module):
    """VPoser 1.0 as published, for its names: a referee."""

    def __init__(self):
        super().__init__()
        self.bodyprior_enc_bn1, self.bodyprior_enc_fc1 = nn.BatchNorm1d(63), nn.Linear(63, 512)
        self.bodyprior_enc_bn2, self.bodyprior_enc_fc2 = nn.BatchNorm1d(512), nn.Linear(512, 512)
        self.bodyprior_enc_mu, self.bodyprior_enc_logvar = nn.Linear(512, 32), nn.Linear(512, 32)
        self.bodyprior_dec_fc1, self.bodyprior_dec_fc2 = nn.Linear(32, 512), nn.Linear(512, 512)
        self.bodyprior_dec_out = nn.Linear(512, 126)

    def encode(self, x):
        x = F.leaky_relu(self.bodyprior_enc_fc1(self.bodyprior_enc_bn1(x)), 0.2)
        x = F.leaky_relu(self.bodyprior_enc_fc2(self.bodyprior_enc_bn2(x)), 0.2)
        return self.bodyprior_enc_mu(x), F.softplus(self.bodyprior_enc_logvar(x))

    def decode(self, z):
        x = F.leaky_relu(self.bodyprior_dec_fc1(z), 0.2)
        return official_rotation(self.bodyprior_dec_out(F.leaky_relu(self.bodyprior_dec_fc2(x), 0.2)))


def official_rotation(x: torch.Tensor) -> torch.Tensor:
    """Gram-Schmidt of numbers laid out as (3, 2): the columns alternate."""
    x = x.reshape(-1, 3, 2)
    first = F.normalize(x[:, :, 0], dim=1)
    second = F.normalize(x[:, :, 1] - (first * x[:, :, 1]).sum(1, keepdim=True) * first, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), -1).reshape(-1, 21, 3, 3)


def trained(kind: type) -> nn.Module:
    """Random weights with running statistics that matter."""
    torch.manual_seed(5)
    referee = kind()
    for module in referee.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.running_mean.normal_(0, 0.3)
            module.running_var.uniform_(0.5, 2.0)
    return referee.eval()


def as_lightning(state: dict) -> dict:
    return {"epoch": 5, "state_dict": {f"vp_model.{n}": x for n, x in state.items()} | {"bm_train.f": torch.ones(2)}}


@pytest.mark.parametrize(("kind", "wrap"), [(VPoser1, dict), (VPoser2, dict), (VPoser2, as_lightning)])
def test_vposer_weights_give_vposers_numbers(tmp_path, kind, wrap, generator):
    referee = trained(kind)
    torch.save(wrap(referee.state_dict()), tmp_path / "snapshot.pt")
    model = pretrained._vposer(tmp_path / "snapshot.pt")
    rot = rotation.exp(0.5 * torch.randn(4, 21, 3, generator=generator))
    latent = model.encode(rot)
    with torch.no_grad():
        mean, deviation = referee.encode(rotation.log(rot).flatten(1))
        assert torch.allclose(latent.mean, mean, atol=1e-5)
        assert torch.allclose((0.5 * latent.log_var).exp(), deviation, atol=1e-5)
        assert torch.allclose(model.decode(mean), referee.decode(mean), atol=1e-5)
    assert not any(p.requires_grad for p in model.parameters())


def test_files_that_are_not_vposers(tmp_path):
    good = trained(VPoser1).state_dict()
    cases = {
        "foreign": {"weight": torch.zeros(3)},
        "narrow": good | {"bodyprior_dec_out.weight": torch.zeros(120, 512)},
        "nan": good | {"bodyprior_enc_mu.bias": torch.full((32,), torch.nan)},
        "object": nn.Linear(2, 2),
    }
    for name, content in cases.items():
        torch.save(content, tmp_path / f"{name}.pt")
        with pytest.raises(DataError, match=name) as caught:
            pretrained._vposer(tmp_path / f"{name}.pt")
        assert caught.value.remedy
    (tmp_path / "text.pt").write_text("hello")
    for name in ("text", "none"):
        with pytest.raises(DataError, match=name):
            pretrained._vposer(tmp_path / f"{name}.pt")


def test_shipped_prior_knows_poses():
    model, rot = pretrained.load_pose_prior("pose_prior_real"), unseen()
    found = recipes.reconstruction(model, rot)
    naive = recipes._joints_of(rot)[:, 1:]
    still = 100 * float((naive - naive.mean(0)).norm(dim=-1).mean())  # the mean pose instead of a prior
    assert found["cm"] < 2 < 0.2 * still
    assert found["degrees"] < 5
    assert found["active"] >= 24
    assert found["kl"] > 10  # the latent carries something


def test_shipped_prior_refuses_what_is_no_pose(generator):
    model, rot = pretrained.load_pose_prior("pose_prior_real"), unseen()
    nonsense = rotation.random((len(rot), 21), generator)
    away = [recipes.reconstruction(model, x)["degrees"] for x in (rot, nonsense)]
    assert away[1] > 5 * away[0]


def _beyond_limits(rot: torch.Tensor) -> torch.Tensor:
    """Degrees beyond the anatomical limits, mean over poses (N, 21, 3, 3) and joints."""
    whole = torch.cat((torch.eye(3).expand(len(rot), 1, 3, 3), rot), 1)
    return torch.stack([*anatomy.excess(STANDARD, whole).values()]).mean()


def test_samples_are_more_human_than_chance(generator):
    drawn = pretrained.load_pose_prior("pose_prior_real").decode(torch.randn(500, 32, generator=generator))
    model = PosePrior().eval().requires_grad_(False)
    spread = pretrained.load_pose_prior("pose_prior_real").encode(unseen()).mean.std(0).mean()
    assert 0.3 < spread < 1.5  # latents of people fill the unit normal that samples are drawn from
    anyhow = rotation.exp(0.35 * torch.randn(500, 21, 3, generator=generator))
    assert _beyond_limits(drawn) < 0.5 * _beyond_limits(anyhow) and _beyond_limits(unseen()) <= _beyond_limits(drawn)
    assert model.decode(torch.zeros(32)).shape == (21, 3, 3)
