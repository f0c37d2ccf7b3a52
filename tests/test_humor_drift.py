"""One step against a chain: cases whose answer is known, and variants of the model that parity must catch."""

from pathlib import Path

import pytest
import torch

from data_synth import scenes
from motionlab.errors import ShapeError
from motionlab.humor.cvae import Cvae
from studies.nb04_prior import controls, drift, parity


@pytest.fixture(scope="module")
def clips():
    return scenes.held_out(4, frames=16)


def small(scale=0.02):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Cvae(64)
    with torch.no_grad():
        for weight in model.decoder.net[-1].parameters():
            weight.mul_(scale)
    return model.frozen()


def test_a_decoder_that_changes_nothing_holds_the_pose(clips):
    found = drift.decode(small(0.0), clips)
    near, far = drift.one_step_errors(found), drift.rollout_errors(found)
    for errors in (near, far):
        torch.testing.assert_close(errors["posterior"], errors["hold"], atol=1e-4, rtol=0)
        torch.testing.assert_close(errors["prior's mean"], errors["hold"], atol=1e-4, rtol=0)
    # its one-step errors are the sequence's own steps: added up they are the way from the first pose
    torch.testing.assert_close(far["errors added"], far["hold"], atol=1e-4, rtol=0)
    assert (far["errors at random"][:, -1] < far["errors added"][:, -1])[0]  # a walker goes one way
    speed = drift.velocity_errors(found)
    torch.testing.assert_close(speed["posterior"], speed["hold"], atol=1e-3, rtol=0)
    assert speed["hold"].mean() > 1.0
    assert near["constant velocity"].mean() < 0.3 * near["hold"].mean()


def test_steps_ahead_lie_between_one_step_and_the_whole_chain(clips):
    model = small()
    found = drift.decode(model, clips)
    one, all_of_it = drift.ahead_errors(model, found, 1), drift.ahead_errors(model, found, 15)
    for name, errors in drift.one_step_errors(found).items():
        torch.testing.assert_close(one[name][:, 0], errors.mean(1), atol=1e-3, rtol=0)
        torch.testing.assert_close(all_of_it[name], drift.rollout_errors(found)[name], atol=1e-3, rtol=0)
    five = drift.ahead_errors(model, found, 5)["hold"]  # by hand, from every state that has five steps left
    joints = clips.positions
    by_hand = [100 * (joints[:, k : k + 11] - joints[:, :11]).norm(dim=-1).mean((1, 2)) for k in range(1, 6)]
    torch.testing.assert_close(five, torch.stack(by_hand, 1), atol=1e-3, rtol=0)
    with pytest.raises(ShapeError, match="15 transitions"):
        drift.ahead_errors(model, found, 16)


def test_parity_catches_what_is_wrong_on_purpose():
    golden, model = parity.Golden(Path(__file__).parent / "golden"), parity.seeded()
    assert min(controls.errors(golden, model).values()) > 1e-2
    assert controls.misfits(model, golden) == []
    assert len(controls.misfits(Cvae(512), golden)) == 50
