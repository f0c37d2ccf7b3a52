"""Draws around the end of a fit: exact roll-outs, as wide as the energy says; regions; what is refused."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import posterior
from motionlab.errors import DataError
from motionlab.humor import energies, state
from motionlab.humor.pretrained import load_priors
from motionlab.humor.rollout import rollout
from motionlab.humor.stages import motion_terms
from motionlab.humor.testops import Schedule, fit
from motionlab.posterior import Draws, places_of, rolled, sample
from studies.nb09_posterior import from_the_prior as made
from tests.draws import seeded

FRAMES = 16


@pytest.fixture(scope="module")
def priors():
    return load_priors("real")


@pytest.fixture(scope="module")
def truth(priors):
    """Truths drawn from the prior, behind a wall: their problem, unknowns and joints about the pelvis."""
    people = scenes.film("walking, legs hidden", 2, seed=1, frames=FRAMES)
    return made.truths(people, priors, seeded())


@pytest.fixture(scope="module")
def fitted(priors):
    scene = scenes.film("walking, legs hidden", 2, seed=1, frames=FRAMES)
    return fit(scene.observation, priors, cameras=scene.cameras, solver="shooting", schedule=Schedule.quick())


@pytest.fixture(scope="module")
def least(truth):
    """The end of a search with the prior of whitened latents, of which a draw is as likely as it is near."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(energies, "motion_prior", made.whitened)
        return made.found(*truth[:2])


def rise(least, temperature, count=16):
    """By how much the energy of draws is above its minimum, over what half the squared length of their coordinates is
    on average, as an exact quadratic has it; and the bodies."""
    seen, heard = [], posterior.unwhiten

    def listened(problem, unknown, loop, new):
        at, out = heard(problem, unknown, loop, new)
        terms = motion_terms(problem, replace(at, z=out.rollout.z))
        seen.append((sum(terms.values()), sum(0.5 * x.square().flatten(1).sum(1) for x in new.values())))
        return at, out

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(energies, "motion_prior", made.whitened)
        patch.setattr(posterior, "unwhiten", listened)
        rolled(least, count, seeded(), 0, temperature)
        row = torch.tensor([0])
        floor = sum(motion_terms(least.problem.rows(row), least.unknown.rows(row)).values())
    energy, half = (torch.cat(x) for x in zip(*seen, strict=True))
    return ((energy - floor) / half).mean().item(), half.mean().item() / least.problem.weights.motion_prior[2]


def test_the_energy_of_draws_rises_as_half_their_squared_coordinates(least):
    """A linear-Gaussian model has 1 exactly; so has this one where it is cold, and half a nat for each unknown at 1."""
    unknowns = 48 * (FRAMES - 1) + 110 + 8
    ratio, nats = rise(least, 0.02)
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert nats == pytest.approx(0.02 * unknowns / 2, rel=0.05)
    assert rise(least, 4.0)[1] == pytest.approx(4 * unknowns / 2, rel=0.05)


def test_truths_drawn_from_the_prior_rank_among_the_draws_and_half_the_spread_is_caught(least, truth):
    """Talts et al.: a tenth of the ranks in the outer tenth."""
    right, narrow = (made.outside(made.ranks(least, truth[2], 0, spread=s)).mean() for s in (1.0, 0.5))
    assert right < 0.3 < narrow


def test_draws_are_exact_roll_outs(fitted, monkeypatch):
    """A naive twin: the open-loop chain from each draw's own first state and latents."""
    seen, heard = [], posterior.unwhiten
    monkeypatch.setattr(posterior, "unwhiten", lambda *given: seen.append(heard(*given)[1]) or heard(*given))
    motion = rolled(fitted, 3, seeded(), 1, 10.0)
    (out,) = seen
    again = rollout(fitted.problem.priors.motion, out.states[:, 0], out.rollout.z).states
    assert torch.allclose(state.unpack(again)["trans"], motion.root[:, 1:], atol=2e-3)


def test_draws_depend_on_the_generator_alone(fitted):
    one, same, other = (sample(fitted, 8, generator=seeded(seed)).motions.root for seed in (3, 3, 4))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_draws_part_where_nothing_was_seen(fitted):
    """The same fit, told that nothing was ever detected: every limb may go anywhere that the prior lets it."""
    seen, wide = fitted.problem.evidence, []
    blind = replace(fitted, problem=replace(fitted.problem, evidence=replace(seen, weight=0 * seen.weight)))
    for one in (fitted, blind):
        draws = sample(one, 24, generator=seeded(), temperature=1.0)
        wide.append(places_of(draws.motions)[1].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().mean(0))
        assert not draws.hidden[:, ~draws.limbs].any()
    assert draws.hidden[:, draws.limbs].all()
    assert (wide[1] > 1.5 * wide[0])[draws.limbs].all()


def test_temperatures_may_differ_by_draw(fitted):
    heats = torch.tensor([1e-8, 30.0]).repeat_interleave(6)
    motions = sample(fitted, 12, generator=seeded(), temperature=heats).motions.positions
    still, moving = (x.std(0).mean() for x in motions.split(6))
    assert still < 1e-3 < moving
    assert torch.allclose(motions[0], fitted.motion.clip(0).positions, atol=1e-3)


def test_regions_are_the_draws_own_covariance_widened(fitted):
    draws = sample(fitted, 16, generator=seeded())
    centre, shape = draws.places(0.9)
    frame, joint = draws.hidden.nonzero()[0].tolist()
    own = (draws.motions.positions - draws.motions.root[:, :, None])[:, frame, joint]
    by_hand = posterior.RADII[0.9] ** 2 * (own.mT.cov() + posterior.FLOOR**2 * torch.eye(3))
    assert torch.allclose(shape[frame, joint], by_hand, atol=1e-6)
    assert torch.allclose(centre[frame, joint], draws.fit.root[frame] + own.mean(0), atol=1e-6)
    assert (draws.places(0.5)[1].diagonal(dim1=-2, dim2=-1) < shape.diagonal(dim1=-2, dim2=-1)).all()
    with pytest.raises(ValueError, match=r"0\.5, 0\.8, 0\.9"):
        draws.places(0.7)


def test_summary_says_which_joint_when_and_how_wide(fitted):
    draws = sample(fitted, 8, generator=seeded())
    hidden = torch.zeros_like(draws.hidden)
    hidden[4:10, draws.fit.skeleton.index("left_ankle")] = True
    hidden[0:2, draws.fit.skeleton.index("right_foot")] = True  # too short to speak of
    (line,) = Draws(draws.fit, draws.motions, hidden).summary()
    assert line.startswith("left ankle, 0.1 to 0.3 s: ") and line.endswith(" cm at 90 %")
    assert Draws(draws.fit, draws.motions, hidden, ("stage 3 doubts",)).summary()[-1] == "stage 3 doubts"


def test_bad_input_is_refused(fitted):
    with pytest.raises(DataError, match='solver="shooting"'):
        sample(replace(fitted, problem=None, unknown=None), 2, generator=seeded())
    for count, heat in ((0, 1.0), (2, 0.0), (2, float("nan"))):
        with pytest.raises(ValueError, match="at least one draw"):
            sample(fitted, count, generator=seeded(), temperature=heat)
