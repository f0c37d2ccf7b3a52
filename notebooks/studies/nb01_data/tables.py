"""Tables of notebook 01: is a corpus ground truth, what does retargeting cost."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import torch

from data_synth import corpus, faults
from data_synth.audit import audit
from motionlab.contact import with_contacts
from motionlab.io.recordings import recordings
from motionlab.metrics.gait import contact_scores
from motionlab.retarget import retarget
from motionlab.skeleton import FEET
from motionlab.splits import subsample

#: Faults put in on purpose: 5 cm/s of drift, 1 cm too low, knees reflected.
FAULTS = (lambda motion: faults.drifting(motion, 0.05), faults.lowered, faults.knees_reflected)
#: Sources of joint rotations that are small.
SMALL = ("animated_drawings", "bandai_namco", "cmu_amc", "deepmimic", "isaacgym_amp_cmu", "reactidle")


def build_both(seed: int, seconds: float) -> tuple[corpus.Corpus, corpus.Corpus]:
    """Builds the synthetic corpus in the thesis's two versions: B with a free root, A with its root held."""
    recipes = [corpus.Recipe(seed=seed, version=version, seconds=seconds) for version in "BA"]
    return tuple(corpus.build(recipe=recipe, progress=False) for recipe in recipes)


def audited(free: corpus.Corpus, still: corpus.Corpus) -> dict[str, tuple[list[float], list[float]]]:
    """Computes the worst of every sequence by test, and of its first ten seconds with a fault put in on purpose.

    planted: mm per frame. floor: mm. limits: degrees, of both versions.
    """
    good = [audit(s.motion) for s in free.sequences]
    drift, low, knees = ([audit(spoil(s.motion.cut(0, 300))) for s in free.sequences] for spoil in FAULTS)
    both = [*(audit(s.motion) for s in still.sequences), *good]
    return {
        "planted": ([1000 * a.contact_speed for a in good], [1000 * a.contact_speed for a in drift]),
        "floor": ([1000 * a.penetration for a in good], [1000 * a.penetration for a in low]),
        "limits": ([a.limit_excess for a in both], [a.limit_excess for a in knees]),
    }


def action_rows(found: corpus.Corpus) -> list[dict[str, object]]:
    """Returns a row per split: sequences, subjects, minutes, and the share of each action."""
    return [
        {**row, "actions": ", ".join(f"{name} {100 * share:.0f} %" for name, share in row["actions"].items())}
        for row in found.statistics()
    ]


def detected_contacts(sequences: Sequence) -> tuple[float, float]:
    """Computes precision and recall of a detector of foot contacts, that knows heights and speeds, by the labels."""
    feet = [sequences[0].motion.skeleton.contact_names.index(name) for name in FEET]
    scores = contact_scores(
        torch.stack([with_contacts(s.motion).contacts[:, feet] for s in sequences]),
        torch.stack([s.motion.contacts[:, feet] for s in sequences]),
    )
    return float(scores.precision.mean()), float(scores.recall.mean())


def retarget_rows(folder: Path | str, *, each: int | None = None) -> list[dict[str, object]]:
    """One row per source of joint rotations: clips, minutes, fps, joints, residual and skate of the transfer.

    residual: mean distance in cm between a joint and the one it stands for, on the source's own bone lengths
    and on the standard's proportions scaled to its legs. skate: mm per frame of feet that rest, in the file and
    on the standard's proportions, feet planted.

    Raises:
        DataError: a recording is at fault.
    """
    rows = []
    for source in SMALL:
        if not (Path(folder) / source).is_dir():
            continue
        found = subsample([(path, load) for _, path, load in recordings(folder, source)], each)
        motions = [load(path) for path, load in found]
        own = [retarget(m) for m in motions]
        other = [retarget(m, proportions="standard") for m in motions]
        rows.append({
            "source": source, "clips": len(motions), "minutes": sum(m.seconds for m in motions) / 60,
            "fps": _range(m.fps for m in motions), "joints": _range(len(m.skeleton) for m in motions),
            "residual, own bones, cm": 100 * _mean(r.residual for r in own),
            "residual, standard bones, cm": 100 * _mean(r.residual for r in other),
            "worst clip, cm": 100 * max(r.residual for r in other),
            "skate in the file, mm/frame": _mean(r.skate[0] for r in other),
            "skate after, mm/frame": _mean(r.skate[1] for r in other),
        })  # fmt: skip
    return rows


def _mean(values: Iterable[float]) -> float:
    """Mean of the values that are numbers; NaN of none."""
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")


def _range(values: Iterable[float]) -> str:
    some = sorted(set(values))
    return f"{some[0]:g}" if len(some) == 1 else f"{some[0]:g} to {some[-1]:g}"
