"""The corpus of real motion in tables: what is in it, how it was resampled, and how good its contact labels are."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import corpus, rotation, subjects
from motionlab.contact import contacts_from_positions, resting_heights
from motionlab.corpus import Corpus, Take
from motionlab.io.recordings import recordings
from motionlab.metrics.gait import contact_scores
from motionlab.motion import Motion, resample, velocity
from motionlab.retarget import retarget
from motionlab.skeleton import FEET

#: Sources of a corpus that may be trained on, the one that exists twice first.
SOURCES = ("cmu_library", "cmu_native", "cmu_amc", "deepmimic", "isaacgym_amp_cmu")
NATIVE, LIBRARY = "cmu_native", "cmu_library"
#: Words of a description or a file's name -> kind of motion; the first that fits.
KINDS = {
    "floor": r"roll|crawl|get(ting)? ?up|lay|lie|lying|fall|floor|yoga|push.?up|sit.?up|swim|stroke",
    "dance": r"danc|salsa|lindy|charleston|waltz|arabesque|pirouette|glissade|ballet|jete|plie",
    "acrobatics": r"flip|cartwheel|hand ?stand|somersault|back ?hand|tumbl",
    "fight": r"punch|box|kick|karate|bassai|empi|heian|gedan|attack|defen|sword|martial|fight|block|strike|shuto",
    "sit": r"\bsit|chair|stool|sofa|motorcycle",
    "climb": r"climb|stair|ladder|playground|steps?\b.*up|uneven|slope",
    "jump": r"jump|hop|leap|skip",
    "run": r"\brun|jog|sprint|dash",
    "sport": r"soccer|golf|putt|swing|tee\b|ball|frisbee|pitch|bunt|dribble|shot|turn cleaned|tight",
    "animal": r"human subject|monkey|chicken|bear|cat |dinosaur|mummy|gorilla|penguin|mickey",
    "walk": r"walk|stride|step|march|navigate|path|limp|creep|pace|stroll|hobble",
    "everyday": r"wash|drink|eat|reach|pick|lift|carry|wave|clean|hammer|saw|screw|story|rhyme|signal|vacation|laugh|"
    r"talk|point|direct|look|open|write|chop|fish|conversation|stretch|bow|idle|wait|vignettes|broom|drop",
}


def load(folder: Path | None, every: int = 1) -> Corpus | None:
    """Assembles the clean recordings of people in a folder, each ``every``-th; None where there is nothing."""
    sources = [source for source in SOURCES if folder and (folder / source).is_dir()]
    return corpus.assemble(folder, sources, every=every, progress=False) if sources else None


def size(found: Corpus | None) -> str:
    """Returns how much there is, in words."""
    if found is None:
        return "nothing, since MOTIONLAB_DATA is not set"
    return f"{_minutes(found.takes):.0f} minutes of {len({take.person for take in found.takes})} people"


def exist_twice(folder: Path | None) -> bool:
    """Returns whether a folder has the same performances at 24 and at 120 frames per second."""
    return bool(folder) and all((folder / source).is_dir() for source in (NATIVE, LIBRARY))


def kind_of(take: Take) -> str:
    """Returns the kind of motion that a take's description speaks of: one of ``KINDS``, or "other"."""
    said = take.said.lower().replace("_", " ")
    return next((kind for kind, words in KINDS.items() if re.search(words, said)), "other")


def cleaned_rows(found: Corpus) -> list[dict[str, object]]:
    """Computes a row per source: recordings, minutes, how many are kept, and minutes cut by fault."""
    faults = sorted({name for row in found.rows for name in row.cut})
    return [
        {"source": row.source, "recordings": row.recordings, "minutes": row.seconds / 60, "kept": row.kept / 60}
        | {name: row.cut.get(name, 0.0) / 60 for name in faults}
        | {"refused files": len(row.refused)}
        for row in found.rows
    ]


def kind_rows(found: Corpus) -> list[dict[str, object]]:
    """Computes a row per kind of motion: minutes in each part, people, and the median speed of the pelvis."""
    rows = []
    for kind, takes in takes_by_kind(found).items():
        speeds = [velocity(t.motion.root[:, :2], t.motion.fps, dim=0).norm(dim=-1) for t in takes]
        minutes = {f"{part}, min": _minutes([t for t in takes if t.part == part]) for part in subjects.PARTS}
        about = {"people": len({t.person for t in takes}), "pelvis, m/s (median)": float(torch.cat(speeds).median())}
        rows.append({"kind": kind} | minutes | about)
    return rows


