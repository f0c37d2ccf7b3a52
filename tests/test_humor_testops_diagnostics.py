"""A fit that says of itself when it is not to be believed."""

from dataclasses import replace

import pytest
import torch
from rolled_inputs import network

from data_synth import clips
from motionlab.humor import testops, unknowns
from motionlab.humor.evidence import Observation3D
from motionlab.humor.feedback_solver import Plan
from studies.shared.workload import random_priors, workload
from tests.draws import seeded


@pytest.fixture(scope="module")
def work():
    walk = clips.draw(1, seeded(), actions=("walk",))[0].motion.cut(0, 6)
    return workload(walk, random_priors(seeded(), width=64), seeded(), batch=2)


def test_surprise_and_misfit_are_what_they_say(work):
    """Against sums over frames; and one for latents drawn from the prior."""
    problem, unknown = work.problem, work.moving.detached()
    rolled = unknowns.roll(unknown, problem.priors, problem.evidence)
    says = testops.diagnosed(rolled, problem.evidence)
    prior, z = rolled.rollout.prior, rolled.rollout.z
    for b in range(2):
        scores = [(z[b, t] - prior.mean[b, t]) / prior.log_var[b, t].exp().sqrt() for t in range(z.shape[1])]
        assert says.latent_chi2[b].item() == pytest.approx(torch.stack(scores).square().mean().item(), rel=1e-4)
        seen = problem.evidence.weight[b] > 0
        off = (rolled.body.observed[b] - problem.evidence.values[b]).norm(dim=-1)[seen]
        assert says.misfit[b].item() == pytest.approx(off.square().mean().sqrt().item(), rel=1e-4)
    drawn = rolled._replace(rollout=rolled.rollout._replace(z=prior.sample(seeded(1))))
    assert (testops.diagnosed(drawn, problem.evidence).latent_chi2 - 1).abs().max() < 0.3


def test_what_is_not_seen_is_not_missed(work):
    problem, unknown = work.problem, work.moving.detached()
    weight = problem.evidence.weight.clone()
    weight[:, :, ::2] = 0.0
    values = problem.evidence.values.clone()
    values[:, :, ::2] = 1e9
    less = replace(problem, evidence=replace(problem.evidence, weight=weight, values=values))
    rolled = unknowns.roll(unknown, less.priors, less.evidence)
    assert (testops.diagnosed(rolled, less.evidence).misfit < 1e4).all()


def test_doubts_name_the_clip_and_bounds_are_bounds():
    chi2, misfit = torch.tensor([[0.2, 0.6, 0.2, torch.nan], [0.05, 0.05, 0.3, 0.05]])
    says = testops.FitDiagnostics(chi2, misfit, 0.12, False)
    assert says.doubtful.tolist() == [False, True, True, True]
    assert [line.split(":")[0] for line in says.sentences()] == [f"stage 3 doubts clip {k}" for k in (1, 2, 3)]
    assert "0.30 m" in says.sentences()[1]


@pytest.mark.parametrize("solver", testops.SOLVERS)
def test_a_fit_is_judged_by_either_solver(solver):
    walk = clips.draw(1, seeded(), actions=("walk",))[0].motion.cut(0, 8)
    seen = Observation3D(walk.positions, torch.ones(walk.positions.shape[:-1], dtype=torch.bool))
    priors = replace(random_priors(seeded(), width=64), motion=network(64).float())
    schedule = replace(testops.Schedule.quick(), shooting=Plan(rounds=1, closures=4))
    fitted = testops.fit(seen, priors, schedule=schedule, solver=solver)
    assert fitted.diagnostics.latent_chi2.shape == (1,) and fitted.diagnostics.misfit.isfinite().all()
    assert bool(fitted.diagnostics.doubtful.any()) == any("doubts" in note for note in fitted.notes)
    assert torch.equal(fitted.motion.positions, fitted.stages[3].positions)


@pytest.mark.parametrize("how", [{"solver": "newton"}, {"solver": "shooting", "mode": "official"}])
def test_a_solver_that_is_not_there(how):
    seen = Observation3D(torch.zeros(4, 22, 3), torch.ones(4, 22, dtype=torch.bool))
    with pytest.raises(ValueError, match="solver"):
        testops.fit(seen, random_priors(seeded(), width=64), **how)
