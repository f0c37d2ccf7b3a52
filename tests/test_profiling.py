import torch

from studies.shared.profiling import graph_nodes, interleaved


class Clock:
    """Stands still but for naps: what passes on it does not depend on the machine."""

    now = 0.0

    def __call__(self) -> float:
        return self.now

    def nap(self, seconds: float) -> None:
        self.now += seconds


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


def test_rounds_go_through_every_call_in_turn():
    order, clock = [], Clock()
    naps = {"short": 0.25, "long": 2.0}
    calls = {name: lambda name=name, nap=nap: (order.append(name), clock.nap(nap)) for name, nap in naps.items()}
    found = interleaved(calls, n=3, clock=clock)
    assert order == ["short", "long"] * 4  # one to warm up, three that count
    assert {name: seconds.tolist() for name, seconds in found.items()} == {"short": [0.25] * 3, "long": [2.0] * 3}
