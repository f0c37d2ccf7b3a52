"""The settings of every decoupled search, chosen on clips that no table uses: all settings of a grid in one batch.

A search is judged by what all searches are judged by, the stage-3 energy of the exact roll-out, unless another measure
is named; ties and numbers that are not finite lose.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import torch

from motionlab.humor.decoupled import Form
from motionlab.humor.decoupled_search import Found, Plan, X, adam, alternate, lbfgs
from motionlab.humor.decoupled_trials import Case, judged

Grid = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Search:
    """A way to search. make: its plan from one number, or one tensor (n,), for each axis of the grid."""

    make: Callable[..., Plan]
    grid: Grid
    measure: str = "energy"


def _loss(scale: str, *, detached: bool = False) -> Callable[..., Plan]:
    def make(rate_x, rate_z, weight) -> Plan:
        return Plan(Form(1, weight, detached, scale), rate_x=rate_x, rate_z=rate_z)

    return make


def _overwritten(rate_x, rate_z, share) -> Plan:
    return Plan(Form(1, 0.0), rate_x=rate_x, rate_z=rate_z, share=share)


def _x_alone(rate_x, weight) -> Plan:
    return Plan(Form(1, weight), moving=X, rate_x=rate_x, settle=False)


def text(values: Mapping[str, object]) -> str:
    """A setting, or a grid, as a person reads it: "weight 3; 10, rate_x 0.01"."""
    parts = {n: v if isinstance(v, tuple) else (v,) for n, v in values.items()}
    return ", ".join(
        f"{n} " + "; ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in v) for n, v in parts.items()
    )


#: K = 1 throughout. "L1" is the thesis's, every number of a state alike; "L1 in metres" weighs them by what they move.
SEARCHES = {
    "copy": Search(_overwritten, {"rate_x": (0.003, 0.03), "rate_z": (0.0003, 0.001, 0.003), "share": (1.0,)}),
    "blend": Search(
        _overwritten, {"rate_x": (0.01,), "rate_z": (0.0003, 0.001, 0.003), "share": (0.03, 0.1, 0.3, 0.6)}
    ),
    "L1": Search(_loss("plain"), {"rate_x": (0.01, 0.03), "rate_z": (0.003, 0.01), "weight": (3.0, 10.0, 30.0, 100.0)}),
    "L1 in metres": Search(
        _loss("metres"), {"rate_x": (0.01, 0.03), "rate_z": (0.003, 0.01), "weight": (30.0, 100.0, 300.0)}
    ),
    "L1, z detached": Search(
        _loss("plain", detached=True),
        {"rate_x": (0.01, 0.03), "rate_z": (0.001, 0.003, 0.01), "weight": (10.0, 100.0)},
    ),
}  # fmt: skip
#: For clips of its own length, and by what it is wanted for: the legs of the persistent states.
FIXED_Z = Search(_x_alone, {"rate_x": (0.01, 0.03, 0.1), "weight": (1.0, 3.0, 10.0)}, "kept legs")


def tune(practice: Case, search: Search, iterations: int) -> tuple[dict[str, float], list[dict[str, float]]]:
    """The setting with the least mean of the measure over the practice clips, and a row for every setting."""
    settings = [dict(zip(search.grid, values, strict=True)) for values in product(*search.grid.values())]
    many = practice.rows(torch.arange(len(practice)).repeat(len(settings)))
    columns = {n: torch.tensor([s[n] for s in settings]).repeat_interleave(len(practice)) for n in search.grid}
    found = adam(many.problem, many.start, search.make(**columns), iterations)
    rows = _rows(settings, many, found, len(practice))
    best = min(range(len(rows)), key=lambda k: rows[k][search.measure])
    return settings[best], rows


def _rows(settings: Sequence[Mapping], many: Case, found: Found, clips: int) -> list[dict[str, float]]:
    means = {
        n: x.unflatten(0, (-1, clips)).mean(-1).nan_to_num(nan=float("inf")).tolist()
        for n, x in judged(many, found.unknown).items()
    }
    return [{**s, **{n: means[n][k] for n in ("energy", "legs", "kept legs", "gap")}} for k, s in enumerate(settings)]


#: Ways to move z and x in turns: the method of a block, its evaluations, which of the two begins.
TURNS = tuple({"method": m, "inner": n, "first": f} for m, n, f in
              (("adam", 10, "z"), ("adam", 50, "z"), ("adam", 50, "x"), ("lbfgs", 50, "z")))  # fmt: skip


def in_turns(known: Case, plan: Plan, way: Mapping, evaluations: int) -> Found:
    """:func:`alternate` in one of the ways of ``TURNS``, with as many evaluations in all."""
    inner = min(way["inner"], max(1, evaluations // 2))
    turns = max(1, evaluations // (2 * inner))
    return alternate(
        known.problem, known.start, plan, turns=turns, inner=inner, method=way["method"], first=way["first"]
    )


def best_turns(practice: Case, plan: Plan, evaluations: int) -> tuple[dict, list[dict]]:
    """The way of ``TURNS`` with the least mean energy on practice clips, and a row for every way."""
    rows = [_rows([way], practice, in_turns(practice, plan, way, evaluations), len(practice))[0] for way in TURNS]
    best = min(range(len(rows)), key=lambda k: rows[k]["energy"])
    return TURNS[best], rows


def best_lbfgs(
    practice: Case, evaluations: int, weights: Sequence[float] = (1.0, 10.0, 100.0)
) -> tuple[Plan, list[dict[str, float]]]:
    """The weight of the L1 consistency with which L-BFGS ends best, as a plan, and a row for every weight."""
    many = practice.rows(torch.arange(len(practice)).repeat(len(weights)))
    form = Form(1, torch.tensor(weights).repeat_interleave(len(practice)))
    rows = _rows(
        [{"weight": w} for w in weights], many, lbfgs(many.problem, many.start, Plan(form), evaluations), len(practice)
    )
    best = min(range(len(rows)), key=lambda k: rows[k]["energy"])
    return Plan(Form(1, weights[best])), rows


@dataclass(frozen=True)
class Tuned:
    """What the practice clips chose: a plan for each of ``SEARCHES``, one for L-BFGS, a way of ``TURNS``; and a row
    for every search, as a table shows it."""

    plans: dict[str, Plan]
    newton: Plan
    way: dict
    rows: list[dict[str, object]]


def tune_all(practice: Case, evaluations: int) -> Tuned:
    """Every search on the same clips, each with as many evaluations."""
    plans, rows = {}, []

    def note(name: str, grid: str, chosen: str, tried: list[dict[str, float]]) -> None:
        energies = sorted(row["energy"] for row in tried)
        rows.append({
            "search": name, "grid": grid, "chosen": chosen, "settings": len(tried), "energy": energies[0],
            "median of the grid": energies[len(energies) // 2],
        })  # fmt: skip

    for name, search in SEARCHES.items():
        best, tried = tune(practice, search, evaluations)
        plans[name] = search.make(**best)
        note(name, text(search.grid), text(best), tried)
    newton, tried = best_lbfgs(practice, evaluations)
    note("L1, L-BFGS", text({"weight": tuple(r["weight"] for r in tried)}), text({"weight": newton.form.weight}), tried)
    way, tried = best_turns(practice, plans["L1"], evaluations)
    note("z and x in turns", "; ".join(text(t) for t in TURNS), text(way), tried)
    return Tuned(plans, newton, way, rows)
