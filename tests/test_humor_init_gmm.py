"""The mixture over first states: golden values, sampling and refitting, files that are none."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from motionlab import rotation
from motionlab.errors import DataError, ShapeError
from motionlab.heading import heading_frame
from motionlab.humor import pretrained, priors, state
from motionlab.humor.priors import InitGmm
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from motionlab.training import recipes
from tests.rolled_inputs import golden_mixture


def small(generator: torch.Generator, components: int = 3, size: int = 4) -> InitGmm:
    factor = torch.randn(components, size, size, generator=generator, dtype=torch.float64)
    weights = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)[:components]
    means = 6 * torch.randn(components, size, generator=generator, dtype=torch.float64)
    return InitGmm(weights / weights.sum(), means, factor @ factor.mT + 0.1 * torch.eye(size))


def draw(gmm: InitGmm, count: int, generator: torch.Generator) -> torch.Tensor:
    which = torch.multinomial(gmm.weights, count, replacement=True, generator=generator)
    noise = torch.randn(count, gmm.means.shape[1], 1, generator=generator, dtype=torch.float64)
    return gmm.means[which] + (torch.linalg.cholesky(gmm.covariances)[which] @ noise)[..., 0]


def test_log_prob_is_scipys(generator):
    from scipy.stats import multivariate_normal

    gmm = small(generator)
    x = draw(gmm, 20, generator)
    parts = zip(*(value.numpy() for value in gmm.tensors().values()), strict=True)
    each = [weight * multivariate_normal(mean, covariance).pdf(x.numpy()) for weight, mean, covariance in parts]
    assert np.allclose(gmm.log_prob(x).numpy(), np.log(np.sum(each, 0)), rtol=1e-9)
    assert gmm.log_prob(x.reshape(4, 5, 4)).shape == (4, 5)


def test_far_away_is_a_number(generator):
    far = small(generator).log_prob(torch.full((2, 4), 1e6))
    assert far.isfinite().all() and (far < -1e6).all()


def test_fit_finds_the_mixture_that_made_the_samples(generator):
    truth = small(generator)
    train, held = draw(truth, 4000, generator), draw(truth, 4000, generator)
    found, history = recipes.fit_mixture(train, generator, components=3, ridge=1e-6)
    single, _ = recipes.fit_mixture(train, generator, components=1, ridge=1e-6)
    best, ours, alone = (float(g.log_prob(held).mean()) for g in (truth, found, single))
    assert abs(best - ours) < 0.05
    assert alone < ours - 0.3
    assert all(b >= a - 1e-6 for a, b in pairwise(history))  # EM never falls
    again, _ = recipes.fit_mixture(train, torch.Generator().manual_seed(1), components=1, ridge=1e-6)
    assert torch.allclose(again.means, train.mean(0, keepdim=True))


def test_features_are_the_named_parts(generator):
    rot = rotation.random((5, 22), generator)
    motion = Motion(STANDARD, torch.randn(5, 3, generator=generator), rot, 30.0)
    world = state.from_motion(motion)
    local = state.localise(world, heading_frame(motion.root, motion.rot[:, 0]))
    parts = state.unpack(local)
    found = priors.first_state_features(local)
    positions = (parts["joints"].flatten(1), parts["joints_vel"].flatten(1))
    assert torch.equal(found, torch.cat((*positions, parts["trans_vel"], parts["root_orient_vel"]), 1))
    assert found.shape == (5, priors.FIRST_STATE_SIZE) == (5, 138)


def test_official_file(tmp_path):
    gmm = golden_mixture()
    path = tmp_path / "prior_gmm.npz"
    np.savez(path, **{name: value.numpy() for name, value in gmm.tensors().items()})
    x = torch.zeros(1, 138, dtype=torch.float64)
    assert torch.allclose(pretrained._official_mixture(path, (0.0, 0.0, 0.0)).log_prob(x), gmm.log_prob(x))


def spoilt(name: str, change) -> dict[str, np.ndarray]:
    arrays = {key: value.numpy() for key, value in golden_mixture().tensors().items()}
    return arrays | {name: change(arrays[name])}


@pytest.mark.parametrize(
    "arrays",
    [
        {"weights": np.ones(1)},
        spoilt("means", lambda m: m[:, :137]),
        spoilt("means", lambda m: np.where(np.arange(138) == 3, np.nan, m)),
        spoilt("covariances", lambda c: c - 5 * np.eye(138)),
        spoilt("covariances", lambda c: np.triu(c)),
        spoilt("weights", lambda w: w * 2),
    ],
    ids=["missing", "shape", "nan", "not positive", "not symmetric", "weights"],
)
def test_files_that_hold_no_mixture_are_refused(tmp_path, arrays):
    path = tmp_path / "prior_gmm.npz"
    np.savez(path, **arrays)
    with pytest.raises(DataError, match="prior_gmm") as caught:
        pretrained._official_mixture(path, (0.0, 0.0, 0.0))
    assert caught.value.remedy


def test_no_file_and_no_archive(tmp_path):
    with pytest.raises(DataError, match="none"):
        pretrained._official_mixture(tmp_path / "none.npz", (0.0, 0.0, 0.0))
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(DataError, match="archive"):
        pretrained._official_mixture(tmp_path / "text.npz", (0.0, 0.0, 0.0))


def test_too_few_samples_and_wrong_width(generator):
    with pytest.raises(DataError, match="samples"):
        recipes.fit_mixture(torch.randn(5, 9, generator=generator), generator)
    with pytest.raises(ShapeError):
        golden_mixture().log_prob(torch.zeros(2, 137))
