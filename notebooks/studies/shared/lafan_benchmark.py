"""The LAFAN1 in-betweening benchmark on the user's copy of the data: its windows, statistics, baselines and scores.

The data (CC BY-NC-ND 4.0) is not part of motionlab, and nothing derived from it may be committed here. Motions are
metres and z up as everywhere; inside the scores positions are centimetres in the files' own axes (y up).

Source: Harvey et al. 2020, "Robust Motion In-betweening", and its code (``evaluate.py``, ``lafan1/extract.py``,
``lafan1/benchmarks.py``, ``lafan1/utils.py``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.io import bvh
from motionlab.motion import Motion, windows
from motionlab.skeleton import UPRIGHT, Skeleton
from studies.shared.inbetween_measures import l2p, l2q, npss

#: Frames given before a gap; the one frame right after it is the target. Frames to fill.
PAST, GAPS = 10, (5, 15, 30, 45)
#: Frames and offset of the test windows, and of those that the training statistics come from.
TEST, TRAIN = (65, 40), (50, 20)
#: How many files and test windows the whole data set gives.
FILES, WINDOWS = 77, 2232
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 12, 11, 14, 15, 16, 11, 18, 19, 20)
#: What the benchmark's own test demands of the baselines at ``GAPS``, and how near (``evaluate_test.py``; its intervals
#: for L2Q are 0.005 to 0.0075 wide on either side).
PUBLISHED = {
    ("zero velocity", "l2q"): (0.56, 1.10, 1.51, 1.81),
    ("zero velocity", "l2p"): (1.5230, 3.6944, 6.6002, 9.3289),
    ("zero velocity", "npss"): (0.0053, 0.0522, 0.2318, 0.4918),
    ("interpolation", "l2q"): (0.22, 0.62, 0.98, 1.25),
    ("interpolation", "l2p"): (0.3729, 1.2488, 2.3158, 3.4469),
    ("interpolation", "npss"): (0.0023, 0.0391, 0.2013, 0.4493),
}
TOLERANCE = {"l2q": 0.0075, "l2p": 5e-5, "npss": 5e-5}
_REMEDY = "unzip lafan1.zip of ubisoft-laforge-animation-dataset and name the folder that holds its .bvh files"
Fill = Callable[[Motion, int], Motion]


@dataclass(frozen=True, eq=False)
class Lafan:
    """windows (N, 65): canonical test windows. takes: the file of each. statistics: of the training subjects.

    whole: it is the official test set, so that its numbers may stand beside published ones.
    """

    windows: Motion
    takes: tuple[str, ...]
    statistics: Statistics
    whole: bool


def load_lafan(
    folder: str | Path,
    *,
    train: Sequence[str] = ("subject1", "subject2", "subject3", "subject4"),
    test: Sequence[str] = ("subject5",),
) -> Lafan:
    """Read a folder of LAFAN1's BVH files: test windows and training statistics as the benchmark takes them.

    As there, the test windows carry the bone lengths of the training set's first file. Other ``train`` and ``test``
    serve leave-one-subject-out.

    Raises:
        DataError: no such folder, files that are not LAFAN1's, or a subject of which there is no file.
    """
    found: dict[str, list[Path]] = {}
    for path in sorted(Path(folder).glob("*.bvh")):
        if match := re.fullmatch(r"[A-Za-z]+\d+_(subject\d+)", path.stem):
            found.setdefault(match[1], []).append(path)
    if absent := [name for name in (*train, *test) if name not in found]:
        what = f"no file named <theme><take>_{absent[0]}.bvh: this is not the LAFAN1 data"
        raise DataError(what, path=folder, remedy=_REMEDY)
    offsets = _read_lafan(found[train[0]][0]).skeleton
    stats = statistics(
        _canonical(cuts) for name in train for p in found[name] if (cuts := _benchmark_windows(_read_lafan(p), *TRAIN))
    )
    parts, takes = [], []
    for path in (p for name in test for p in found[name]):
        if cuts := _benchmark_windows(replace(_read_lafan(path), skeleton=offsets), *TEST):
            parts.append(_canonical(cuts))
            takes += [path.stem] * len(cuts.root)
    if not parts:
        raise DataError(f"no test file is longer than {TEST[0]} frames", path=folder, remedy=_REMEDY)
    joined = replace(parts[0], root=torch.cat([p.root for p in parts]), rot=torch.cat([p.rot for p in parts]), name="")
    whole = sum(map(len, found.values())) == FILES and len(takes) == WINDOWS and tuple(test) == ("subject5",)
    return Lafan(joined, tuple(takes), stats, whole)


def _read_lafan(path: Path) -> Motion:
    """One recording of LAFAN1 on its 22 joints.

    Raises:
        DataError: another skeleton, or not 30 frames per second.
    """
    motion = bvh.load(path, unit="cm", up="y")
    kept = [j for j, name in enumerate(motion.skeleton.names) if not name.endswith("_end")]
    parents = tuple(kept.index(p) if p in kept else -1 for p in (motion.skeleton.parents[j] for j in kept))
    if parents != PARENTS or abs(motion.fps - 30) > 0.1:
        what = f"{len(kept)} joints at {motion.fps:g} fps, expected LAFAN1's tree of {len(PARENTS)} at 30"
        raise DataError(what, path=path, place="HIERARCHY", remedy=_REMEDY)
    skeleton = Skeleton(tuple(motion.skeleton.names[j] for j in kept), parents, motion.skeleton.offsets[kept])
    return replace(motion, skeleton=skeleton, rot=motion.rot[:, kept], fps=30.0)


def _benchmark_windows(motion: Motion, length: int, offset: int) -> Motion | None:
    """The benchmark's windows (N, length) of one recording, or None where it gives none.

    They start at 0, offset, ... while start + length < frames: a window that ends with the last frame is not taken.
    """
    return windows(motion.cut(0, motion.frames - 1), length, offset) if motion.frames > length else None


def _canonical(cuts: Motion, past: int = PAST) -> Motion:
    """Windows (N, T) moved and turned on the floor: mean root over the origin, last past frame heading along -x.

    The root's mean is over the window as it is, before it is shortened to a gap. The heading is the root's own y axis
    on the floor; the benchmark turns it to its +x, which is our world's -x (``skeleton.UPRIGHT``).

    Raises:
        ShapeError: not more frames than ``past``.
    """
    if not 0 < past < cuts.frames:
        raise ShapeError(f"past = {past}: expected 1 to {cuts.frames - 1}")
    on_floor = cuts.root.new_tensor([1.0, 1.0, 0.0])
    root = cuts.root - cuts.root.mean(-2, keepdim=True) * on_floor
    forward = cuts.rot[..., past - 1, 0, :, 1]
    turn = rotation.rotation_about("z", torch.pi - torch.atan2(forward[..., 1], forward[..., 0]))[..., None, :, :]
    rot = torch.cat(((turn @ cuts.rot[..., 0, :, :])[..., None, :, :], cuts.rot[..., 1:, :, :]), -3)
    return replace(cuts, root=(turn @ root[..., None])[..., 0], rot=rot, contacts=None)


class Statistics(NamedTuple):
    """Of the global positions of training windows, centimetres, the files' axes."""

    mean: Tensor  #: (J, 3)
    std: Tensor  #: (J, 3), of the population
    n: int  #: windows