def takes_by_kind(found: Corpus) -> dict[str, list[Take]]:
    """Returns the takes of each kind of motion, the kind with most minutes first."""
    by_kind: dict[str, list[Take]] = {}
    for take in found.takes:
        by_kind.setdefault(kind_of(take), []).append(take)
    return dict(sorted(by_kind.items(), key=lambda pair: -_minutes(pair[1])))


def _minutes(takes: Sequence[Take]) -> float:
    return sum(t.motion.seconds for t in takes) / 60


# ------------------------------------------------------------------------------------------------------- frame rates
def resampling_rows(folder: Path | str, every: int = 1) -> list[dict[str, object]]:
    """Computes what going from 24 to 30 frames per second costs, a row per way.

    Truth: recordings at 120 frames per second, every fourth frame. Given: every fifth. Means over 22 joints and clips.
    """
    errors: dict[str, list[list[float]]] = {}
    for _, path, load in list(recordings(folder, NATIVE))[::every]:
        motion = retarget(load(path)).motion.to(torch.float64)
        if motion.frames < 300:
            continue
        truth, given = motion.cut(step=4), motion.cut(step=5)
        for how in ("linear", "spline"):
            found = resample(given, 30.0, how)
            n = min(found.frames, truth.frames) - 4
            pair = found.positions[2:n], truth.positions[2:n]
            speeds = [velocity(x, 30.0, dim=0) for x in pair]
            bends = [30.0**2 * (x[2:] - 2 * x[1:-1] + x[:-2]) for x in pair]
            sizes = [float(x.norm(dim=-1).mean()) for x in bends]
            errors.setdefault(how, []).append([1000 * _far(*pair), 100 * _far(*speeds), _far(*bends), *sizes])
    names = ("places, mm", "velocities, cm/s", "accelerations, m/s^2", "mean acceleration", "of the truth")
    return [
        {"way": how, "clips": len(rows), **dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))}
        for how, rows in errors.items()
    ]


def _far(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm(dim=-1).mean())


# --------------------------------------------------------------------------------------------------------- contacts
def contact_rows(folder: Path | str, every: int = 1) -> list[dict[str, object]]:
    """Computes how labels of the library's figure (24 frames per second, no toes) agree with labels of the same
    performances at 120 frames per second with toes, a row per person.

    F1 over the frames of both feet; timing: mean distance in ms of a touch-down or lift-off from the nearest one of its
    kind within 0.3 s.
    """
    library = {path.stem: (path, load) for _, path, load in recordings(folder, LIBRARY)}
    by_person: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for _, path, load in list(recordings(folder, NATIVE))[::every]:
        if path.stem not in library:
            continue
        other, other_load = library[path.stem]
        pair = _aligned(retarget(load(path)).motion, retarget(other_load(other)).motion)
        if pair is not None:
            by_person.setdefault(subjects.person_of(NATIVE, path), []).append(pair)
    rows = []
    for person, pairs in sorted(by_person.items()):
        found, truth = (torch.cat([pair[i] for pair in pairs]) for i in (0, 1))
        scores = contact_scores(found, truth)
        times = [t for a, b in pairs for t in _timing(a, b)]
        means = {"F1": scores.f1, "precision": scores.precision, "recall": scores.recall}
        rows.append(
            {"person": person, "part": subjects.part_of(person), "clips": len(pairs)}
            | {name: float(x.mean()) for name, x in means.items()}
            | {"timing, ms": 1000 * float(np.mean(times)) if times else float("nan")}
        )
    return rows


def _aligned(native: Motion, library: Motion) -> tuple[Tensor, Tensor] | None:
    """Labels of both feet (T, 2) of the library's figure at 30 frames per second, and the true ones at those times."""
    fine = resample(library.to(torch.float64), 120.0, "spline")
    names = ["pelvis", "left_knee", "right_knee", "left_ankle", "right_ankle"]
    heights = [m.positions[:, m.skeleton.indices(names), 2] for m in (native.to(torch.float64), fine)]
    best = None
    for shift in range(-30, 31):
        starts = max(0, shift), max(0, -shift)
        n = min(len(h) - s for h, s in zip(heights, starts, strict=True))
        if n < 100:
            continue
        a, b = (h[s : s + n] for h, s in zip(heights, starts, strict=True))
        miss = float(((a - a.mean(0)) - (b - b.mean(0))).square().mean())
        if best is None or miss < best[0]:
            best = miss, starts, n
    if best is None or best[0] > 0.003:
        return None
    _, (begin, start), n = best
    slow = replace(fine, root=fine.root[start : start + n : 4], rot=fine.rot[start : start + n : 4], fps=30.0)
    truth = _feet(native)[begin : begin + n : 4]
    found = _feet(slow)
    k = min(len(found), len(truth))
    return found[:k], truth[:k]


