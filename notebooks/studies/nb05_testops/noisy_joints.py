"""Two tests in 3-D, joints with noise and low joints hidden, with every method scored by the same rules.

Contacts of all methods follow from the heights and speeds of their joints, those of stage 3 too: its own labels would
be judged by another rule than its rivals'.
Source: HuMoR (Rempe et al. 2021), section 5.2: global errors without alignment, of joints with 4 cm of noise and of
joints seen only above 0.9 m.
"""

from collections.abc import Mapping
from functools import partial
from itertools import product

import torch
from torch import Tensor

from motionlab import metrics
from motionlab.baselines import between_known, kalman, savitzky_golay
from motionlab.contact import contacts_from_positions, resting_heights
from motionlab.humor import start as starts
from motionlab.humor.energies import JOINTS, KEYPOINTS
from motionlab.humor.evidence import Observation3D, evidence
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.motion import Motion
from motionlab.skeleton import FEET, STANDARD, fk
from studies.nb05_testops import tuning
from studies.nb05_testops.cast import People
from studies.nb05_testops.measures import CM
from studies.shared import joints

#: What a test is judged by, and the names of its duels in ``claims.toml``.
JUDGED = {"noise": "all cm", "low joints hidden": "hidden cm"}
SHOWN = ("tuned stage 2", "stage 3")


def laid(observation: Observation3D, rest: Tensor) -> Tensor:
    """The mean pose (22, 3), root at the origin, laid onto what is seen: positions (B, T, 66), metres.

    Where a joint was seen its offset from the mean pose is known; between, it is interpolated; a joint that never was
    seen keeps the mean pose.
    """
    seen = evidence(observation)
    trans, turn = starts.interpolate_unseen(*starts.start_3d(seen, rest), seen.fps)
    placed, known = rest @ turn.mT + trans[..., None, :], seen.weight > 0
    offset = seen.values - placed
    before, after, share = between_known(known)
    low, high = (offset.gather(1, at[..., None].expand_as(offset)) for at in (before, after))
    between = torch.lerp(low, high, share[..., None].clamp(0, 1).to(offset))
    return (placed + torch.where(~known.any(1)[:, None, :, None], 0.0, between)).flatten(-2)


def _polynomial(x: Tensor, fps: float, frames: int, degree: int) -> Tensor:
    window = min(frames, x.shape[1] - 1 + x.shape[1] % 2)
    return savitzky_golay(x, window, degree) if window > degree else x


#: What is tried of either kind.
FILTERS = (
    [partial(_polynomial, frames=a, degree=b) for a, b in product((5, 7, 9, 11, 15, 21), (2, 3))],
    [partial(kalman, noise=0.04, acceleration=b) for b in (0.3, 0.6, 1.0, 2.0, 4.0, 8.0)],
)


def best_filter(seen: Observation3D, truth: Tensor, tried: Observation3D, practice: Tensor, rest: Tensor) -> Tensor:
    """Positions (B, T, 22, 3) without a model of motion: the mean pose :func:`laid` onto what is seen, and a filter
    over time. Each kind is tuned on practice clips; the better of the two by the clips themselves, to its advantage."""

    def off(x: Tensor, true: Tensor) -> float:
        return (x.unflatten(-1, (-1, 3)) - true).norm(dim=-1).mean().item()

    before, now = laid(tried, rest), laid(seen, rest)
    tuned = [min(kind, key=lambda each: off(each(before, tried.fps), practice)) for kind in FILTERS]
    return min((each(now, seen.fps) for each in tuned), key=lambda x: off(x, truth)).unflatten(-1, (-1, 3))


def mean_pose(pose_prior) -> Tensor:
    """Joints (22, 3) of the pose prior's zero latent: root at the origin, orientation identity."""
    with torch.no_grad():
        body = torch.cat((torch.eye(3)[None], pose_prior.decode(torch.zeros(32))))
    return fk(STANDARD, torch.zeros(3), body)[0]


def measures(p: Tensor, truth: Motion, visible: Tensor) -> dict[str, Tensor]:
    """Errors of positions (B, T, 22, 3) by measure, each (B,): world, no alignment; NaN where nothing of a kind is
    there.

    truth (B, T) with contacts; visible (B, T, 22). Contacts follow from the heights and speeds of joints. slide: of
    feet where the true foot stands, mm per frame.
    """
    t, skeleton = truth.positions, truth.skeleton
    seen, hidden = (metrics.mpjpe(p, t, align="none", mask=which) for which in (visible.bool(), ~visible.bool()))
    feet = skeleton.indices(list(FEET))
    touching = contacts_from_positions(p[..., skeleton.contact_indices, :], truth.fps, resting_heights(STANDARD))
    return {
        "all cm": CM * metrics.mpjpe(p, t, align="none"), "visible cm": CM * seen, "hidden cm": CM * hidden,
        "acceleration error m/s^2": metrics.acceleration_error(p, t, truth.fps),
        "contact F1": metrics.contact_f1(touching, truth.contacts),
        "slide mm": metrics.slide_where_truth_stands_mm(p[..., feet, :], t[..., feet, :]),
    }  # fmt: skip


# ------------------------------------------------------------------------------------------------ the two tests
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

    Also the grid that stage 2 was tuned on, and what was chosen. tried_out: goes to ``tuning.search``.
    """
    weights, rest = TESTS[test], mean_pose(priors.pose)
    shown = partial(joints.noisy, generator=generator) if test == "noise" else joints.low_hidden
    seen, tried = shown(tested.truth), shown(practice.truth)
    rows = tuning.search(tried, practice.truth, priors, weights, schedule, align="none", **tried_out)
    chosen = tuning.best(rows)
    fitted = fit(seen, priors, weights=weights, schedule=schedule)
    found = {
        "best filter": best_filter(seen, tested.truth.positions, tried, practice.truth.positions, rest),
        "stage 2": fitted.stages[2].positions,
        "tuned stage 2": tuning.stage_2(seen, priors, weights, schedule, chosen).positions,
        "stage 3": fitted.motion.positions,
        "the truth itself": tested.truth.positions,
    }
    scores = {n: measures(each, tested.truth, seen.visible) for n, each in found.items()}
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
        {f"{source}, {test}": {name: row[measure] for name, row in by.items() if name != "the truth itself"}
         for (source, test), by in found.items() if test == which}
        for which, measure in shown.values()
    ]  # fmt: skip
    return rows, tuple(shown)


def duels(sources: Mapping[str, object]) -> list[tuple[str, str, str, str]]:
    """Returns every duel of stage 3: source, test, the ledger's name of it, and the rival."""
    (noise, hidden), twos = TESTS, ("stage 2", "tuned stage 2")
    kinds = [*((noise, "polish", two) for two in twos), (noise, "smoothing", "best filter")]
    kinds += [(hidden, "hidden", two) for two in twos]
    return [(source, *kind) for source in sources for kind in kinds]
