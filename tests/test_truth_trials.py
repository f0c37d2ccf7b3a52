"""A search that begins at the truth, and errors of what was seen and what was not."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.humor import priors, three_d, truth_trials
from motionlab.humor import solver_trials as trials
from motionlab.humor.weights import KEYPOINTS


@pytest.fixture(scope="module")
def task():
    truth = scenes.held_out(2, seed=6, frames=18)
    return trials.prepare("hidden", three_d.low_hidden(truth), priors.load("compact"), KEYPOINTS, truth)


def test_it_begins_nearer_to_the_truth_than_a_fit_does(task):
    begun = truth_trials.at_truth(task)
    assert {n: x.shape for n, x in begun.items()} == {n: x.shape for n, x in task.unknown.items()}
    assert not any(x.requires_grad for x in begun.values())
    told, usual = (task.error(task.motion(unknown)) for unknown in (begun, task.unknown))
    blind = replace(task, truth=task.rough)  # told stage 2's motion instead
    away = task.error(task.motion(truth_trials.at_truth(blind)))
    assert (told < 0.7 * usual).all() and (told < 0.7 * away).all()


def test_errors_of_what_was_seen_and_what_was_not(task):
    moved, seen = task.truth.clip(slice(None)), torch.ones(2, 18, 22, dtype=torch.bool)
    object.__setattr__(moved, "root", moved.root + torch.tensor([0.03, 0.0, 0.04]))
    seen[1] = False
    found = truth_trials.errors_where(task, moved, seen)
    torch.testing.assert_close(found["seen"], torch.tensor([5.0, torch.nan]), atol=1e-3, rtol=0, equal_nan=True)
    torch.testing.assert_close(found["hidden"], torch.tensor([torch.nan, 5.0]), atol=1e-3, rtol=0, equal_nan=True)
    both = truth_trials.errors_where(task, task.rough, three_d.low_hidden(task.truth).visible)
    share = three_d.low_hidden(task.truth).visible.double().mean((-1, -2))
    whole = share * both["seen"] + (1 - share) * both["hidden"]
    torch.testing.assert_close(whole.float(), task.error(task.rough))
