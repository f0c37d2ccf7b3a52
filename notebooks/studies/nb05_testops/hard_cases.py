"""Notebook 05b: the cases of thesis 3.2 on synthetic and on real people, the rival of each, and who is compared how.

A case of a source is (case, source); the unit is the person, and every synthetic clip shows another one.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from data_synth import corrupt, scenes
from data_synth.scenes import Scene
from motionlab import metrics
from motionlab.contact import with_contacts
from motionlab.footage.fit import landmarks_of
from motionlab.humor.energies import RGB_LIGHT, Weights
from motionlab.metrics import Paired, paired
from motionlab.motion import Motion
from studies.nb05_testops import cast as clips_of
from studies.nb05_testops import measures
from studies.nb05_testops.cast import Cast, by_person
from studies.nb05_testops.trials import scores
from studies.nb05_testops.tuning import Choice
from studies.shared.clips import FRAMES, everyday, goes, takes
from studies.shared.sitting import seated, sits

SYNTHETIC, CMU = "synthetic", "CMU"
Case = tuple[str, str]
PLAIN, FLIPS, FALSE, SITS, SINKS = "plain view", "legs change sides", "false detections", "sits, desk", "crouches, desk"
WALL, WALKS, FLOOR, TUMBLE, DANCE = "walks, low wall", "walks", "on the floor", "tumble", "dance"
#: Case -> the practice case that its rival is tuned on, and by which error.
TUNED_ON = {
    PLAIN: (PLAIN, "all"), FLIPS: (FLIPS, "legs"), FALSE: (FALSE, "all"), SITS: (SITS, "legs"), SINKS: (SITS, "legs"),
    WALL: (WALL, "legs"), WALKS: (PLAIN, "all"), FLOOR: (FLOOR, "all"), TUMBLE: (FLOOR, "all"), DANCE: (PLAIN, "all"),
}  # fmt: skip
ALL = tuple(TUNED_ON)
#: How the detector fails in a recorded case: legs change sides, and confident keypoints lie on the background.
FAILS = {FLIPS: {"how": corrupt.flip_limbs, "share": 0.2, "length": 4},
         FALSE: {"how": corrupt.false_detections, "share": 0.08, "length": 6}}  # fmt: skip
#: The ablations of sitting: which weights of stage 3 are zero.
ARMS = {
    "no densities of z and x0": ("motion_prior", "init_motion_prior"),
    "no contact terms": ("contact_vel", "contact_height"),
    "decoder alone": ("motion_prior", "init_motion_prior", "contact_vel", "contact_height"),
}


# ------------------------------------------------------------------------------------------------ who is filmed
def synthetic(cases: Sequence[str], clips: int, seed: int, frames: int) -> dict[Case, Scene]:
    """Films ``clips`` synthetic people in each case."""
    as_filmed = {PLAIN: "easy", FLIPS: "limb flips", FALSE: "false detections", WALL: "walking, legs hidden",
                 WALKS: "walking", FLOOR: "floor roll", TUMBLE: "tumble", DANCE: "dance"}  # fmt: skip

    def shot(case: str) -> Scene:
        if case in as_filmed:
            return scenes.film(as_filmed[case], clips, seed=seed, frames=frames)
        if case == SINKS:
            return _shot(case, _crouchers(clips, seed), seed, frames)
        return _shot(case, clips_of.acted("sit", clips_of.sits_down, clips, seed, seconds=1.0), seed, frames)

    return {(case, SYNTHETIC): shot(case) for case in cases}


def _crouchers(clips: int, seed: int) -> Cast:
    """Half of them crouch, half go down on a knee to the floor."""
    crouch = clips_of.acted("crouch", clips_of.sinks, clips - clips // 2, seed)
    kneel = clips_of.acted("floor", clips_of.sinks, clips // 2, seed, rolls=0, way="kneel")
    return crouch + [(f"{who}, kneeling", motion) for who, motion in kneel]


def real(
    folder: Path | None, part: str, cases: Sequence[str], clips: int, seed: int, frames: int
) -> tuple[dict[Case, Scene], dict[Case, tuple[str, ...]]]:
    """Films at most ``clips`` clips of CMU's people of one part in each case, half as many again in plain view; also
    who they are. Nothing without recordings."""
    if folder is None:
        return {}, {}
    some = takes(folder, part)
    cast = {PLAIN: everyday(some, clips + clips // 2), FLIPS: everyday(some, clips)}
    cast[FALSE] = cast[FLIPS]
    drawn = {SITS: (clips_of.sits_down, 2, ""), SINKS: (clips_of.sinks, 1, ""), WALKS: (goes, 1, "walk"),
             FLOOR: (clips_of.lies, 2, ""), DANCE: (clips_of.lively, 2, "danc|salsa|macarena")}  # fmt: skip
    cast |= {case: clips_of.who(some, fits, each, clips + 2, seed, said) for case, (fits, each, said) in drawn.items()}
    cast[WALL] = cast[WALKS]
    found = {(case, CMU): _shot(case, cast[case], seed, frames) for case in cases if len(cast.get(case, ()))}
    return found, {key: tuple(who for who, _ in cast[key[0]]) for key in found}


def _shot(case: str, cast: Cast, seed: int, frames: int) -> Scene:
    """Films a cast in the view of a case, every so manieth frame in a short run, and lets the detector fail where the
    case says so."""
    view = {SITS: "legs behind a desk", SINKS: "legs behind a desk", WALL: "behind a low wall"}.get(case, "plain view")
    step = FRAMES // frames
    cut = [replace(m, root=m.root[::step], rot=m.rot[::step], contacts=m.contacts[::step]) for _, m in cast]
    scene = scenes.film_recorded(view, cut, seed=seed)
    return clips_of.spoilt(scene, seed=seed, **FAILS[case]) if case in FAILS else scene


def hidden_below(motion: Motion, height: float, seed: int) -> Scene:
    """Films one clip (T,) in plain view and hides every keypoint below a height in metres."""
    scene = scenes.film_recorded("plain view", [with_contacts(motion)], seed=seed)
    observation, _ = corrupt.occlude_below(scene.observation, landmarks_of(scene.truth), height)
    return replace(scene, observation=observation, seen=scenes.joints_seen(observation.visible, motion.skeleton.names))


def practice(folder: Path | None, clips: int, seed: int, frames: int) -> dict[Case, Scene]:
    """Films the clips on which rivals are tuned: other synthetic people, and CMU's validation people; none for 0."""
    if not clips:
        return {}
    tasks = list(dict.fromkeys(task for task, _ in TUNED_ON.values()))
    return synthetic(tasks, clips, seed, frames) | real(folder, "val", tasks, clips, seed, frames)[0]


