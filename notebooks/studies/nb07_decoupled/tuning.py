"""The settings of every decoupled search, chosen on clips that no table uses.

A walk over ladders: a setting and its neighbours, one rung up or down on each ladder, are tried in one batch; the best
of them is where the next look begins; the walk ends where no neighbour is better, so that what it chooses lies at no
edge of what was tried. A search is judged by what all searches are judged by, the stage-3 energy of the exact roll-out,
unless another measure is named; ties and numbers that are not finite lose.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from motionlab.humor.stages import Problem
from studies.nb07_decoupled.energy import Form, Unknown
from studies.nb07_decoupled.search import Found, Plan, Watch, X, Z, adam, alternate, lbfgs
from studies.nb07_decoupled.trials import Case, judged, reference

Setting = dict[str, float]
#: The rungs of steps and of weights, and of the share of x that is overwritten.
LADDER = (1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
SHARES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9)


@dataclass(frozen=True)
class Search:
    """A way to search. make: its plan from one number, or one tensor (n,), for each name in ``begin``.

    begin: where the walk begins. method: what does the searching. ladders: other rungs than ``LADDER``, by name.
    measure: what is to be least. also: settings far from the beginning that the first look tries, too, so that the walk
    goes on from the best of several places.
    """

    make: Callable[..., Plan]
    begin: Mapping[str, float]
    method: Callable[..., Found] = adam
    ladders: Mapping[str, Sequence[float]] | None = None
    measure: str = "energy"
    also: Sequence[Setting] = ()

    def neighbours(self, at: Mapping[str, float]) -> Iterator[Setting]:
        """The settings one rung up or down from another, one ladder at a time; none beyond a ladder's end."""
        for name, value in at.items():
            ladder = (self.ladders or {}).get(name, LADDER)
            k = ladder.index(value)
            yield from ({**at, name: ladder[j]} for j in (k - 1, k + 1) if 0 <= j < len(ladder))


def _loss(rate_x, rate_z, weight, steps=1) -> Plan:
    return Plan(Form(steps, weight), rate_x=rate_x, rate_z=rate_z)


def _detached(rate_x, rate_z, weight) -> Plan:
    return Plan(Form(1, weight, detached=True), rate_x=rate_x, rate_z=rate_z)


def _copied(rate_x, rate_z) -> Plan:
    return Plan(Form(1, 0.0), rate_x=rate_x, rate_z=rate_z, share=1.0)


def _blended(rate_x, rate_z, share) -> Plan:
    return Plan(Form(1, 0.0), rate_x=rate_x, rate_z=rate_z, share=share)


def _weighed(weight) -> Plan:
    return Plan(Form(1, weight))


def _x_alone(rate_x, weight) -> Plan:
    return Plan(Form(1, weight), moving=X, rate_x=rate_x, settle=False)


#: K = 1 throughout; L1 takes every number of a state alike, as the thesis does.
#: The walks begin where earlier ones on the same practice clips, begun elsewhere, ended.
SEARCHES = {
    "copy": Search(_copied, {"rate_x": 3e-5, "rate_z": 0.001}),
    "blend": Search(_blended, {"rate_x": 3e-5, "rate_z": 3e-4, "share": 0.01}, ladders={"share": SHARES}),
    "L1": Search(_loss, {"rate_x": 0.01, "rate_z": 0.01, "weight": 30.0}),
    "L1, z detached": Search(_detached, {"rate_x": 0.01, "rate_z": 1e-4, "weight": 100.0}),
    "L1, L-BFGS": Search(_weighed, {"weight": 10.0}, method=lbfgs),
}
#: For clips of its own length, and by what it is wanted for: the legs of the persistent states.
FIXED_Z = Search(_x_alone, {"rate_x": 0.03, "weight": 10.0}, measure="kept legs")


