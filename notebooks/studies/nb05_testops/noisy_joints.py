"""Two tests in 3-D, joints with noise and low joints hidden, with every method scored by the same rules.

Contacts of all methods follow from the heights and speeds of their joints, those of stage 3 too: its own labels would
be judged by another rule than its rivals'.
"""

from collections.abc import Mapping
from functools import partial
from itertools import product

import torch
from torch import Tensor

from motionlab.humor.energies import JOINTS, KEYPOINTS
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from studies.nb05_testops import contenders, tuning
from studies.nb05_testops.filmed_people import People
from studies.shared import joints

#: The weights of each test.
TESTS = {"noise": JOINTS, "low joints hidden": KEYPOINTS}
MEASURES = {"all cm": "all joints, cm", "hidden cm": "hidden joints, cm",
            "acceleration error m/s^2": "acceleration off, m/s^2", "contact F1": "contact F1",
            "slide mm": "slide, mm a frame"}  # fmt: skip
Tried = Mapping[tuple[str, str], Mapping[str, Mapping[str, Tensor]]]  # people and test -> method -> measure -> (P,)


def compared(
    test: str, tested: People, practice: People, priors: Priors, schedule: Schedule, generator: torch.Generator,
    **tried_out: object,
) -> tuple[dict[str, dict[str, Tensor]], list[dict[str, float]], tuning.Choice]:  # fmt: skip
    """Fits people's joints by every method; numbers of each by measure, one (P,) a person.

    Each filter is tuned on practice clips; the better of the two by the clips themselves counts, to its advantage. Also
    the grid that stage 2 was tuned on, and what was chosen. tried_out: goes to ``tuning.search``.
    """
    weights, rest = TESTS[test], contenders.mean_pose(priors.pose)
    shown = partial(joints.noisy, generator=generator) if test == "noise" else joints.low_hidden
    seen, tried = shown(tested.truth), shown(practice.truth)
    rows = tuning.search(tried, practice.truth, priors, weights, schedule, align="none", **tried_out)
    chosen = tuning.best(rows)
    fitted = fit(seen, priors, weights=weights, schedule=schedule)
    filters = [contenders.tuned(some, tried, practice.truth.positions, rest) for some in contenders.FILTERS]
    filtered = [each(seen, rest) for each in filters]
    found = {
        "best filter": min(filtered, key=lambda x: (x - tested.truth.positions).norm(dim=-1).mean().item()),
        "stage 2": fitted.stages[2].positions,
        "tuned stage 2": tuning.stage_2(seen, priors, weights, schedule, chosen).positions,
        "stage 3": fitted.motion.positions,
        "the truth itself": tested.truth.positions,
    }
    scores = {n: contenders.measures(each, tested.truth, seen.visible) for n, each in found.items()}
    return {n: {m: tested.mean(x) for m, x in row.items()} for n, row in scores.items()}, rows, chosen


def rows(found: Tried) -> list[dict[str, object]]:
    """Returns a row per source, test and method: means over people."""
    return [
        {"people": source, "test": test, "method": method}
        | {head: numbers[measure].nanmean().item() for measure, head in MEASURES.items()}
        for (source, test), by_method in found.items()
        for method, numbers in by_method.items()
    ]


def chosen_rows(found: Tried, chosen: Mapping[tuple[str, str], tuning.Choice]) -> list[dict[str, object]]:
    """Returns a row per source and test: what stage 2 was tuned to, and the error by which the test is judged."""
    made = []
    for (source, test), by in found.items():
        off = {n: by[n][JUDGED[test]].nanmean() for n in SHOWN}
        seen = {n: by[n]["visible cm"].nanmean() for n in SHOWN}
        exact = "" if test == "noise" else " and ".join(f"{x:.1f}" for x in seen.values())
        made.append(
            {"people, test": f"{source}, {test}", "stage 2 is tuned to": tuning.said(chosen[source, test])}
            | {f"{n}, cm": f"{x:.2f}" for n, x in off.items()}
            | {"joints that were seen exactly, cm": exact}
        )
    return made


def rows_of_figure(found: Tried) -> tuple[list[dict[str, dict[str, Tensor]]], tuple[str, ...]]:
    """Returns a figure's rows, by people and test and by method, numbers (P,), and the label of each row."""
    shown = {
        "joint error (cm)": ("noise", "all cm"), "acceleration error (m/s²)": ("noise", "acceleration error m/s^2"),
        "error of hidden joints (cm)": ("low joints hidden", "hidden cm"),
    }  # fmt: skip
    rows = [
        {
            f"{source}, {test}": {name: row[measure] for name, row in by.items() if name != "the truth itself"}
            for (source, test), by in found.items() if test == which
        }
        for which, measure in shown.values()
    ]  # fmt: skip
    return rows, tuple(shown)


#: What a test is judged by, and the names of its duels in ``claims.toml``.
JUDGED = {"noise": "all cm", "low joints hidden": "hidden cm"}
SHOWN = ("tuned stage 2", "stage 3")


def duels(sources: Mapping[str, object]) -> list[tuple[str, str, str, str]]:
    """Returns every duel of stage 3: source, test, the ledger's name of it, and the rival."""
    (noise, hidden), twos = TESTS, ("stage 2", "tuned stage 2")
    kinds = [*((noise, "polish", two) for two in twos), (noise, "smoothing", "best filter")]
    kinds += [(hidden, "hidden", two) for two in twos]
    return [(source, *kind) for source in sources for kind in kinds]


def pairs(sources: Mapping[str, object]) -> list[tuple[str, str]]:
    """Returns every source with every test."""
    return list(product(sources, TESTS))