def rows(filmed: Mapping[Case, Scene], people: Mapping[Case, Sequence[str]]) -> list[dict[str, object]]:
    """Returns a row per case and source: clips, people, what is seen and what is wrong."""
    return [
        {"case": case, "source": source, "clips": len(s),
         "people": len(set(people.get((case, source), range(len(s))))),
         "leg joints seen, %": 100 * s.seen[..., metrics.legs(s.truth)].float().mean().item(),
         "false detections, %": 100 * s.wrong.float().mean().item()}
        for (case, source), s in filmed.items()
    ]  # fmt: skip


def of(some: Iterable[Case], *cases: str) -> list[Case]:
    """Returns those of some (case, source) that are of the cases named."""
    return [key for key in some if key[0] in cases]


# -------------------------------------------------------------------------------------------------- who is compared
def rivals(found: Mapping[Choice, Mapping[Case, Mapping[str, Tensor]]], cases: Sequence[Case]) -> dict[Case, Choice]:
    """Chooses each case's stage 2 on the practice clips of its own task and source."""

    def error(rival: Choice, case: str, source: str) -> float:
        task, measure = TUNED_ON[case]
        return found[rival][task, source][measure].nanmean().item()

    return {key: min(found, key=lambda rival, key=key: error(rival, *key)) for key in cases}


def without(arm: str) -> Weights:
    """Returns the weights of an ablation: the usual ones, some of stage 3's at zero."""
    return replace(RGB_LIGHT, **dict.fromkeys(ARMS[arm], (0.0, 0.0, 0.0)))


def scored(found: Mapping[Case, Motion], filmed: Mapping[Case, Scene]) -> dict[Case, dict[str, Tensor]]:
    """Computes ``trials.scores`` of the fits of all cases."""
    return {key: scores(motion, filmed[key].truth) for key, motion in found.items()}


def differences(
    ours: Mapping[Case, Mapping[str, Tensor]], theirs: Mapping[Case, Mapping[str, Tensor]],
    people: Mapping[Case, Sequence[str]], measures_: Sequence[str], generator: Callable[[str], torch.Generator],
) -> dict[str, list[tuple[str, str, Paired]]]:  # fmt: skip
    """Computes by measure the mean difference over people of every case and source, with its interval."""

    def less(key: Case, name: str) -> Paired:
        by = [by_person(x[key][name], people.get(key)) for x in (ours, theirs)]
        return paired(*by, generator(f"{key}/{name}"))

    return {name: [(*key, less(key, name)) for key in ours] for name in measures_}


