"""The rivals: the conditional mean of a Gaussian in closed form, planted neighbours."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import bench, rotation
from motionlab.bench import Rivals
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD

FRAMES = 16


@pytest.fixture(scope="module")
def takes():
    """Training windows and others of the same person, 16 frames each."""
    cut = [
        gather([on_standard(perform_sequence(Corpus(seconds=12.0, seed=seed), 0).motion)], FRAMES).evenly(count)
        for seed, count in ((3, 80), (4, 6))
    ]
    return [replace(m, skeleton=STANDARD) for m in cut]


@pytest.fixture(scope="module")
def fitted(takes):
    return Rivals.fit(takes[0], torch.Generator().manual_seed(0), parts=24)


WAYS = ("nearest", "regression")


@pytest.mark.parametrize("ridge", [0.01, 1.0])
def test_regression_is_the_conditional_mean_of_the_gaussian(fitted, ridge):
    generator = torch.Generator().manual_seed(1)
    mask = torch.rand(fitted.factor.shape[0], generator=generator) < 0.4
    x = torch.randn(2, len(mask), generator=generator)
    z = fitted.explained(x - fitted.mean_row, mask / ridge)
    factor = fitted.factor.double()
    covariance = factor @ factor.mT
    inside = covariance[mask][:, mask] + ridge * torch.eye(int(mask.sum()))
    gain = torch.linalg.solve(inside, covariance[mask][:, ~mask]).mT
    expected = (x - fitted.mean_row).double()[:, mask] @ gain.mT
    assert torch.allclose((z @ fitted.factor.mT)[:, ~mask], expected.float(), atol=2e-4)


def test_draws_spread_as_the_gaussian_does_that_is_left(fitted):
    """The covariance of many draws of what is hidden, against the conditional one in closed form."""
    mask = torch.rand(fitted.factor.shape[0], generator=torch.Generator().manual_seed(1)) < 0.4
    row = fitted.mean_row.expand(20_000, -1)
    z = fitted.explained(row - fitted.mean_row, mask / 1.0, torch.Generator().manual_seed(2)).double()
    factor = fitted.factor.double()
    cut = factor[mask]
    inside = cut @ cut.mT + torch.eye(len(cut), dtype=torch.float64)
    expected = torch.eye(z.shape[1], dtype=torch.float64) - cut.mT @ torch.linalg.solve(inside, cut)
    assert torch.allclose(torch.cov(z.mT), expected, atol=0.05) and z.mean(0).abs().max() < 0.05


def test_the_second_nearest_is_of_another_clip(takes, fitted):
    """Itself, and then the nearest of those that are not of its clip: by a loop over all of them."""
    truth, clips = takes[0].clip(torch.arange(4)), torch.arange(80) // 20
    nothing = torch.zeros(4, FRAMES, 24, dtype=torch.bool)
    nothing[..., 5] = True  # a knee alone: what is made of the rest is the window's that was found
    found = [fitted.nearest(truth, nothing, rank=k, clips=clips) for k in (0, 1)]
    assert (found[0].rot - truth.rot).abs().max() < 1e-3
    knee = takes[0].rot[:, :, 5]
    for w in range(4):
        others = range(20, 80)
        far = [
            float((rotation.matrix_to_sixd(knee[k]) - rotation.matrix_to_sixd(knee[w])).square().sum()) for k in others
        ]
        assert (found[1].rot[w, :, 6:] - takes[0].rot[others[far.index(min(far))], :, 6:]).abs().max() < 1e-3


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("case", "how"), [("legs", ()), ("every_frame", (0.5,)), ("whole_window", (0.5,)), ("gap", (6,)), ("keys", (7,))]
)
def test_what_is_known_stays_and_what_is_hidden_is_never_read(takes, fitted, way, case, how, generator):
    truth, count = takes[1], len(takes[1].root)
    known = getattr(bench, case)(count, FRAMES, *how, *([generator] if 0.5 in how else []))
    made = getattr(fitted, way)(truth, known)
    joints, place = known[..., : bench.JOINTS], known[..., bench.JOINTS]
    assert torch.equal(made.rot[joints], truth.rot[joints]) and torch.equal(made.root[place], truth.root[place])
    joints, place = joints.clone(), place.clone()
    joints[:, 0, 0] = place[:, 0] = True  # the first frame's place and heading are given
    other = takes[0].clip(slice(0, count))
    spoilt = replace(
        truth,
        rot=torch.where(joints[..., None, None], truth.rot, other.rot),
        root=torch.where(place[..., None], truth.root, other.root),
    )
    again = getattr(fitted, way)(spoilt, known)
    assert torch.allclose(again.positions, made.positions, atol=1e-5)
    assert (made.positions - truth.positions).norm(dim=-1).max() > 0.01  # it did have to guess