def _feet(motion: Motion) -> Tensor:
    """Whether either foot touches the floor (T, 2)."""
    at = motion.positions[:, motion.skeleton.indices(FEET)]
    rest = resting_heights(replace(motion.skeleton, contact_names=FEET)).to(at)
    labels = contacts_from_positions(at, motion.fps, rest)
    return torch.maximum(labels[:, :2], labels[:, 2:])


def _timing(found: Tensor, truth: Tensor) -> list[float]:
    """Seconds between events of truth (T, 2) and the nearest ones found, both at 30 frames per second."""
    times = []
    for foot in range(2):
        for kind in (1, -1):
            a, b = ((x[:, foot].diff() == kind).nonzero()[:, 0] for x in (found, truth))
            if len(a) and len(b):
                near = (a[:, None] - b).abs().amin(0)
                times += (near[near <= 9] / 30.0).tolist()
    return times


def toes_rows(found: Corpus) -> list[dict[str, object]]:
    """Computes how well the bend of the toes is predicted from the foot, its height and its speed, by ridge regression
    over recordings that have toes: root mean square error in degrees, a row per part."""
    feet: dict[str, list[tuple[Tensor, Tensor]]] = {part: [] for part in subjects.PARTS}
    for take in found.takes:
        if take.source == NATIVE:
            feet[take.part] += [_foot(take.motion, side) for side in ("left", "right")]
    if not feet["train"]:
        return []
    known = {part: [torch.cat(x) for x in zip(*pairs, strict=True)] for part, pairs in feet.items() if pairs}
    x, y = known["train"]
    middle, size = x.mean(0), x.std(0)
    designs = {n: torch.cat(((x - middle) / size, torch.ones(len(x), 1)), 1) for n, (x, _) in known.items()}
    design, rows = designs["train"], []
    weights = torch.linalg.solve(design.mT @ design + torch.eye(design.shape[1]), design.mT @ y)
    for part, (_, truth) in known.items():
        guesses = {"regression": designs[part] @ weights, "mean": y.mean(), "rigid": 0.0}
        off = {name: float((guess - truth).square().mean().sqrt()) for name, guess in guesses.items()}
        rows.append({"part": part, "frames": len(truth)} | off)
    return rows


def _foot(motion: Motion, side: str) -> tuple[Tensor, Tensor]:
    """What may say how a toe bends (T, 6), and how it does (T,), degrees about the foot's own left axis."""
    places, world = motion.world
    ankle, ball, knee = motion.skeleton.indices([f"{side}_{name}" for name in ("ankle", "foot", "knee")])
    pitch = torch.asin(world[:, ankle, 2, 2].clamp(-1, 1))
    height = places[:, ball, 2] - motion.skeleton.sole
    near = torch.exp(-height.clamp(min=0) / 0.03)
    speed = velocity(places[:, ball], motion.fps, dim=0).norm(dim=-1)
    bent = [rotation.log(motion.rot[:, joint])[:, 0] for joint in (ankle, knee)]
    toe = torch.rad2deg(rotation.log(motion.rot[:, ball])[:, 0])
    return torch.stack((pitch, height, speed, near * pitch, *bent), 1), toe


def reading(ways: Sequence[Mapping], labels: Sequence[Mapping], toes: Sequence[Mapping]) -> str:
    """Computes the sentences that the three tables amount to."""
    spline, linear = (next(row for row in ways if row["way"] == way) for way in ("spline", "linear"))
    best = min(ways, key=lambda row: row["places, mm"])["way"]
    text = (
        f"The {best} is nearer to the truth: the spline is {spline['places, mm']:.2f} mm off, straight lines "
        f"{linear['places, mm']:.2f} mm. The spline's mean acceleration is {spline['mean acceleration']:.2f} m/s^2; "
        f"the truth has {spline['of the truth']:.2f}. "
    )
    parts = {part: [row["F1"] for row in labels if row["part"] == part] for part in ("train", "report")}
    scores = ", ".join(f"{np.mean(f1):.2f} on {len(f1)} people of *{part}*" for part, f1 in parts.items() if f1)
    text += f"Foot contacts have an F1 of {scores}. "
    return text + "".join(
        f"Toes cannot be guessed. On people it never saw, a regression from the rest of the body misses by "
        f"{row['regression']:.0f} degrees, a toe that never bends by {row['rigid']:.0f}."
        for row in toes if row["part"] == "report"
    )  # fmt: skip
