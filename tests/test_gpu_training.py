"""The steps of tests/bench/gpu: their losses, windows and masks beside the library's."""

import math
from dataclasses import replace

import pytest
import torch

from motionlab import checkpoint
from motionlab.diffusion import features
from motionlab.diffusion.completer import Completer, CompleterRecipe
from motionlab.diffusion.features import Layout, Normaliser, units
from motionlab.diffusion.model import LOSS_WEIGHTS
from motionlab.diffusion.windows import draw_units, gather, on_standard
from motionlab.heading import stuck_root
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD
from motionlab.training.completer_training import _WEIGHTS, losses
from motionlab.training.denoiser_training import denoising_losses
from tests.bench.gpu import steps, train

ODDS = torch.tensor([0.05, 0.15, 0.3, 0.45, 0.6, 0.75, 0.85])
COUNT = 24


@pytest.fixture(scope="module")
def k():
    return steps.Constants(torch.device("cpu"))


@pytest.fixture(scope="module")
def windows(motions):
    lacks = [("spine2",) if n % 3 == 0 else () for n in range(len(motions))]
    people = [str(n % 2) for n in range(len(motions))]
    return gather([on_standard(m) for m in motions], steps.T, missing=lacks, people=people)


@pytest.fixture(scope="module")
def data(windows):
    w = windows
    return steps.Data(w.root, w.rot, w.contacts, w.clip, w.seen, w.people)


@pytest.fixture(scope="module")
def table(k):
    return steps.Masks(k, pool=20)


@pytest.fixture(scope="module")
def batch(data, table, k):
    return steps.drawn(COUNT, data, table, ODDS, None, k, torch.Generator().manual_seed(0))


def motion(batch) -> Motion:
    return Motion(STANDARD, batch[0], batch[1], 30.0, batch[2])


def model(noised: bool, of: Motion) -> Completer:
    torch.manual_seed(0)
    made = Completer(CompleterRecipe(size=64, layers=1, diffusion=noised))
    torch.nn.init.normal_(made.said.weight, std=0.02)
    mean, scale = features.sizes(features.states(of))
    made.mean.copy_(mean), made.scale.copy_(scale)
    return made


@pytest.mark.parametrize("noised", [False, True])
def test_the_completers_loss_is_the_librarys(noised, batch, k):
    some, known, weights, _ = batch
    truth, draws = motion(some), torch.Generator().manual_seed(1)
    net = model(noised, truth)
    angle, noise = (
        torch.rand(COUNT, generator=draws) * math.pi / 2,
        torch.randn(COUNT, steps.T, features.MADE, generator=draws),
    )
    told = (angle, noise) if noised else ()
    made = net.filled(truth, known, *told)
    parts = losses(made, truth, known, some[3], net.sizes[1], squared=noised)
    expected = sum(_WEIGHTS[name] * part for name, part in parts.items())
    units = net.sizes
    assert torch.allclose(steps.completer_loss(net, some, known, weights, units, told or None, k), expected, rtol=1e-5)
    other = steps.completer_loss(net, some, known.roll(1, 0), weights, units, told or None, k)
    assert not torch.allclose(other, expected, rtol=1e-2)  # control


def test_the_plain_loss_is_the_librarys(batch, k):
    some, layout = batch[0], Layout()
    rows = layout.encode(motion(some))
    normaliser = Normaliser.measure(rows, layout)
    truth, seen = normaliser.apply(rows), some[3][:, units(layout)]
    said = truth + 0.1 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(2))
    names = ("simple", "velocity", "fk", "contact")
    parts = denoising_losses(said, truth, layout, normaliser, STANDARD.offsets[None], parts=names, seen=seen)
    expected = sum(LOSS_WEIGHTS[name] * part for name, part in parts.items())
    made = steps.plain_loss(said, truth, normaliser.mean, normaliser.scale, LOSS_WEIGHTS, seen, k)
    assert torch.allclose(made, expected, rtol=1e-5)
    other = steps.plain_loss(said, truth, normaliser.mean, normaliser.scale, LOSS_WEIGHTS, torch.zeros_like(seen), k)
    assert not torch.allclose(other, expected, rtol=1e-1)  # control: nothing was recorded


def test_windows_are_the_librarys_or_their_mirror_image(windows, data, k):
    """Contacts tell which: a window's own, or of the other side's joints."""
    every = replace(windows, mirrored=False)
    own, whose = stuck_root(every._cut(every.begins))[0], every.clip[every.begins]
    other = stuck_root(mirror(every._cut(every.begins)))[0]
    root, rot, contacts, seen = data.draw(40, k, torch.Generator().manual_seed(5))
    sides = set()
    for n in range(40):
        far = [(m.rot - rot[n]).abs().amax((1, 2, 3, 4)) for m in (own, other)]
        side = int(far[1].min() < far[0].min())
        found, at = ((own, other)[side], int(far[side].argmin()))
        sides.add(side)
        assert far[side][at] < 1e-5 and (found.root[at] - root[n]).abs().max() < 1e-5
        assert torch.equal(found.contacts[at], contacts[n]) and torch.equal(windows.seen[whose[at]], seen[n, :22])
    assert sides == {0, 1}


@pytest.mark.parametrize("kind", steps.ORDER)
def test_masks_are_as_the_library_draws_them(kind, table, k):
    """As much is known on average, of joints and of contacts. Entries differ and say so."""
    at = steps.ORDER.index(kind)
    odds, draws = torch.tensor([0.0] * at + [1.0] * (7 - at)), torch.Generator().manual_seed(4)
    mine = table.draw(3000, k, draws, odds)[0].float()
    theirs = draw_units(steps.T, 1500, draws, {kind: 1.0}).float()
    more = 0.25 if kind == "entries" else 0.0  # all but those that are missing in the same frames
    assert abs(mine[..., :-1].mean() - theirs[..., :-1].mean() - more) < 0.03
    assert abs(mine[..., -1].mean() - theirs[..., -1].mean()) < 0.03


def test_a_run_of_a_completer_begins(data, table, k):
    recipe = checkpoint.read_recipe(checkpoint.SHIPPED / "completer.json")["recipe"]
    mean, scale = train.Run("completer", {"recipe": recipe}, k, data, table).units
    assert mean.isfinite().all() and (scale > 0).all()