def statistics(parts: Iterable[Motion]) -> Statistics:
    """Mean and deviation of every coordinate over all frames of canonical windows (N, T), a recording at a time.

    Raises:
        DataError: no window at all.
    """
    count, frames, total, squares = 0, 0, 0.0, 0.0
    for part in parts:
        p = _file_positions(part).flatten(0, -3)
        count, frames = count + part.root[..., 0, 0].numel(), frames + len(p)
        total, squares = total + p.sum(0), squares + p.square().sum(0)
    if not count:
        raise DataError(f"no training recording is longer than {TRAIN[0]} frames", remedy=_REMEDY)
    mean = total / frames
    return Statistics(mean, (squares / frames - mean.square()).clamp_min(0).sqrt(), count)


def hidden(cuts: Motion, gap: int, past: int = PAST) -> Motion:
    """Hides a gap: (N, past + gap + 1) frames with the last past pose standing in the gap, then the target.

    Raises:
        ShapeError: the windows are too short.
    """
    if gap < 1 or cuts.frames <= past + gap:
        raise ShapeError(f"gap = {gap}: {cuts.frames} frames hold no {past} of past, the gap and a target")
    index = torch.cat((torch.arange(past), torch.full((gap,), past - 1), torch.tensor([past + gap])))
    return replace(cuts, root=cuts.root[..., index, :], rot=cuts.rot[..., index, :, :, :], contacts=None)


