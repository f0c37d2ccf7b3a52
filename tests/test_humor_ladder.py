from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch

from data_synth import clips
from motionlab import profiling
from motionlab.errors import DataError
from motionlab.humor import compiled, faithful_variables, ladder, program, stages, variables
from motionlab.humor.ladder import FAITHFUL, LEAN, Savings
from motionlab.humor.priors import load
from motionlab.humor.testops import Schedule
from motionlab.humor.workload import Part, random_priors, workload

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
        return ladder.terms(work.problem, work.unknowns(part, on), on, grown=grown)


def apart(found, other):
    assert found.keys() == other.keys()
    return max(((found[n] / other[n]) - 1).abs().max().item() for n in other)


def nodes(work, found):
    return profiling.graph_nodes(sum(found.values()))


@pytest.mark.parametrize("part", [WHOLE, Part(3, 4)], ids=["whole", "short"])
def test_every_rung_and_every_saving_alone_has_the_same_terms(work, part):
    lean = terms(work, LEAN, part)
    single = [replace(FAITHFUL, **{field.name: True}) for field in fields(Savings)]
    for on in [FAITHFUL, *single, *(on for _, on in ladder.rungs())]:
        assert apart(terms(work, on, part), lean) < 1e-4, on


def test_a_trained_prior_sees_the_official_heading_and_nothing_else():
    """People turn little between frames, where the acos of a guarded cosine is wrong by a milliradian."""
    walk = clips.draw(1, seed(), actions=("walk",))[0].motion.cut(0, 12)
    trained = workload(walk, load(), seed(), inferred=True).double()
    found = {name: sum(terms(trained, on, Part(3, 12)).values()).item() for name, on in ladder.rungs()}
    change = {}
    for (_, before), (name, now) in pairwise(found.items()):
        change[name] = abs(now / before - 1)
    heading = change.pop(ladder.NAMES["exact_heading"])
    assert max(change.values()) < 1e-6 and 1e-4 < heading < 0.05
    assert not any(weight.requires_grad for weight in load().motion.parameters())  # the shared priors stay frozen


def test_control_another_shape_is_another_energy(work):
    moved = work.unknowns(WHOLE, LEAN)
    with torch.no_grad():
        moved["betas"] += 0.1
        found = ladder.terms(work.problem, moved, LEAN)
    assert apart(found, terms(work, LEAN)) > 1e-3


def test_last_rung_is_what_every_fit_uses_and_the_first_is_the_faithful_mode(work, monkeypatch):
    monkeypatch.setattr(compiled, "FEW", 0)  # in tensors
    for on, mode in ((LEAN, "lean"), (FAITHFUL, "faithful")):
        unknown = work.unknowns(WHOLE, on)
        work.problem.priors.motion.requires_grad_(not on.frozen)
        work.problem.priors.pose.requires_grad_(not on.frozen)
        theirs = stages.motion_terms(replace(work.problem, mode=mode), unknown)
        ours = ladder.terms(work.problem, unknown, on)
        assert apart(ours, theirs) < 1e-6
        assert abs(nodes(work, ours) - nodes(work, theirs)) <= 0.01 * nodes(work, theirs)


def test_ladder_climbs_from_none_to_all_one_at_a_time():
    rungs = dict(ladder.rungs())
    counts = [sum(getattr(on, field.name) for field in fields(Savings)) for on in rungs.values()]
    assert counts == list(range(len(ladder.NAMES) + 1))
    assert next(iter(rungs.values())) == FAITHFUL and list(rungs.values())[-1] == LEAN


def test_savings_save_autograd_nodes_and_bodies(work, monkeypatch):
    def count(on):
        return nodes(work, ladder.terms(work.problem, work.unknowns(WHOLE, on), on))

    assert count(LEAN) < count(replace(LEAN, lean_layout=False)) < count(FAITHFUL)
    assert count(replace(FAITHFUL, frozen=True)) < count(FAITHFUL)
    calls = []
    skin = ladder.body_joints_by_lbs
    spy = lambda root, aa, betas: calls.append(root.shape[1]) or skin(root, aa, betas)  # noqa: E731
    monkeypatch.setattr(ladder, "body_joints_by_lbs", spy)
    monkeypatch.setattr("motionlab.humor.faithful_body.body_joints_by_lbs", spy)
    for part in (WHOLE, Part(3, 4)):  # the official body layer is always asked for the whole clip
        terms(work, FAITHFUL, part)
        assert calls == [FRAMES] * (faithful_variables.FIRST_FRAME_CALLS + 2)
        calls.clear()
    terms(work, replace(FAITHFUL, needed_frames=True))
    assert calls == [1, FRAMES]


