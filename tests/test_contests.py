"""Contests of notebook 08: everybody plays as practice says, and workers change nothing but the time."""

import os
import time
from dataclasses import replace
from functools import partial
from multiprocessing import active_children

import pytest
import torch

from data_synth import scenes
from motionlab.errors import DataError
from motionlab.humor import contests, multiple, multiple_trials, priors, shooting, solver_costs, three_d, transitions
from motionlab.humor import solver_trials as trials
from motionlab.humor.contests import NO_LEAPS, Contest
from motionlab.humor.solver_trials import Single
from motionlab.humor.weights import JOINTS, RGB_LIGHT
from motionlab.humor.windowed import Windows, windowed

PLAN = shooting.Plan(rounds=2, closures=4, trial=1)
SHORT = Single(iterations=(2, 2, 4))
CONTEST = Contest(SHORT, transitions.EAGER, Windows(10, 3, SHORT), multiple.Plan(stiffness=(1.0,)), PLAN)


@pytest.fixture(scope="module")
def task():
    truth = scenes.held_out(2, seed=5, frames=18)
    seen = three_d.noisy(truth, torch.Generator().manual_seed(0))
    return trials.prepare("noisy", seen, priors.load("compact"), JOINTS, truth)


def test_alone_each_plays_as_it_was_told(task):
    one = task.rows([0])
    runs = CONTEST.alone(one, 0.05)
    assert list(runs) == ["single shooting", "shooting", "windows", "multiple shooting"]
    assert torch.equal(runs["shooting"].end, trials.shot(one, PLAN).end)
    assert torch.equal(runs["windows"].end, windowed(one, CONTEST.windows).end)
    assert torch.equal(runs["multiple shooting"].end, multiple_trials.shot(one, CONTEST.soft, PLAN).end)
    waited = CONTEST.alone(one, 1.5)["single shooting"]
    assert waited.end < runs["single shooting"].end and waited.spent > 1.0  # not ended by its iterations
    calm = replace(CONTEST, eager=transitions.CALM).patient(one, 0.05)
    assert calm.energies[0] != runs["single shooting"].energies[0]


def test_together_the_best_is_no_higher_than_anybodys(task):
    further = replace(PLAN, rounds=1, tolerance=1e-4)
    runs, best = CONTEST.together(task, 0.2, further)
    assert list(runs) == ["single shooting", "shooting", NO_LEAPS]
    lowest = solver_costs.lowest(list(runs.values()))
    assert (best <= lowest).all() and (best < lowest).any()  # carried on
    on = [trials.shot(task, further, runs[who].unknown) for who in ("single shooting", "shooting")]
    on.append(multiple_trials.shot(task, CONTEST.soft, PLAN))
    torch.testing.assert_close(best, solver_costs.lowest([*runs.values(), *on]), rtol=1e-3, atol=1e-3)
    assert all((run.end < before.end).any() for run, before in zip(on[:2], runs.values(), strict=False))


def test_groups_are_all_clips_once():
    assert [list(some) for some in contests.groups(5, 2)] == [[0, 1], [2, 3], [4]]
    assert contests.groups(0, 4) == []


def threads(job):
    return job, os.getpid(), torch.get_num_threads()


def fails():
    raise DataError("no such clip")


def test_a_job_that_fails_ends_the_others():
    began = time.perf_counter()
    with pytest.raises(DataError, match="no such clip"):
        contests.beside([fails, partial(time.sleep, 120)], 2)
    while active_children() and time.perf_counter() - began < 60:  # the pool's own thread may be reaping them just now
        time.sleep(0.05)
    assert time.perf_counter() - began < 60 and not active_children()


def test_workers_return_what_their_jobs_do_in_order(monkeypatch):
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    jobs = [partial(threads, n) for n in range(3)]
    here, there = contests.beside(jobs, 1), contests.beside(jobs, 2)
    assert [n for n, _, _ in here] == [n for n, _, _ in there] == [0, 1, 2]
    assert {pid for _, pid, _ in here} == {os.getpid()} and os.getpid() not in {pid for _, pid, _ in there}
    assert all(count == 1 for _, _, count in there)


def slowly(n, folder):
    """The first waits for the last, where somebody else can run that."""
    began = time.perf_counter()
    while n == 0 and folder.name == "2" and not (folder / "2").exists() and time.perf_counter() - began < 60:
        time.sleep(0.05)
    (folder / str(n)).touch()
    return n


@pytest.mark.parametrize("workers", [1, 2])
def test_what_is_done_is_told_at_once_and_what_fails_takes_nothing_back(workers, tmp_path):
    told, folder = [], tmp_path / str(workers)
    folder.mkdir()
    jobs = [partial(slowly, n, folder) for n in range(3)]
    assert contests.beside(jobs, workers, lambda *done: told.append(done)) == [0, 1, 2]
    assert sorted(told) == [(0, 0), (1, 1), (2, 2)] and (told[-1] == (0, 0)) == (workers == 2)
    told.clear()
    with pytest.raises(DataError, match="no such clip"):
        contests.beside([*jobs[1:], fails], workers, lambda *done: told.append(done))
    assert told and set(told) <= {(0, 1), (1, 2)} and (len(told) == 2 or workers == 2)


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="open files are counted in /proc")
def test_a_film_that_a_worker_fits_is_the_film_that_is_fitted_here():
    """Cameras travel, too; and no tensor between processes holds a file open."""
    film = scenes.film("walking, legs hidden", 2, seed=6, frames=12)
    task = trials.prepare("walk", film.observation, priors.load("compact"), RGB_LIGHT, film.truth, cameras=film.cameras)
    jobs = [partial(trials.shot, task.rows([k]), replace(PLAN, rounds=1)) for k in range(2)]
    before = len(os.listdir("/proc/self/fd"))
    found = contests.beside(jobs, 2)
    assert len(os.listdir("/proc/self/fd")) <= before + 2
    for mine, theirs in zip(contests.beside(jobs, 1), found, strict=True):
        torch.testing.assert_close(theirs.end, mine.end, rtol=1e-3, atol=1e-3)
        assert theirs.unknown.keys() == mine.unknown.keys() and 0 < theirs.seconds[0] < theirs.spent
