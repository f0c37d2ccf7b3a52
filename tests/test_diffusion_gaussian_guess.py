"""What a Gaussian says of a pose: against dense algebra, and handles by the exact kinematics."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.diffusion import denoiser, gaussian_guess, masks, training
from motionlab.diffusion.losses import LossWeights
from motionlab.diffusion.model import DenoiserRecipe, load_denoiser, save_denoiser, silenced
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.heading import stuck_root
from motionlab.skeleton import STANDARD
from studies.nb14_completion import trials

POSES = DenoiserRecipe(
    size="tiny", frames=1, contacts=False, linear=True, handles=8, dropout=0.0, noising=100, steps=4, batch=8,
    weights=LossWeights(velocity=0.0, handles=1.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def windows():
    clips = scenes.held_out(8)
    return gather([on_standard(replace(clips.clip(i), contacts=None)) for i in range(8)], 1, mirrored=False)


@pytest.fixture(scope="module")
def model(windows):
    """As it starts, its network silenced: the Gaussian alone."""
    with pytest.MonkeyPatch.context() as m:
        m.setitem(denoiser.SIZES, "tiny", {"size": 16, "layers": 1, "heads": 2, "hidden": 16})
        made = training.DenoiserTraining(POSES, windows).averaged
    for value in made.denoiser.network.output_process.parameters():
        value.zero_()
    return made


@pytest.fixture(scope="module")
def truth(windows):
    return stuck_root(replace(windows.evenly(12), skeleton=STANDARD))[0]


@pytest.fixture(scope="module")
def joint(windows, model):
    """Mean and covariance, float64, of pose numbers and joints together, as it was measured."""
    some = windows.draw(training._MEASURED, torch.Generator().manual_seed(0))
    x, joints = model.encode(some)[:, 0], stuck_root(some)[0].positions[:, 0].flatten(1)
    both = torch.cat((x, joints), -1).double()
    return both.mean(0), torch.cov(both.mT, correction=0)


def noisy(model, truth, t):
    x0 = model.encode(truth)
    steps = torch.full((len(x0),), t)
    return model.schedule.noised(x0, steps, torch.randn(x0.shape, generator=torch.Generator().manual_seed(1))), steps


@pytest.mark.parametrize("t", [3, 40, 98])
@pytest.mark.parametrize("names", [(), ("left_wrist",), ("head", "left_foot", "right_wrist")])
def test_the_start_is_the_gaussian_s_conditional_mean(model, truth, joint, monkeypatch, t, names):
    """By dense algebra on the joint covariance: what x_t and the handles' places say of the pose."""
    monkeypatch.setattr(gaussian_guess, "_ROUNDS", 0)
    which = trials.chosen_handles(names, len(truth.root), torch.Generator().manual_seed(0))
    places = truth.positions[:, 0]
    xt, steps = noisy(model, truth, t)
    found = model.denoiser(xt, steps, handles=masks.told(places, which)[:, None])[:, 0].double()
    mean, cov = joint
    size, a = model.layout.size, model.schedule.alpha_bar[t]
    rows = [*range(size), *(size + 3 * STANDARD.index(n) + k for n in names for k in range(3))]
    see = torch.eye(len(mean)).double()[rows]
    see[:size] *= a.sqrt()
    noise = torch.cat(((1 - a).expand(size), torch.full((3 * len(names),), gaussian_guess._CLOSE)))
    seen = torch.cat((xt[:, 0], places[:, STANDARD.indices(list(names))].flatten(1)), -1).double()
    gain = cov @ see.mT @ torch.linalg.inv(see @ cov @ see.mT + torch.diag(noise))
    expected = mean + (seen - mean @ see.mT) @ gain.mT
    assert (found - expected[:, :size]).abs().max() < 5e-3 * expected[:, :size].abs().max()


def test_steps_by_the_exact_kinematics_bring_handles_nearer(model, truth, monkeypatch):
    which = trials.chosen_handles(trials.SETS["five effectors"], len(truth.root), torch.Generator().manual_seed(0))
    places, (xt, steps) = truth.positions[:, 0], noisy(model, truth, 98)
    told, far = masks.told(places, which)[:, None], []
    for rounds in (0, 1, 4, 30):
        monkeypatch.setattr(gaussian_guess, "_ROUNDS", rounds)
        made = model.decode(model.denoiser(xt, steps, handles=told)).positions[:, 0]
        far.append((made - places).norm(dim=-1)[which].mean().item())
    assert far[1] < far[0] and far[2] < 0.8 * far[0] and far[3] < 0.6 * far[0]
    silent = model.decode(model.denoiser(xt, steps)).positions[:, 0]
    assert (silent - places).norm(dim=-1)[which].mean() > 2 * far[0]  # control


def test_poses_without_handles_among_others_stay(model, truth):
    places, (xt, steps) = truth.positions[:, 0], noisy(model, truth, 60)
    which = trials.chosen_handles(4, len(truth.root), torch.Generator().manual_seed(0))
    which[::2] = False
    mixed = model.denoiser(xt, steps, handles=masks.told(places, which)[:, None])
    none = model.denoiser(xt, steps)
    assert (mixed - none)[::2].abs().max() < 1e-5 and (mixed - none)[1::2].abs().amax((1, 2)).min() > 1e-2
    which[::2, 3] = True  # a row's estimate is its own, whatever the others hold
    alone = model.denoiser(xt[1:2], steps[1:2], handles=masks.told(places, which)[1:2, None])
    assert (mixed[1:2] - alone).abs().max() < 1e-3