def in_turns(
    problem: Problem,
    start: Unknown,
    plan: Plan,
    evaluations: int,
    *,
    method: str,
    inner: int,
    first: str,
    watch: Watch | None = None,
) -> Found:
    """:func:`alternate` with no more evaluations than so many in all; ``inner`` of them a block, 0 for half of all."""
    inner = max(1, min(inner or evaluations, evaluations // 2))
    turns = max(1, evaluations // (2 * inner))
    return alternate(problem, start, plan, turns=turns, inner=inner, method=method, first=first, watch=watch)


#: Ways to move z and x in turns: what searches within a block, the evaluations of a block, and which of the two begins.
#: L-BFGS finds its steps. The walks begin where earlier ones, with steps of one length for both, ended.
TURNS = {
    f"turns: {inner or 'half'}, {first} first": Search(
        _loss,
        {"rate_x": rate, "rate_z": rate, "weight": weight},
        method=partial(in_turns, method="adam", inner=inner, first=first),
    )
    for inner, first, rate, weight in (
        (25, "z", 0.01, 10.0),
        (25, "x", 0.01, 10.0),
        (100, "z", 0.01, 3.0),
        (0, "z", 0.003, 10.0),
    )
} | {
    "turns: L-BFGS, 50, z first": Search(
        _weighed, {"weight": 3.0}, method=partial(in_turns, method="lbfgs", inner=50, first="z")
    )
}


def l1_of(steps: int) -> Search:
    """The L1 search with K decoding steps, x and z with a step each; it begins where earlier walks ended."""
    rate, weight = {5: (0.1, 10.0), 10: (0.03, 3.0)}.get(steps, (0.01, 10.0))
    return Search(partial(_loss, steps=steps), {"rate_x": rate, "rate_z": rate, "weight": weight})


def _of_loss(rate_x: float, rate_z: float, weight: float) -> Setting:
    return {"rate_x": rate_x, "rate_z": rate_z, "weight": weight}


#: From a z that encodes sitting, where long steps lose what is given: the searches that begin there, with short steps
#: of z, and the places far from these that they look at as well, such as where walks from stage 2's z end.
FAR = (_of_loss(1e-5, 1e-5, 1.0), _of_loss(1e-4, 1e-4, 1.0), _of_loss(0.03, 1e-4, 1.0), _of_loss(0.01, 0.01, 10.0))
GOOD_Z = {
    "L1": replace(SEARCHES["L1"], begin=_of_loss(0.01, 3e-6, 1.0), also=FAR),
    "L1, z detached": replace(SEARCHES["L1, z detached"], begin=_of_loss(3e-5, 1e-4, 0.1), also=FAR),
} | {
    name: replace(way, begin=_of_loss(0.01, 1e-5, 1.0), also=(_of_loss(3e-5, 3e-5, 0.01), *FAR))
    if way.make is _loss
    else replace(way, also=({"weight": 0.03}, {"weight": 100.0}))
    for name, way in TURNS.items()
}


@dataclass(frozen=True)
class Choice:
    """What a walk chose. rows: every setting tried, with its measures, means over the clips. ended: the chosen setting
    has neighbours on either side and none is better; otherwise the walk was cut off, or came to the end of a ladder.
    seconds: processor time of the walk, without the fits of its clips."""

    setting: Setting
    rows: list[dict[str, float]]
    ended: bool
    seconds: float = 0.0


def tune(
    practice: Case,
    search: Search,
    evaluations: int,
    *,
    rounds: int = 4,
    start: Mapping[str, Tensor] | None = None,
) -> Choice:
    """Walk to the setting with the least mean of the measure over the practice clips, ``rounds`` looks at most.

    start: unknowns to search from, unless those of the practice clips.
    """
    at, tried, began = dict(search.begin), {}, time.process_time()

    def key(setting: Setting) -> tuple[float, ...]:
        return tuple(setting[n] for n in search.begin)

    for _ in range(rounds):
        look = {key(s): s for s in (at, *search.neighbours(at), *search.also)}
        new = [s for k, s in look.items() if k not in tried]
        found = _tried(practice, search, new, evaluations, start or practice.start)
        tried |= {key(s): row for s, row in zip(new, found, strict=True)}
        least = min(tried, key=lambda k: tried[k][search.measure])
        if least == key(at):
            inside = len(list(search.neighbours(at))) == 2 * len(at)
            return Choice(at, list(tried.values()), inside, time.process_time() - began)
        at = dict(zip(search.begin, least, strict=True))
    return Choice(at, list(tried.values()), False, time.process_time() - began)


def _tried(
    practice: Case, search: Search, settings: Sequence[Setting], evaluations: int, start: Unknown
) -> list[dict[str, float]]:
    clips = len(practice)
    index = torch.arange(clips).repeat(len(settings))
    many = practice.rows(index)
    columns = {n: torch.tensor([s[n] for s in settings]).repeat_interleave(clips) for n in search.begin}
    begun = {n: x[index] for n, x in start.items()}
    found = search.method(many.problem, begun, search.make(**columns), evaluations)
    means = {
        n: x.unflatten(0, (-1, clips)).mean(-1).nan_to_num(nan=float("inf")).tolist()
        for n, x in judged(many, found.unknown).items()
    }
    return [{**s, **{n: means[n][k] for n in ("energy", "legs", "kept legs", "gap")}} for k, s in enumerate(settings)]


def again(
    practice: Case, search: Search, choice: Choice, evaluations: int, start: Mapping[str, Tensor] | None = None
) -> dict[str, float]:
    """The chosen setting once more, with its measures: a walk on record against the code that reads it."""
    return _tried(practice, search, [choice.setting], evaluations, start or practice.start)[0]


def least(choice: Choice, measure: str = "energy") -> float:
    """The measure of what was chosen."""
    return min(row[measure] for row in choice.rows)


def best(choices: Mapping[str, Choice]) -> str:
    """The search whose chosen setting has the least energy."""
    return min(choices, key=lambda name: least(choices[name]))


#: Steps of z that are tried where x is fixed.
RATES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)


def rate_of_z(practice: Case, form: Form, evaluations: int) -> dict[float, float]:
    """Steps of constant size for z, x fixed at the whole fit: for each of ``RATES`` the decoupled energy, mean of the
    practice clips and of the last tenth of the evaluations. The truth has no part in it."""
    index = torch.arange(len(practice)).repeat(len(RATES))
    begun = {n: x[index] for n, x in {**reference(practice), "z": practice.start["z"]}.items()}
    rates = torch.tensor(RATES).repeat_interleave(len(practice))
    found = adam(practice.rows(index).problem, begun, Plan(form, moving=Z, rate_z=rates, settle=False), evaluations)
    last = found.history[-max(1, evaluations // 10) :].mean(0).nan_to_num(nan=float("inf"))
    return dict(zip(RATES, last.unflatten(0, (len(RATES), -1)).mean(1).tolist(), strict=True))


def told(name: str, choice: Choice, measure: str = "energy") -> dict[str, object]:
    """A walk as a row of a table: what it chose, how much that is better than the runner-up, and where it ended."""
    found = sorted(row[measure] for row in choice.rows)
    return {
        "search": name, "chosen": text(choice.setting), "settings tried": len(found), measure: found[0],
        "next best": found[1] if len(found) > 1 else "-", "worst": found[-1], "no neighbour better": choice.ended,
    }  # fmt: skip


def text(values: Mapping[str, object]) -> str:
    """A setting as a person reads it: "rate_x 0.01, weight 10"."""
    return ", ".join(f"{n} {x:g}" if isinstance(x, float) else f"{n} {x}" for n, x in values.items())
