"""In-betweening of real BVH files of people nobody trained on: network, curves and slerp.

Clips of the CMU library's ``test`` people, at 30 frames per second, on the files' own skeletons. Kinds: a ``gap``
with known motion around it; lone ``keys`` so many frames apart; ``one`` key alone with so many frames on either side;
and ten known frames with so many ``beyond`` them on either side. Every person counts alike; intervals are by bootstrap
over people. ``slerp+`` is slerp through the planting of the others.

Feet slide: the way over the floor, mm per frame, of ankles that are at most 3 cm above where they rest. A gap is good
where that is no more than the original's and 1 mm. Knee: the largest acceleration of one in what was made, m/s^2.

    MOTIONLAB_DATA=FOLDER python tests/bench/bench_inbetween.py [--clips 2] [--kinds gap]
"""

import argparse
import os
import time
from collections import defaultdict
from pathlib import Path

import torch

from motionlab import baselines, io, metrics, splits
from motionlab.animate import filling
from motionlab.animate.corrections import Rig
from motionlab.errors import DataError
from motionlab.metrics import joint_errors
from motionlab.motion import Motion, resample
from motionlab.rigs import find_joints

FPS, FRAMES, GAPS, LOW, MORE = 30.0, 130, (15, 30, 60), 0.03, 1.0
METHODS = ("slerp", "slerp+", *filling.METHODS)
KINDS = ("gap", "keys", "one", "beyond")


def clips(folder: Path, part: str, each: int) -> list[tuple[str, Motion]]:
    """(person, the middle of a clip), at most ``each`` of every person, evenly over the files that are long enough."""
    found: dict[str, list[Motion]] = defaultdict(list)
    for path in sorted(folder.glob("*/*.bvh")):
        person = splits.person_of("cmu_library", path.relative_to(folder))
        if splits.part_of(person) == part:
            found[person].append(path)
    rows = []
    for person, paths in found.items():
        some = [paths[int((k + 0.5) * len(paths) / (3 * each))] for k in range(3 * each)]
        used = 0
        for path in dict.fromkeys(some[1::3] + some):
            try:
                motion = resample(io.load(path), FPS)
            except DataError:
                continue
            if used < each and motion.frames >= FRAMES:
                start = (motion.frames - FRAMES) // 2
                rows.append((person, motion.cut(start, start + FRAMES)))
                used += 1
    return rows