@pytest.mark.parametrize("on", [FAITHFUL, LEAN], ids=["faithful", "lean"])
def test_closure_leaves_gradients_and_only_of_what_moves(work, on):
    unknown = work.unknowns(Part(3, FRAMES, first_fixed=True), on)
    value = ladder.closure(work.problem, unknown, on)
    assert value.shape == (2,) and not value.requires_grad
    for name, x in unknown.items():
        assert (x.grad is None) == (name in stages.FIRST), name
        assert x.grad is None or x.grad.isfinite().all()
    weight = next(work.problem.priors.motion.parameters())
    assert weight.requires_grad == (not on.frozen)


def test_gradients_agree_from_end_to_end(work):
    slopes = []
    for on in (FAITHFUL, LEAN):
        unknown = work.unknowns(WHOLE, on)
        ladder.closure(work.problem, unknown, on)
        slopes.append(unknown["z"].grad)
    assert ((slopes[0] - slopes[1]).norm() / slopes[1].norm()) < 0.02


def test_parts_are_marked_side_by_side(work):
    watch = profiling.Stopwatch()
    work.closure(WHOLE, FAITHFUL)(mark=watch)
    assert set(watch.seconds) == set(ladder.PARTS)
    shares = profiling.time_shares(work.closure(Part(3, 3), FAITHFUL), ladder.PARTS)
    assert shares["other"] < 0.3 and all(shares[part] > 0 for part in ladder.PARTS)


def test_roll_out_and_bodies_alone_run_forwards_and_back(work):
    for on in (FAITHFUL, LEAN):
        for part in (ladder.chain_alone, ladder.bodies_alone):
            part(work.problem, work.unknowns(WHOLE, on), on)()


# ------------------------------------------------------------------------------------------------------ the program
def test_budget_of_the_official_schedule_by_hand():
    table = program.phases(program.OFFICIAL, 60)
    assert [(p.part.stage, p.part.frames, p.closures) for p in table] == [
        (1, 60, 30 * 25),
        (2, 60, 80 * 25),
        (3, 15, 30 * 25),
        (3, 60, 25 * 25),
        (3, 60, 15 * 25),
    ]
    assert [p.part.first_fixed for p in table] == [False, False, False, True, False]
    assert [p.part.contacts for p in table] == [True, True, True, False, True]


def test_a_schedule_that_ends_early_has_no_later_phases():
    table = program.phases(Schedule(steps=(1, 0, 3), inner=8, refine=(1, 9)), 10)
    assert [(p.part.stage, p.part.frames, p.closures) for p in table] == [(1, 10, 10), (3, 10, 10), (3, 10, 20)]


def test_program_is_closures_times_seconds(work):
    schedule = Schedule(steps=(1, 2, 3), inner=4, refine=(1, 2))
    spent = program.spend({"lean": (work, LEAN)}, n=1, schedule=schedule)["lean"]
    by_hand = sum(p.closures * sum(x.values()) for p, x in zip(spent.phases, spent.seconds, strict=True))
    assert torch.allclose(spent.program(), by_hand) and len(by_hand) == 1
    stages_apart = sum(spent.program(stage=stage) for stage in (1, 2, 3))
    assert torch.allclose(stages_apart, spent.program())
    rest = spent.program("first state", "chain", "body", "terms", stage=3)
    assert torch.allclose(rest + spent.program("backward", stage=3), spent.program(stage=3))
    assert sum(sum(row.values()) for row in spent.minutes().values()) == pytest.approx(by_hand.mean().item() / 60)
    assert torch.equal(spent.closure("everything"), sum(spent.seconds[-1].values()))
    with pytest.raises(DataError):
        spent.closure("stage 7")


def test_an_outer_step_takes_no_more_closures_than_its_limit(work):
    counts = program.evaluations(work, WHOLE, outer=2)
    assert len(counts) == 2 and all(2 <= count <= 25 + 25 for count in counts)  # a line search may end above it


def test_unknowns_stand_where_the_clip_does(work):
    unknown = work.unknowns(WHOLE, LEAN)
    rolled = variables.roll(unknown, work.problem.priors, work.problem.evidence)
    assert (rolled.states[:, 0, :3] - work.still["trans"][:, 0, 0]).abs().max() < 1e-6
    still = work.unknowns(Part(1, FRAMES), FAITHFUL)
    assert still["orient"].shape[-1] == 3 and still["orient"].requires_grad and not still["latent"].requires_grad


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
