from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch

from data_synth import clips
from motionlab.humor import compiled, stages, unknowns
from motionlab.humor.pretrained import load_priors
from studies.official import unknowns as official_unknowns
from studies.shared import profiling, savings
from studies.shared.savings import FAITHFUL, LEAN, Savings
from studies.shared.workload import Part, random_priors, workload

FRAMES = 6
WHOLE = Part(3, FRAMES)


def seed():
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="module")
def work():
    priors = random_priors(seed(), width=32)
    walk = clips.draw(1, seed(), actions=("walk",))[0].motion
    return workload(walk.cut(0, FRAMES), priors, seed(), batch=2)


def terms(work, on, part=WHOLE):
    grown = part.frames == work.frames
    with torch.no_grad():
        return savings.terms(work.problem, work.unknowns(part, on), on, grown=grown)


def apart(found, other):
    assert found.keys() == other.keys()
    return max(((found[n] / other[n]) - 1).abs().max().item() for n in other)


def nodes(work, found):
    return profiling.graph_nodes(sum(found.values()))


@pytest.mark.parametrize("part", [WHOLE, Part(3, 4)], ids=["whole", "short"])
def test_every_rung_and_every_saving_alone_has_the_same_terms(work, part):
    lean = terms(work, LEAN, part)
    single = [replace(FAITHFUL, **{field.name: True}) for field in fields(Savings)]
    for on in [FAITHFUL, *single, *(on for _, on in savings.rungs())]:
        assert apart(terms(work, on, part), lean) < 1e-4, on


def test_a_trained_prior_sees_the_official_heading_and_nothing_else():
    """People turn little between frames, where the acos of a guarded cosine is wrong by a milliradian."""
    walk = clips.draw(1, seed(), actions=("walk",))[0].motion.cut(0, 12)
    trained = workload(walk, load_priors("compact"), seed(), inferred=True).double()
    found = {name: sum(terms(trained, on, Part(3, 12)).values()).item() for name, on in savings.rungs()}
    change = {}
    for (_, before), (name, now) in pairwise(found.items()):
        change[name] = abs(now / before - 1)
    heading = change.pop(savings.NAMES["exact_heading"])
    assert max(change.values()) < 1e-6 and 1e-4 < heading < 0.05
    assert not any(
        weight.requires_grad for weight in load_priors("compact").motion.parameters()
    )  # the shared priors stay frozen


def test_control_another_shape_is_another_energy(work):
    moved = work.unknowns(WHOLE, LEAN)
    with torch.no_grad():
        moved.betas.add_(0.1)
        found = savings.terms(work.problem, moved, LEAN)
    assert apart(found, terms(work, LEAN)) > 1e-3


def test_last_rung_is_what_every_fit_uses_and_the_first_is_the_faithful_mode(work, monkeypatch):
    monkeypatch.setattr(compiled, "FEW", 0)  # in tensors
    for on, form in ((LEAN, unknowns.LEAN), (FAITHFUL, official_unknowns.FAITHFUL)):
        unknown = work.unknowns(WHOLE, on)
        with savings.weights_of(work.problem.priors, on):
            theirs = stages.motion_terms(replace(work.problem, form=form), unknown)
        ours = savings.terms(work.problem, unknown, on)
        assert apart(ours, theirs) < 1e-6
        assert abs(nodes(work, ours) - nodes(work, theirs)) <= 0.01 * nodes(work, theirs)


@pytest.mark.parametrize("on", [FAITHFUL, LEAN], ids=["faithful", "lean"])
def test_closure_leaves_gradients_and_only_of_what_moves(work, on):
    unknown = work.unknowns(Part(3, FRAMES, first_fixed=True), on)
    value = savings.closure(work.problem, unknown, on)
    assert value.shape == (2,) and not value.requires_grad
    for name, x in unknown.named().items():
        assert (x.grad is None) == (name in unknowns.FIRST), name
        assert x.grad is None or x.grad.isfinite().all()
    weight = work.problem.priors.motion.decoder.net[0].weight
    with savings.weights_of(work.problem.priors, on):
        sum(savings.terms(work.problem, unknown, on).values()).sum().backward()
        assert (weight.grad is None) == on.frozen
    assert not weight.requires_grad and weight.grad is None


def test_gradients_agree_from_end_to_end(work):
    slopes = []
    for on in (FAITHFUL, LEAN):
        unknown = work.unknowns(WHOLE, on)
        savings.closure(work.problem, unknown, on)
        slopes.append(unknown.z.grad)
    assert ((slopes[0] - slopes[1]).norm() / slopes[1].norm()) < 0.02


def test_weights_that_are_trained_get_their_gradients(work):
    """Compiled loops have none to give."""
    decoder = work.problem.priors.motion.decoder
    decoder.requires_grad_(True)
    try:
        energy = sum(stages.motion_terms(work.problem, work.unknowns(WHOLE, LEAN)).values()).sum()
        (slope,) = torch.autograd.grad(energy, decoder.net[-1].weight)
    finally:
        decoder.requires_grad_(False)
    assert slope.isfinite().all() and slope.abs().max() > 0


@pytest.mark.parametrize("leak", [False, True], ids=["as it is", "control: leaked"])
def test_a_fit_takes_the_same_path_before_and_after_every_rung(work, leak):
    """On the same priors: the same energies to the bit, and as many steps for autograd, a closure's price."""
    priors, unknown = work.problem.priors, work.moving.detached()

    def fitted():
        point = unknown.map(lambda x: x.clone().requires_grad_())
        energy = sum(stages.motion_terms(work.problem, point).values())
        _, fits = stages.stage_3(work.problem, unknown, steps=1, inner=3, short=FRAMES, refine=(1, 1))
        return fits[0].history, profiling.graph_nodes(energy.sum())

    before = fitted()
    for _, on in savings.rungs():
        savings.closure(work.problem, work.unknowns(WHOLE, on), on)
        savings.chain_alone(work.problem, work.unknowns(WHOLE, on), on)()
        work.closure(Part(2, FRAMES), on)()
    try:
        priors.motion.requires_grad_(leak)
        after = fitted()
    finally:
        for weight in priors.motion.parameters():
            weight.requires_grad_(False).grad = None
    assert (after[1] == before[1]) != leak
    assert torch.equal(after[0], before[0]) or leak
