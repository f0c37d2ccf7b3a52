"""The roll-out that steers itself: against the plain one, a naive loop and differences; no clip sees another.

Everything twice: as compiled loops, and as tensors.
"""

import pytest
import torch

from motionlab import rotation
from motionlab.commands import doctor
from motionlab.humor import compiled, state
from motionlab.humor.rollout import rollout, steered_rollout
from tests.draws import draw
from tests.rolled_inputs import F64, first_states, network

CLIPS, STEPS = 2, 5


@pytest.fixture(autouse=True, params=["loops", "tensors"])
def chain(request, monkeypatch):
    monkeypatch.setattr(compiled, "WIDE", 256 if request.param == "loops" else 0)
    return request.param


@pytest.fixture(scope="module", params=[False, True], ids=["official", "with a skip"])
def model(request):
    return network(skip=request.param)


@pytest.fixture(scope="module")
def first():
    return first_states(torch.Generator().manual_seed(0), CLIPS)


@pytest.fixture(scope="module")
def u():
    return 0.5 * draw(1, CLIPS, STEPS, 48)


@pytest.fixture(scope="module")
def gains():
    return 0.02 * draw(2, CLIPS, STEPS, 48, compiled.PLACED)


def naive(model, first, u, gains):
    """Transition by transition in the world, every frame's place read off its own heading."""
    world, found = first, []
    for now, gain in zip(u.unbind(1), gains.unbind(1), strict=True):
        frame = state.heading(world)
        past = state.localise(world, frame)
        place = torch.cat((frame.turn.mT[:, :2, :2], -frame.shift[:, :2, None]), -1)  # own = turn (world + shift)
        inputs = torch.cat((past, place.flatten(1)), -1)  # cos, -sin, x, sin, cos, y
        z = now + (gain @ inputs[..., None])[..., 0]
        after, logits = state.apply(past, model.decode(past, z))
        world = state.globalise(after, frame)
        found.append((world, logits, z, *model.prior(past), inputs))
    return [torch.stack(each, 1) for each in zip(*found, strict=True)]


def parts(found):
    rolled, inputs = found
    return [rolled.states, rolled.contact_logits, rolled.z, *rolled.prior, inputs]


def loss(found):
    """A function of everything that comes out."""
    return sum((value * draw(10 + k, *value.shape) + 0.05 * value.square()).sum() for k, value in enumerate(found))


def on_manifold(first, change):
    """First states (B, 339) after changes (B, 207): 141 numbers that are added to, and 22 turns."""
    each, turns = state.unpack(first), rotation.exp(change[:, 141:].unflatten(1, (22, 3)))
    rot = turns @ torch.cat((each["root_orient"][:, None], each["pose_body"]), 1)
    names = ("trans", "trans_vel", "root_orient_vel", "joints", "joints_vel")
    added = change[:, :141].split([each[n][0].numel() for n in names], 1)
    moved = {n: each[n] + way.view_as(each[n]) for n, way in zip(names, added, strict=True)}
    return state.pack(moved | {"root_orient": rot[:, 0], "pose_body": rot[:, 1:]})


@pytest.mark.parametrize("steps", [1, STEPS])
def test_values_and_gradients_are_those_of_a_naive_loop(model, first, u, gains, steps):
    u, gains, found = u[:, :steps], gains[:, :steps], []
    for way in (lambda *each: parts(steered_rollout(model, *each)), lambda *each: naive(model, *each)):
        leaves = [x.clone().requires_grad_() for x in (torch.zeros(CLIPS, 207, dtype=F64), u)]
        values = way(on_manifold(first, leaves[0]), leaves[1], gains)
        found.append([*values, *torch.autograd.grad(loss(values), leaves)])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-9, rtol=1e-9)


def test_control_a_gain_that_the_way_back_forgets_is_noticed(model, first, u, gains):
    """The gradient of u where z is taken as given differs: what is steered comes back through the gains."""
    leaf = u.clone().requires_grad_()
    found, _ = steered_rollout(model, first, leaf, gains)
    (ours,) = torch.autograd.grad((found.states * draw(3, *found.states.shape)).sum(), leaf)
    z = found.z.detach().clone().requires_grad_()
    (given,) = torch.autograd.grad((rollout(model, first, z).states * draw(3, *found.states.shape)).sum(), z)
    assert (ours[:, -1] - given[:, -1]).abs().max() < 1e-9 and (ours - given)[:, 0].abs().max() > 0.01


def test_control_the_order_of_what_gains_see_matters(model, first, u, gains):
    """Sine in the place of minus the sine, or y before x, and the naive loop is another."""
    good = naive(model, first, u, gains)[0]
    torch.testing.assert_close(steered_rollout(model, first, u, gains)[0].states, good, atol=1e-9, rtol=0)
    for swap in ([0, 3, 2, 1, 4, 5], [0, 1, 5, 3, 4, 2]):
        wrong = torch.cat((gains[..., : state.STATE], gains[..., state.STATE :][..., swap]), -1)
        assert (steered_rollout(model, first, u, wrong)[0].states - good).abs().max() > 1e-3


def test_no_gains_are_gains_of_nought(model, first, u):
    leaves = [x.clone().requires_grad_() for x in (u, u)]
    nought = torch.zeros(CLIPS, STEPS, 48, compiled.PLACED, dtype=F64)
    found = [parts(steered_rollout(model, first, *how)) for how in ((leaves[0],), (leaves[1], nought))]
    slopes = [torch.autograd.grad(loss(x), leaf)[0] for x, leaf in zip(found, leaves, strict=True)]
    for ours, theirs in zip([*found[0], slopes[0]], [*found[1], slopes[1]], strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=1e-12)


def test_doctor_compiles_what_a_fit_needs(first, u, gains, monkeypatch):
    """Afterwards a roll-out of float32 numbers, with gains and without, compiles nothing more."""
    monkeypatch.setattr(compiled, "WIDE", 256)
    doctor._compile_loops()
    kinds = [list(loop.signatures) for loop in (compiled._onward, compiled._back)]
    net = network().float()
    for each in (gains.float(), None):
        leaf = u.float().requires_grad_()
        steered_rollout(net, first.float(), leaf, each)[0].states.sum().backward()
    assert kinds[0] and kinds == [list(loop.signatures) for loop in (compiled._onward, compiled._back)]


def test_what_no_loop_takes_goes_as_tensors(first, u, monkeypatch):
    """Half precision and mixed precision have no loops."""
    monkeypatch.setattr(compiled, "WIDE", 256)
    assert compiled.fits(first, u) and not compiled.fits(first.half(), u.half())
    assert not compiled.fits(first, u.float()) and not compiled.fits(first.to("meta"), u.to("meta"))