def zero_velocity(seen: Motion, gap: int, past: int = PAST) -> Motion:
    """Fills a gap with the last past pose: what :func:`hidden` gives already."""
    return hidden(seen, gap, past)


def interpolation(seen: Motion, gap: int, past: int = PAST) -> Motion:
    """Fills a gap from the last past frame to the target, root linearly, local rotations by slerp.

    Weights are linspace(0, 1, gap + 2).

    Source: the benchmark's; as there, quaternions nearer than acos(0.99) are interpolated linearly and normalised.
    """
    seen = hidden(seen, gap, past)
    weight = torch.linspace(0, 1, gap + 2, dtype=torch.float64, device=seen.root.device)[1:-1]
    a, b = (rotation.matrix_to_quaternion(seen.rot[..., [t], :, :, :].double()) for t in (past - 1, past + gap))
    near = (a * b).sum(-1, keepdim=True)
    b, near = torch.where(near < 0, -b, b), near.abs()
    w, linear = weight[:, None, None], 1 - near < 0.01
    angle = torch.where(linear, 1.0, near.clamp(max=1).acos())  # 1: any that divides
    first, last = ((x * angle).sin() / angle.sin() for x in (1 - w, w))
    between = torch.where(linear, 1 - w, first) * a + torch.where(linear, w, last) * b
    rot, root = seen.rot.clone(), seen.root.clone()
    rot[..., past:-1, :, :, :] = rotation.quaternion_to_matrix(between).to(rot)
    start, stop = root[..., past - 1 : past, :], root[..., -1:, :]
    root[..., past:-1, :] = start + weight[:, None].to(root) * (stop - start)
    return replace(seen, root=root, rot=rot)


def evaluate(
    test: Lafan, methods: dict[str, Fill] | None = None, gaps: Sequence[int] = GAPS
) -> list[dict[str, object]]:
    """One row per method and gap: method, gap (frames), l2q, l2p, npss, n, and ``published`` where there is such a row.

    A method gets :func:`hidden` windows and the gap, and returns them filled. None: the two baselines. ``published``
    is True where all three agree with the benchmark's own numbers, and only given on its whole test set.
    """
    rows = []
    for name, fill in (methods or {"zero velocity": zero_velocity, "interpolation": interpolation}).items():
        for gap in gaps:
            found = score(fill(hidden(test.windows, gap), gap), test.windows, test.statistics, gap)
            values = {"l2q": found.l2q.mean().item(), "l2p": found.l2p.mean().item(), "npss": found.npss}
            row = {"method": name, "gap": gap, **values, "n": found.n}
            if test.whole and (name, "l2q") in PUBLISHED and gap in GAPS:
                row["published"] = _agrees(name, gap, values)
            rows.append(row)
    return rows


