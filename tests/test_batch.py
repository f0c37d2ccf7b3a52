"""Many clips: what several processes, or the workers of a real Dask cluster, compute is what one computes, whoever is
killed in the middle; what is finished is skipped, what fails is named."""

import json
import os
import signal
import sys
import threading
import time

import pytest

from motionlab.commands import batch
from motionlab.errors import DataError, MissingData
from tests import jobs

COUNT = 40


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """What a plain loop computes."""
    folder = tmp_path_factory.mktemp("serial")
    return [jobs.clip((folder, k)) for k in range(COUNT)]


def clips(folder, count=COUNT):
    return [(folder, k) for k in range(count)]


def run(folder, count=COUNT, **how):
    return batch.run_many(jobs.clip, clips(folder, count), finished=jobs.kept, name=lambda job: f"clip {job[1]}", **how)


def in_files(folder):
    return [json.loads((folder / f"{k}.json").read_text()) for k in range(COUNT)]


def kill_the_seventh(folder):
    """A thread that kills the process in which clip 7 has begun; gives the process's number."""
    (folder / "kill").touch()
    killed = []

    def wait():
        while not ((folder / "begun").exists() and (text := (folder / "begun").read_text())):
            time.sleep(0.01)  # however long a busy machine takes to start a process
        killed.append(int(text))
        os.kill(killed[0], signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()
    return killed


def test_a_process_that_is_killed_loses_nothing(tmp_path, serial):
    killed = kill_the_seventh(tmp_path)
    found = run(tmp_path, jobs_at_once=2)
    assert len(killed) == 1 and killed != [os.getpid()]
    assert [found.results[k] for k in range(COUNT)] == serial == in_files(tmp_path)
    assert not found.failed and str(found) == "40 clips: 40 done"


def test_a_clip_that_kills_every_process_is_found_out(tmp_path):
    (tmp_path / "poison").touch()
    found = run(tmp_path, 19)
    assert list(found.failed) == [17] and len(found.results) == 18
    assert "killed twice" in found.failed[17].message


def test_what_is_finished_is_skipped_and_what_fails_is_named_while_others_go_on(tmp_path, serial, capsys):
    (tmp_path / "faulty").touch()
    found = run(tmp_path, 20)
    assert len(found.results) == 18 and sorted(found.failed) == [11, 13]
    assert str(found) == "20 clips: 18 done, 2 failed"
    assert found.failed[11].message == "clip 11: not one frame (remedy: record it again)"
    assert found.failed[13].message == "ZeroDivisionError: "
    said = capsys.readouterr()
    assert said.err.count("record it again") == 1 and "in clip" in said.err and not said.out  # where the bug is
    (tmp_path / "faulty").unlink()
    before = (tmp_path / "3.json").stat().st_mtime_ns
    again = run(tmp_path)
    assert sorted(again.results) == [11, 13, *range(20, COUNT)] and len(again.skipped) == 18
    assert (tmp_path / "3.json").stat().st_mtime_ns == before and in_files(tmp_path) == serial


def test_a_function_that_leaves_nothing_behind_has_failed(tmp_path):
    found = batch.run_many(str, clips(tmp_path, 1), finished=jobs.kept)
    assert not found.results and found.failed[0].message == "stopped before it was done"  # there are no workers


def test_one_clip_runs_here(tmp_path):
    assert batch.run_many(lambda job: os.getpid(), [0]).results == {0: os.getpid()}
    assert str(batch.run_many(str, [])) == "0 clips: 0 done"


def test_without_distributed_the_remedy_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingData, match=r"-e '\.\[cluster\]'"):
        batch.run_many(str, [1, 2], cluster="tcp://127.0.0.1:1")


def test_a_cluster_computes_the_same_though_a_worker_is_killed(tmp_path, serial, cluster, monkeypatch):
    address, processes = cluster
    monkeypatch.setattr(batch, "PATIENCE", 10 * batch.PATIENCE)  # a busy machine
    folder = tmp_path / "clips"
    folder.mkdir()
    killed = kill_the_seventh(folder)
    found = run(folder, cluster=address)
    assert killed[0] in [process.pid for process in processes[1:]]
    assert [process.poll() is None for process in processes].count(False) == 1
    assert [found.results[k] for k in range(COUNT)] == serial == in_files(folder)
    (folder / "faulty").touch()
    (folder / "11.json").unlink()
    again = run(folder, cluster=address)
    assert list(again.failed) == [11] and len(again.skipped) == COUNT - 1


def test_workers_of_several_threads_are_refused(cluster, monkeypatch):
    address, _ = cluster
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(batch, "PATIENCE", 10 * batch.PATIENCE)  # a busy machine
    real = distributed.Client.scheduler_info

    def two(self, *arguments, **options):
        found = real(self, *arguments, **options)
        assert {worker["nthreads"] for worker in found["workers"].values()} <= {1}
        return found | {"workers": {name: worker | {"nthreads": 2} for name, worker in found["workers"].items()}}

    monkeypatch.setattr(distributed.Client, "scheduler_info", two)
    with pytest.raises(DataError, match="--nthreads 1"):
        batch.run_many(str, [1, 2], cluster=address)


def test_no_cluster_and_no_worker_are_said(monkeypatch, cluster):
    address, processes = cluster
    monkeypatch.setattr(batch, "PATIENCE", 1.0)
    with pytest.raises(DataError, match="dask scheduler"):
        batch.run_many(str, [1, 2], cluster="tcp://127.0.0.1:1")
    for process in processes[1:]:
        process.kill()
        process.wait()
    with pytest.raises(DataError, match="no worker"):
        batch.run_many(str, [1, 2], cluster=address)
