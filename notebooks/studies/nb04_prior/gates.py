"""What a transition prior is asked to reach on people nobody trained on: the measures of the model table, as tests."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.metrics import interval

Row = Mapping[str, float]


class Gate(NamedTuple):
    """label: for a figure. of: one person's row of the model table to the number that is asked for. over: a measure
    whose mean over people that number is divided by (of one person it may be nought). rival: the same number of what
    needs no prior, where the row has one."""

    label: str
    of: Callable[[Row], float]
    over: str = ""
    rival: Callable[[Row], float] | None = None


def _measure(name: str, over: str = "") -> Callable[[Row], float]:
    return lambda row: row[name] / row[over] if over else row[name]


_STRAIGHT = "one step, constant velocity, cm"
#: By the name of the test of H01.
GATES = {
    "one_step": Gate("one step, prior's mean", _measure("one step, prior mean, cm", _STRAIGHT), rival=lambda _: 1.0),
    "one_step_shown": Gate("one step, shown the answer", _measure("one step, posterior, cm", _STRAIGHT)),
    "open_loop": Gate("2 s, z known, open loop", _measure("2 s, posterior z, cm")),
    "closed_loop": Gate("2 s, z known, closed loop", _measure("2 s, closed loop, cm")),
    "foresight": Gate("2 s, prior's mean alone", _measure("2 s, prior mean, cm"), rival=_measure("2 s, hold, cm")),
    "bones": Gate("samples: bones change", _measure("samples' bones")),
    "floor": Gate("samples: foot in the floor", _measure("samples' penetration")),
    "slide": Gate("samples: feet slide", _measure("samples' slide"), "data's slide"),
    "walkers": Gate("samples: walkers who walk on", _measure("walkers who go on")),
    "active": Gate("active latents", _measure("active")),
    "contacts": Gate("contacts, F1", _measure("one step, posterior, contact F1"),
                     rival=_measure("contact F1, as one frame before")),
}  # fmt: skip


def by_person(gate: Gate, rows: Mapping[str, Row]) -> Tensor:
    """Computes a gate's number of every person (P,); people of whom there is none are left out."""
    values = torch.tensor([gate.of(row) for row in rows.values()], dtype=torch.float64)
    values = values[values.isfinite()]
    return values / by_person(Gate("", _measure(gate.over)), rows).mean() if gate.over else values


def baseline(gate: Gate, rows: Mapping[str, Row], others: Mapping[str, Row]) -> Tensor:
    """Computes what a gate's number is compared with, of every person (P,): its rival's, else the other prior's."""
    return by_person(gate, others) if gate.rival is None else by_person(gate._replace(of=gate.rival), rows)


def reached(
    table: Mapping[tuple[str, str], Mapping[str, Row]], generator: torch.Generator
) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Computes by prior and source what each gate's number is: the mean over people, and its interval."""
    found = {}
    for (prior, source), rows in table.items():
        values = {name: by_person(gate, rows) for name, gate in GATES.items()}
        found[f"{prior}, {source}"] = {n: interval(x, "mean", generator) for n, x in values.items() if len(x)}
    return found
