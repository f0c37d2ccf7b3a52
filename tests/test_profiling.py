import gc
import time

import pytest
import torch

from motionlab.profiling import Stopwatch, _timed, graph_nodes, interleaved


def test_timer_finds_a_sleep_and_leaves_garbage_collection_as_it_was():
    calls = []

    def nap():
        calls.append(gc.isenabled())
        time.sleep(0.01)

    timing = _timed(nap, n=5, warm_up=2)
    assert 0.01 <= timing.median < 0.1 and timing.iqr >= 0 and timing.n == 5
    assert calls[2:] == [False] * 5 and gc.isenabled()
    with pytest.raises(ValueError, match="n"):
        _timed(nap, n=0)


def test_collection_comes_back_after_an_error():
    with pytest.raises(ZeroDivisionError):
        _timed(lambda: 1 / 0, warm_up=0)
    assert gc.isenabled()


def test_graph_nodes_by_hand():
    x = torch.ones(3, requires_grad=True)
    assert graph_nodes(x.detach()) == 0
    assert graph_nodes(x * 2) == 2  # the product and the leaf
    y = x * 2
    assert graph_nodes(y + y) == 3  # a shared node counts once
    chain = x
    for _ in range(5000):  # deeper than Python's recursion
        chain = chain + 1
    assert graph_nodes(chain) == 5001
    assert graph_nodes(x * 2, x * 3) == 3


def test_rounds_go_through_every_call_in_turn():
    order = []
    naps = {"short": 0.002, "long": 0.02}
    calls = {name: lambda name=name, nap=nap: (order.append(name), time.sleep(nap)) for name, nap in naps.items()}
    found = interleaved(calls, n=3)
    assert order == ["short", "long"] * 4  # one to warm up, three that count
    assert all(len(x) == 3 for x in found.values())
    assert (found["long"] > found["short"]).all() and found["long"].min() >= 0.02
    with pytest.raises(ValueError):
        interleaved(calls, n=0)


def test_stopwatch_adds_up_by_label():
    watch = Stopwatch()
    for _ in range(2):
        with watch("nap"):
            time.sleep(0.01)
        with watch("nothing"):
            pass
    assert watch.seconds["nap"] >= 0.02 > 10 * watch.seconds["nothing"]


def test_processor_time_does_not_count_a_sleep():
    calls = {"nap": lambda: time.sleep(0.05)}
    assert interleaved(calls, n=1, clock=time.process_time)["nap"].item() < 0.01 < interleaved(calls, n=1)["nap"].item()
    watch = Stopwatch(time.process_time)
    with watch("nap"):
        time.sleep(0.05)
    assert watch.seconds["nap"] < 0.01