def test_the_network_corrects_what_noise_leaves_open(model, truth):
    with torch.no_grad():
        loud = training.deepcopy(model.denoiser)
        loud.network.output_process.poseFinal.bias.fill_(1.0)
    change = []
    for t in (2, 50, 99):
        xt, steps = noisy(model, truth, t)
        change.append((loud(xt, steps) - model.denoiser(xt, steps)).square().sum(-1).mean().item())
        a = model.schedule.alpha_bar[t].float()
        left = (1 - a) * loud.power / (a * loud.power + 1 - a)
        assert change[-1] == pytest.approx(left.sum().item(), rel=1e-3)
    assert change[0] < 0.1 * change[1] < 0.1 * change[2]


def test_recalled_poses_are_a_mixture_s_conditional_mean(windows, truth, monkeypatch):
    """By Bayes' rule, one component at a time: poses z_i, a Gaussian about each, seen through noise; and handles."""
    monkeypatch.setattr(gaussian_guess, "_ROUNDS", 0)
    monkeypatch.setitem(denoiser.SIZES, "tiny", {"size": 16, "layers": 1, "heads": 2, "hidden": 16})
    model = training.DenoiserTraining(replace(POSES, recalls=200), windows).averaged
    told = model.denoiser
    xt, steps = noisy(model, truth, 40)
    a, at = model.schedule.alpha_bar[40], (xt[:, 0] @ told.basis).double()
    codes, power = told.codes.double(), gaussian_guess._NEAR * told.power.double()
    seen = a * power + 1 - a
    odds = torch.stack([-((at - a.sqrt() * z) ** 2 / seen).sum(-1) / 2 for z in codes], -1)
    each = torch.stack([(a.sqrt() * power * at + (1 - a) * z) / seen for z in codes], 1)

    def mean(odds):
        return (odds.softmax(-1)[..., None] * each).sum(1) @ told.basis.double().mT

    assert (model.denoiser(xt, steps)[:, 0] - mean(odds)).abs().max() < 1e-3
    mine = windows.drawn(max(training._MEASURED, 200), torch.Generator().manual_seed(1))[1][:200]
    assert torch.equal(told.clips.long(), mine)
    other = torch.where(told.clips == 3, -torch.inf, odds)
    own = torch.full((len(xt),), 3)
    assert (model.denoiser(xt, steps, own=own)[:, 0] - mean(other)).abs().max() < 1e-3
    assert (mean(odds) - mean(other)).abs().max() > 1e-2  # control
    which = trials.chosen_handles(("head", "left_foot"), len(truth.root), torch.Generator().manual_seed(0))
    places = truth.positions[:, 0]
    far = (which[:, None, :, None] * (places[:, None] - told.joints.float().unflatten(-1, (-1, 3)))).square()
    far = far.sum((-1, -2)).double()
    width = gaussian_guess._FIRM + gaussian_guess._LOOSE * far.amin(-1, keepdim=True) / 6
    handed = told._recalled(at.float(), a.float(), power.float(), masks.told(places, which)[:, None], None)
    by_hand = (odds - far / (2 * width)).softmax(-1) @ codes
    assert (handed - by_hand).abs().max() < 1e-3
    theirs = told.clips[far.argmin(-1)]  # left out, the nearest says nothing of how wide to look, either
    others = far.masked_fill(told.clips == theirs[:, None], torch.inf)
    width = gaussian_guess._FIRM + gaussian_guess._LOOSE * others.amin(-1, keepdim=True) / 6
    handed = told._recalled(at.float(), a.float(), power.float(), masks.told(places, which)[:, None], theirs)
    by_hand = (odds - others / (2 * width)).softmax(-1) @ codes
    assert (handed - by_hand).abs().max() < 1e-3


def test_a_start_needs_as_many_poses_as_it_recalls(model):
    with pytest.raises(ShapeError, match="expected 9 poses or more, got 8"):
        made = gaussian_guess.Linear(model.denoiser.network, model.schedule.alpha_bar, model.layout, 9)
        made.recall(torch.zeros(8, 1, model.layout.size), torch.zeros(8))


def test_data_stays_whole_on_disk(model, tmp_path, monkeypatch):
    monkeypatch.setitem(denoiser.SIZES, "tiny", {"size": 16, "layers": 1, "heads": 2, "hidden": 16})
    save_denoiser(tmp_path / "m", model, {}, half=True)
    again = load_denoiser(tmp_path / "m")
    assert all(torch.equal(value, getattr(again.denoiser, name)) for name, value in model.denoiser.named_buffers()
               if "." not in name)  # fmt: skip


def test_only_single_poses(model):
    with pytest.raises(ShapeError, match="single poses"):
        model.denoiser(torch.zeros(2, 3, model.layout.size), torch.tensor([1, 2]))
    for wrong in (replace(POSES, frames=60, size="small"), replace(POSES, told=True, size="small")):
        with pytest.raises(ValueError, match="single poses"):
            wrong.denoiser()


def test_silenced_it_is_its_start(model, truth):
    loud = training.deepcopy(model.denoiser)
    loud.network.output_process.poseFinal.bias.fill_(1.0)
    xt, steps = noisy(model, truth, 40)
    which = trials.chosen_handles(("head",), len(truth.root), torch.Generator().manual_seed(0))
    told = masks.told(truth.positions[:, 0], which)[:, None]
    start = silenced(replace(model, denoiser=loud)).denoiser(xt, steps, handles=told)
    assert torch.equal(start, model.denoiser(xt, steps, handles=told))
    assert (start - loud(xt, steps, handles=told)).abs().max() > 1e-2
    with pytest.raises(ShapeError, match="spectral"):
        silenced(replace(model, denoiser=loud.network))  # nothing but a network