def posture(ways: Mapping[str, Motion], truth: Motion) -> dict[str, dict[str, Tensor]]:
    """Computes by way, one number a clip: who sits ("seated"), whose legs are bent ("bent"), the error of the flexion
    in degrees ("flexion") and of the legs in cm ("legs")."""
    when = measures.moment(truth)
    return {
        way: {"seated": seated(motion, when), "bent": sits(motion, when),
              "flexion": measures.flexion_error(motion, truth), "legs": scores(motion, truth)["legs"]}
        for way, motion in ways.items()
    }  # fmt: skip


def crouchers(count: int, seed: int) -> dict[str, Tensor]:
    """Computes ``posture`` of the true motion of so many synthetic people who crouch or go down on a knee."""
    truth = scenes.together([motion for _, motion in _crouchers(count, seed)])
    return posture({"truth": truth}, truth)["truth"]


def swings(
    ways: Mapping[str, Mapping[int, Motion]], scene: Scene, people: Sequence[str] | None
) -> dict[str, dict[int, Tensor]]:
    """Computes by way and length of the failure how far the hidden legs swing (P,) over the true swing, by person; of
    clips in which they are hidden in ten frames or more."""
    hidden = ~scene.seen[..., metrics.legs(scene.truth)].any(-1)

    def over_true(motion: Motion) -> Tensor:
        ratio = measures.swing(motion, hidden) / measures.swing(scene.truth, hidden)
        values = by_person(torch.where(hidden.sum(-1) >= 10, ratio, torch.nan), people)
        return values[values.isfinite()]

    return {way: {n: over_true(m) for n, m in by_lead.items()} for way, by_lead in ways.items()}


def lateness(ways: Mapping[str, Motion], truth: Motion) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
    """Computes by way the error over time (B, T) in cm, and its means (B,) over the first and the last quarter."""
    off = {way: metrics.joint_errors(motion.positions, truth.positions, align="root") for way, motion in ways.items()}
    return {way: (100 * x.mean(-1), *measures.quarters(100 * x.mean(-1))) for way, x in off.items()}


def panels(truth: Motion, fits: Mapping[str, Motion], index: int = 0) -> dict[str, Motion]:
    """Returns one clip's truth and fits, as a film shows them."""
    return {"truth": truth.clip(index)} | {name: motion.clip(index) for name, motion in fits.items()}


def by_part(
    parts: Mapping[str, Mapping[Case, Motion]], sitters: Mapping[Case, Scene], people: Mapping[Case, Sequence[str]]
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, Tensor]]]:
    """Computes by source and part of a fit the share of clips that sit, and the error of the legs in cm by person."""
    shares, off = {}, {}
    for key, scene in sitters.items():
        found = posture({name: motions[key] for name, motions in parts.items()}, scene.truth)
        shares[key[1]] = {name: x["seated"].mean().item() for name, x in found.items()}
        off[key[1]] = {name: by_person(x["legs"], people.get(key)) for name, x in found.items()}
    return shares, off


def failures(
    three: Mapping[int, Tensor], two: Mapping[int, Tensor], short: int, long: int
) -> dict[str, tuple[Tensor, Tensor]]:
    """Returns what H05 asks of stages 3 and 2, by test: the swing, or what a failure of so many frames costs."""
    asked = {"walks": (-1, None), "stops": (short, None), "cause": (short, -1), "dose": (long, -1)}
    less = lambda x, n, other: x[n] if other is None else x[n] - x[other]  # noqa: E731
    return {test: (less(three, *which), less(two, *which)) for test, which in asked.items()}


def smoothing(
    dance: Case, power: Mapping[Case, Mapping[str, Tensor]], stages: Mapping[int, Motion], truth: Motion,
    people: Sequence[str] | None,
) -> list[tuple[str, str, Tensor, Tensor]]:  # fmt: skip
    """Returns what H08 asks of a dance: test, statistic, and numbers of stages 3 and 2 by person.

    power: case -> way -> power over true power (B, bands); the second band holds the accents.
    """
    band = [by_person(power[dance][f"stage {k}"][:, 1], people) for k in (3, 2)]
    more = [x - power[WALKS, dance[1]][f"stage {k}"][:, 1].mean() for k, x in zip((3, 2), band, strict=True)]
    calm = [by_person(measures.acceleration_ratio(stages[k], truth), people) for k in (3, 2)]
    return [("band", "median", *band), ("acceleration", "mean", *calm), ("stylised", "mean", *more)]
