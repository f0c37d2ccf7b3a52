"""Whether generated motions are copies: their nearest training window against the one of motion held out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.errors import DataError, ShapeError
from motionlab.heading import heading_frame, world_to_local_positions
from motionlab.metrics.generation import nearest_of_batches
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD


class Memorisation(NamedTuple):
    """Nearest distances of generated samples against those of held-out ones; copying makes the first ones small."""

    ratio: float  #: median over median: about 1 for new motion, 0 for copies
    auc: float  #: chance that a generated sample lies nearer than a held-out one: 0.5 for new motion, 1 for copies
    ks: float  #: largest gap in 0..1 between the two cumulative distributions (Kolmogorov-Smirnov)
    copies: float  #: share in 0..1 of generated samples nearer than that quantile of the held-out ones
    n: int  #: generated
    m: int  #: held out


def memorisation(generated: Tensor, held_out: Tensor, quantile: float = 0.05) -> Memorisation:
    """Compare nearest distances (N,) of generated motion to the training set with those (M,) of held-out motion.

    ratio, auc and ks look at the bulk; ``copies`` also sees a few copies among many new motions. An auc well *below*
    0.5 is no virtue: samples farther from the training set than new real motion are bad ones.

    Raises:
        ShapeError: an empty side. ValueError: quantile outside 0..1. DataError: a distance is negative or not finite.
    """
    if generated.ndim != 1 or held_out.ndim != 1 or min(len(generated), len(held_out)) < 1:
        raise ShapeError(f"expected distances (N,) and (M,), got {tuple(generated.shape)} and {tuple(held_out.shape)}")
    if not 0 <= quantile <= 1:
        raise ValueError(f"quantile: expected 0 to 1, got {quantile}")
    x, y = (d.double().cpu() for d in (generated, held_out))
    for name, d in (("generated", x), ("held out", y)):
        if not ((d >= 0) & (d < math.inf)).all():
            raise DataError("a distance below zero or not finite", place=name, remedy="search the neighbours again")
    both, ranked = torch.cat((x, y)).sort().values, (x.sort().values, y.sort().values)
    steps = [torch.searchsorted(d, both, right=True).double() / len(d) for d in ranked]
    below, through = (torch.searchsorted(ranked[1], x, right=right).double() for right in (False, True))
    auc = 1 - (below + through).mean().item() / (2 * len(y))
    near, usual = x.quantile(0.5).item(), y.quantile(0.5).item()
    ratio = near / usual if usual > 0 else (1.0 if near == 0 else math.inf)
    copies = (x < y.quantile(quantile)).double().mean().item()
    return Memorisation(ratio, auc, (steps[0] - steps[1]).abs().max().item(), copies, len(x), len(y))


class Neighbours(NamedTuple):
    """The nearest training window of each query."""

    distance: Tensor  #: (N,) metres, root mean square over joints and frames
    recording: Tensor  #: (N,) which recording of the library
    start: Tensor  #: (N,) its first frame there
    mirrored: Tensor  #: (N,) bool: it is the mirrored query that fits


def nearest_windows(
    queries: Motion, library: Sequence[Motion], *, stride: int = 1, mirrored: bool = True, batch: int = 1024
) -> Neighbours:
    """The nearest window in any recording of a library, at any time shift and either hand, for each query window.

    Windows are compared by joint positions in the heading frame of their first frame, so neither place nor heading
    counts. A mirrored library is searched by mirroring the queries: distances are the same. Memory: one batch of
    windows, ``batch`` x T x J x 3 numbers; work: N x windows x T x J x 3 multiplications, twice with mirroring.

    Args:
        queries: (N, T) windows. library: recordings (frames,), at the same rate; those shorter than T are left out.
        stride: frames between the windows tried; 1 finds a copy at any shift exactly.

    Raises:
        ShapeError: queries are not (N, T), joints or rates differ, or no recording is as long as a query.
    """
    if queries.root.ndim != 3 or stride < 1 or batch < 1:
        raise ShapeError(f"queries: expected root (N, T, 3), got {tuple(queries.root.shape)}; stride, batch at least 1")
    for k, motion in enumerate(library):
        if motion.root.ndim != 2 or motion.fps != queries.fps or motion.skeleton.names != queries.skeleton.names:
            raise ShapeError(f"library[{k}] {motion.name}: expected one recording with the queries' joints and rate")
    if not any(motion.frames >= queries.frames for motion in library):
        raise ShapeError(f"no recording of the library has the {queries.frames} frames of a query")
    both = [queries, mirror(queries)] if mirrored else [queries]
    rows = [_rows(m.positions, m.root[:, 0], m.rot[:, 0, 0]) for m in both]
    count, where = len(rows[0]), []

    def batches() -> Iterator[tuple[Tensor, int]]:
        for k, motion in enumerate(library):
            if motion.frames < queries.frames:
                continue
            cuts = motion.positions.unfold(0, queries.frames, stride).movedim(-1, 1)  # (windows, T, J, 3), a view
            roots, turns = (x[::stride][: len(cuts)] for x in (motion.root, motion.rot[:, 0]))
            for first in range(0, len(cuts), batch):
                part = _rows(*(x[first : first + batch] for x in (cuts, roots, turns)))
                start = len(where)
                where.extend((k, stride * (first + i)) for i in range(len(part)))
                yield part, start

    distance, index = nearest_of_batches(torch.cat(rows), batches())
    distance, which = distance.reshape(len(rows), count).min(0)
    index = index.reshape(len(rows), count).gather(0, which[None])[0]
    recording, start = torch.tensor(where, device=index.device)[index].unbind(1)
    size = queries.frames * len(queries.skeleton)
    return Neighbours(distance / math.sqrt(size), recording, start, which == 1)


def _rows(positions: Tensor, root: Tensor, orientation: Tensor) -> Tensor:
    """Windows (N, T, J, 3) as rows (N, T J 3), metres, in the heading frame of the first frame's root."""
    frame = heading_frame(root.double(), orientation.double())
    return world_to_local_positions(frame, positions.double().flatten(1, 2)).flatten(1)


def neighbours(sets: Mapping[str, Motion], library: Sequence[Motion], *, stride: int = 1) -> dict[str, Neighbours]:
    """The nearest training window of every window of several sets (N_i, T), at any shift and either hand; one search.

    library: recordings (frames,) on the standard body.
    """
    parts = list(sets.values())
    root, rot = (torch.cat([getattr(m, name) for m in parts]) for name in ("root", "rot"))
    found = nearest_windows(Motion(STANDARD, root, rot, parts[0].fps), library, stride=stride)
    split = [x.split([len(m.root) for m in parts]) for x in found]
    return {name: Neighbours(*(x[k] for x in split)) for k, name in enumerate(sets)}


def recalled(found: Neighbours, at: int, library: Sequence[Motion], frames: int) -> Motion:
    """The training window (T,) that was found for one query, in the query's hand."""
    start = int(found.start[at])
    window = replace(library[int(found.recording[at])].cut(start, start + frames), contacts=None)
    return mirror(window) if bool(found.mirrored[at]) else window
