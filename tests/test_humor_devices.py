"""The test-time optimisation stays on the device of its input: on a GPU where there is one, else on one made up."""

from dataclasses import replace

import pytest
import torch

from motionlab.humor import compiled, testops
from motionlab.humor.feedback_solver import Plan
from motionlab.humor.priors import InitGmm, Priors
from motionlab.humor.testops import Schedule
from tests.elsewhere import ELSEWHERE, Elsewhere, elsewhere, moved
from tests.fit_inputs import joints, keypoints

FRAMES = 5
FEW = Schedule(
    steps=(1, 1, 1),
    inner=1,
    short=3,
    refine=(0, 0),
    shooting=Plan(rounds=2, closures=2, trial_rounds=1, tolerance=-1e3),  # a second start, then jumps anywhere
)


def priors_by(move, kit):
    parts = (kit.initial.weights, kit.initial.means, kit.initial.covariances)
    return Priors(move(kit.motion), move(kit.pose), InitGmm(*map(move, parts)))


def asked(kind, walk, camera):
    """An observation with a gap, and how to fit it: of joints, or of keypoints by a camera that has to be refined."""
    short = replace(walk, root=walk.root[:, :FRAMES], rot=walk.rot[:, :FRAMES], contacts=None)
    if kind == "joints":
        hidden = torch.zeros(2, FRAMES, 22, dtype=torch.bool)
        hidden[0, 3:5] = True  # nobody there
        return joints(short, hidden), {}
    seen = keypoints(short, camera)
    confidence = seen.confidence.clone()
    confidence[1, 2] = 0.0
    return replace(seen, confidence=confidence), {"floor": "refine"}


@pytest.mark.parametrize(("kind", "solver"), [("joints", "rollout"), ("keypoints", "shooting")])
def test_nothing_of_a_fit_is_left_on_the_cpu_and_it_is_the_same_fit(kind, solver, walk, camera, kit, monkeypatch):
    """A made-up device: what a GPU would refuse is written down and computed all the same."""
    monkeypatch.setattr(compiled, "fits", lambda *each: False)  # loops of the CPU, whose roundings are their own
    observation, how = asked(kind, walk, camera)
    how |= {"schedule": FEW, "solver": solver}
    here = testops.fit(observation, kit, **how)
    with elsewhere() as mixed:
        there = testops.fit(moved(observation), priors_by(moved, kit), **how)
    assert not mixed, sorted(set(mixed))
    motion, other = here.motion, there.motion
    pairs = [(motion.root, other.root), (motion.rot, other.rot), (here.betas, there.betas), (here.z, there.z)]
    pairs += [(term, there.energies[3][name]) for name, term in here.energies[3].items()]
    for ours, theirs in pairs:
        assert isinstance(theirs, Elsewhere) and torch.equal(ours, theirs.inner)


def test_control_a_constant_of_the_cpu_is_found_where_it_is_used(kit):
    with elsewhere() as mixed:
        x = torch.zeros(2, 3, device=ELSEWHERE)
        y = x + torch.ones(3)
    assert mixed == [("not in the library", "add")] and torch.equal(y.inner, torch.ones(2, 3))
    with elsewhere() as mixed:  # what a GPU takes: a single number, an index, a copy
        x[torch.tensor([0])] = x.new_ones(3) + torch.tensor(1.0) + torch.ones(3).to(x)
    assert not mixed and torch.equal(x.inner, torch.tensor([[3.0] * 3, [0.0] * 3]))
    with elsewhere() as mixed:
        kit.pose.decode(torch.zeros(1, 32, device=ELSEWHERE))  # its weights are here
    assert mixed and all(place.startswith("humor/priors") for place, _ in mixed)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("solver", testops.SOLVERS)
@pytest.mark.parametrize("kind", ["joints", "keypoints"])
def test_a_gpu_finds_what_the_cpu_finds(kind, solver, walk, camera, kit):
    """To a millimetre: roundings differ, and few steps are too few for them to grow."""

    def to(thing):
        return moved(thing, lambda x: x.to("cuda"))

    observation, how = asked(kind, walk, camera)
    how |= {"schedule": FEW, "solver": solver}
    here = testops.fit(observation, kit, **how)
    there = testops.fit(to(observation), priors_by(to, kit), **how)
    assert there.motion.root.is_cuda and there.z.is_cuda
    assert (there.motion.positions.cpu() - here.motion.positions).norm(dim=-1).max() < 1e-3
