"""Jobs on several processes: each alone on one thread, results in order, one that fails ends all; and one thread for
what is narrow."""

import multiprocessing
import os
import pickle
from functools import partial

import pytest
import torch

from motionlab.errors import DataError, MissingData, NotConverged
from motionlab.humor import testops
from motionlab.humor.evidence import Observation3D
from motionlab.humor.rollout import rollout, sample_rollout
from motionlab.motion import FPS
from motionlab.parallel import WIDE, run_jobs, threads_for
from tests import jobs
from tests.rolled_inputs import F64, first_states, network


@pytest.fixture(autouse=True)
def two_threads(monkeypatch):
    """As torch begins on two cores; processes that begin have them, too."""
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_two_jobs_run_at_once_each_in_a_fresh_process_with_one_thread(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "copied", True)  # which a process that is no copy does not know
    before, heard = multiprocessing.active_children(), []
    both = [partial(jobs.first, tmp_path), jobs.second]  # the first waits until here somebody has heard of the second
    found = run_jobs(both, 2, lambda *of: heard.append((*of, os.getpid())) or (tmp_path / "heard").touch())
    assert len({os.getpid(), *(pid for pid, _, _ in found)}) == 3
    assert [rest for _, *rest in found] == [[1, False]] * 2
    assert heard == [(1, found[1], os.getpid()), (0, found[0], os.getpid())]  # told as they end, given back in order
    assert multiprocessing.active_children() == before and torch.get_num_threads() == 2


def test_a_job_that_fails_ends_all_and_its_error_arrives(tmp_path):
    before = multiprocessing.active_children()
    with pytest.raises(MissingData, match=r"a body is missing. Download it."):
        run_jobs([partial(job, tmp_path) for job in (jobs.endless, jobs.missing, jobs.endless)], 2)
    assert multiprocessing.active_children() == before  # the endless one did not come to its limit


@pytest.mark.parametrize("error", [DataError("no", path="a", remedy="b"), MissingData("a", "b"), NotConverged("no")])
def test_errors_are_the_same_in_another_process(error):
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error) and str(back) == str(error) and vars(back) == vars(error)


def test_one_worker_is_this_process():
    heard = []
    assert run_jobs([jobs.second] * 2, 1, lambda k, _: heard.append(k)) == [(os.getpid(), 1, False)] * 2
    assert heard == [0, 1] and torch.get_num_threads() == 2
    assert run_jobs([], 1) == []


def test_only_a_wide_batch_has_several_threads():
    for rows, threads in ((1, 1), (WIDE - 1, 1), (WIDE, 2)):
        with pytest.raises(KeyError), threads_for(rows):
            assert torch.get_num_threads() == threads
            raise KeyError
        assert torch.get_num_threads() == 2


@pytest.mark.parametrize(("rows", "threads"), [(1, 1), (WIDE, 2)])
def test_a_fit_and_a_roll_out_of_few_rows_take_one_thread(rows, threads, kit, generator, monkeypatch):
    seen = []

    def begin(problem):
        seen.append(torch.get_num_threads())
        raise KeyError

    monkeypatch.setattr(testops, "start_stage_1", begin)
    observation = Observation3D(torch.zeros(rows, 2, 22, 3), torch.ones(rows, 2, 22, dtype=torch.bool), FPS)
    with pytest.raises(KeyError):
        testops.fit(observation, kit)
    model, first = network(32), first_states(generator, rows)
    model.prior_net.register_forward_hook(lambda *_: seen.append(torch.get_num_threads()))
    sample_rollout(model, first, 1)
    rollout(model, first, torch.zeros(rows, 1, 48, dtype=F64))
    assert seen == [threads] * 3 and torch.get_num_threads() == 2