def _agrees(baseline: str, gap: int, values: dict[str, float]) -> bool:
    """Whether all three measures of a baseline are the benchmark's own, within its tolerance."""
    return all(
        abs(values[measure] - PUBLISHED[baseline, measure][GAPS.index(gap)]) <= near
        for measure, near in TOLERANCE.items()
    )


class Scores(NamedTuple):
    """The benchmark's measures of filled gaps."""

    l2q: Tensor  #: (N,) per window; the benchmark prints the mean
    l2p: Tensor  #: (N,) per window; the benchmark prints the mean
    npss: float  #: over all windows together
    n: int  #: windows


def score(filled: Motion, truth: Motion, stats: Statistics, gap: int, past: int = PAST) -> Scores:
    """Compare the gap (frames past .. past + gap - 1) of filled windows (N, >= past + gap) with the truth's.

    The signs of the predicted quaternions continue from the true frame before the gap, as those of the truth do.

    Raises:
        ShapeError: shapes do not fit.
    """
    if filled.root.ndim != 3 or min(filled.frames, truth.frames) < past + gap or len(filled.root) != len(truth.root):
        raise ShapeError(
            f"expected (N, {past + gap} or more), got {filled.root.shape[:-1]} and {truth.root.shape[:-1]}"
        )
    parents = truth.skeleton.parents
    true = _file_quaternions(truth.cut(past - 1, past + gap))
    found = _file_quaternions(filled.cut(past, past + gap), true[:, 0])
    q, q_true = (_global_quaternions(x, parents) for x in (found, true[:, 1:]))
    p, p_true = (_file_positions(m.cut(past, past + gap)) for m in (filled, truth))
    together = npss(q.flatten(2), q_true.flatten(2))
    return Scores(l2q(q, q_true), l2p(p, p_true, stats.mean, stats.std), together, len(q))


def _file_positions(motion: Motion) -> Tensor:
    """Joint positions (..., T, J, 3) in float64 centimetres in the files' axes, y up."""
    return 100 * motion.to(torch.float64).positions @ UPRIGHT.double().to(motion.root.device)


def _file_quaternions(motion: Motion, before: Tensor | None = None) -> Tensor:
    """Local quaternions (..., T, J, 4) in float64, the root's in the files' axes, signs continuous in time."""
    rot = motion.rot.double().clone()
    rot[..., 0, :, :] = UPRIGHT.double().to(rot.device).mT @ rot[..., 0, :, :]
    return _continued_quaternions(rot, before)


def _continued_quaternions(rot: Tensor, before: Tensor | None = None) -> Tensor:
    """Local rotations (..., T, J, 3, 3) as quaternions (..., T, J, 4), w first, each the nearer one to the last.

    before (..., J, 4): the signs that the first frame continues from, as of the last frame before a gap; None: w >= 0.
    """
    check_shape(rot, "... T J 3 3", "rot")
    q = rotation.matrix_to_quaternion(rot)
    if before is not None:
        q = torch.cat((before[..., None, :, :].expand_as(q[..., :1, :, :]).to(q), q), -3)
    q = rotation.unroll_quaternion(q, dim=-3)
    return q if before is None else q[..., 1:, :, :]


def _global_quaternions(local: Tensor, parents: Sequence[int]) -> Tensor:
    """Orientations (..., J, 4) in the world as products q_parent(j) q_j of local quaternions; signs multiply, too."""
    check_shape(local, f"... {len(parents)} 4", "local")
    out = [local[..., 0, :]]
    for joint in range(1, len(parents)):
        out.append(_product(out[parents[joint]], local[..., joint, :]))
    return torch.stack(out, -2)


def _product(a: Tensor, b: Tensor) -> Tensor:
    (w, u), (v, x) = (a[..., :1], a[..., 1:]), (b[..., :1], b[..., 1:])
    return torch.cat((w * v - (u * x).sum(-1, keepdim=True), w * x + v * u + torch.linalg.cross(u, x, dim=-1)), -1)