def case(kind: str, gap: int, motion: Motion) -> tuple[Motion, filling.KeyMask, torch.Tensor]:
    """The motion that is to be filled in, what is kept of it, and the frames (T,) at which it is measured."""
    start = (FRAMES - gap) // 2
    if kind == "gap":
        frames = set(range(start)) | set(range(start + gap, FRAMES))
    elif kind == "keys":
        frames = set(range((FRAMES - 1) % (gap + 1) // 2, FRAMES, gap + 1))
    else:
        known, middle = (1 if kind == "one" else 10), FRAMES // 2
        motion = motion.cut(middle - known // 2 - gap, middle - known // 2 + known + gap)
        frames = set(range(gap, gap + known))
    keep, time = filling.key_mask(motion, frames), torch.arange(motion.frames)
    inside = ~keep.frames & (kind in ("one", "beyond") or (time > min(frames)) & (time < max(frames)))
    return motion, keep, inside


def filled(method: str, motion: Motion, keep: filling.KeyMask) -> Motion:
    if not method.startswith("slerp"):
        return filling.inbetween(motion, keep, method=method).motion
    made = baselines.interpolate(motion, keep.frames)
    if method == "slerp":
        return made
    body = Rig.of(motion, made, keep)
    return body.to_own_rig(body.joints, plant=True)


def pops(made: Motion, truth: Motion, keep: filling.KeyMask) -> float:
    """The largest acceleration of a knee in what was made."""
    size = made.positions.diff(n=2, dim=0).norm(dim=-1) * made.fps**2
    knees = [j for name, j in find_joints(truth.skeleton, truth.name).items() if name.endswith("knee")]
    known = keep.frames[:-2] & keep.frames[1:-1] & keep.frames[2:]
    return float(size[~known][:, knees].max())


def slide(motion: Motion, whole: Motion, truth: Motion, where: torch.Tensor) -> float:
    """mm per frame of ankles that are low, in the frames ``where``; NaN where none is. whole: tells the floor."""
    feet = [j for name, j in find_joints(truth.skeleton, truth.name).items() if name.endswith("ankle")]
    floor = whole.positions[:, feet, 2].quantile(0.02, dim=0)
    p = motion.positions[:, feet]
    low = (p[..., 2] < floor + LOW) & where[:, None]
    on = low[1:] & low[:-1]
    return float(1000 * p.diff(dim=0)[..., :2].norm(dim=-1)[on].mean())


def measured(person: str, motion: Motion, found: dict, options: argparse.Namespace) -> None:
    """Fills in every gap of a clip by every method."""
    for kind in options.kinds:
        for gap in GAPS:
            truth, keep, inside = case(kind, gap, motion)
            for method in options.methods:
                begin = time.perf_counter()
                made = filled(method, truth, keep)
                found["seconds"][method][gap].append(time.perf_counter() - begin)
                far = 100 * joint_errors(made.positions, truth.positions, align="none")[inside].mean()
                found["error"][kind, gap, method][person].append(float(far))
                found["slid"][kind, gap, method][person].append(slide(made, motion, truth, inside))
                found["pops"][kind, gap, method][person].append(pops(made, truth, keep))
            found["slid"][kind, gap, "original"][person].append(slide(truth, motion, truth, inside))


def report(found: dict) -> None:
    """Prints a row per case and method."""
    error, slid, popped, seconds = found.values()
    generator = torch.Generator().manual_seed(0)

    def by_person(found) -> torch.Tensor:
        return torch.tensor([torch.tensor(some).nanmean() for some in found.values()])

    for kind in sorted({kind for kind, _, _ in error}):
        for gap in GAPS:
            usual = filling._usual_method(gap / FPS * (kind in ("gap", "keys")), gap / FPS * (kind == "beyond"))[0]
            if (kind, gap, usual) not in error:
                continue
            best = by_person(error[kind, gap, usual])
            print(f"{kind} {gap} frames; default {usual}; joint error, cm")
            for method in [m for m in METHODS if (kind, gap, m) in error]:
                mine = by_person(error[kind, gap, method])
                mean, low, high = metrics.interval(mine, "mean", generator)
                less = f"; less {usual}: {metrics.paired(mine, best, generator)}" if method != usual else ""
                way, truth = (
                    torch.tensor([x for some in slid[kind, gap, who].values() for x in some])
                    for who in (method, "original")
                )
                both = way.isfinite() & truth.isfinite()
                share = 100 * float((way <= truth + MORE)[both].double().mean())
                knee = torch.tensor([x for some in popped[kind, gap, method].values() for x in some])
                ms = 1000 * sum(seconds[method][gap]) / len(seconds[method][gap])
                print(
                    f"  {method:8} {mean:5.2f} [{low:.2f}, {high:.2f}]{less}; slide {float(way[both].mean()):.1f} mm "
                    f"a frame (original {float(truth[both].mean()):.1f}), good {share:.0f} % of {int(both.sum())}; "
                    f"knee {float(knee.median()):.0f}; {ms:.0f} ms"
                )


def main() -> None:
    data = os.environ.get("MOTIONLAB_DATA")
    if not data or not (Path(data) / "cmu_library").is_dir():
        print("no MOTIONLAB_DATA with cmu_library in it: nothing measured")
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=1, help="of each person")
    parser.add_argument("--part", choices=splits.PARTS, default="test")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    options = parser.parse_args()
    rows = clips(Path(data) / "cmu_library", options.part, options.clips)
    print(f"{len(rows)} clips of {len({who for who, _ in rows})} people ({options.part})")
    found = {name: defaultdict(lambda: defaultdict(list)) for name in ("error", "slid", "pops", "seconds")}
    for done, (person, motion) in enumerate(rows):
        measured(person, motion, found, options)
        print(f"{done + 1}/{len(rows)}", end="\r", flush=True)
    report(found)


if __name__ == "__main__":
    main()
