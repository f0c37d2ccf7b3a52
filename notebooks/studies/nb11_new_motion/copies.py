"""Whether motion that was made is a copy: how far its nearest training window is, at any shift, mirrored too."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.heading import heading_frame, world_to_local_positions
from motionlab.motion import Motion, mirror

EVERY = 6  # frames between the poses that are compared: five a second
NEAR = 0.05  # of held-out windows so many are nearer to training motion than what counts as no copy
_BATCH = 4096  # windows


class Nearest(NamedTuple):
    """The nearest training window of each query: distance (N,) in metres, root mean square over joints and poses; its
    recording (N,) and first frame (N,); whether it is the mirrored query that it is near to (N,)."""

    distance: Tensor
    recording: Tensor
    start: Tensor
    mirrored: Tensor


def nearest(sets: Mapping[str, Motion], library: Sequence[Motion]) -> dict[str, Nearest]:
    """Searches all windows of a library (recordings (frames,) on the standard body) for each of several sets (N_i, T).

    Windows are compared by joints in the heading frame of their first frame, so neither place nor heading counts.
    """
    every = [*sets.values()]
    root, rot = (torch.cat([getattr(motion, name) for motion in every]) for name in ("root", "rot"))
    queries = replace(every[0], root=root, rot=rot, contacts=None)
    both = torch.cat([rows(m.positions, m.root[:, 0], m.rot[:, 0, 0]) for m in (queries, mirror(queries))])
    long = [k for k, motion in enumerate(library) if motion.frames >= queries.frames]
    counts = torch.tensor([library[k].frames - queries.frames + 1 for k in long])

    def batches() -> Iterator[tuple[Tensor, int]]:
        first = 0
        for k in long:
            motion = library[k]
            cuts = motion.positions.unfold(0, queries.frames, 1).movedim(-1, 1)  # (windows, T, J, 3), a view
            for at in range(0, len(cuts), _BATCH):
                part = slice(at, at + _BATCH)
                yield rows(cuts[part], motion.root[: len(cuts)][part], motion.rot[: len(cuts), 0][part]), first + at
            first += len(cuts)

    distance, index = nearest_of_batches(both, batches())
    distance, which = distance.reshape(2, -1).min(0)
    index = index.reshape(2, -1).gather(0, which[None])[0]
    place = torch.searchsorted(counts.cumsum(0), index, right=True)
    size = both.shape[1] / 3
    start = index - (counts.cumsum(0) - counts)[place]
    found = distance / math.sqrt(size), torch.tensor(long)[place], start, which == 1
    parts = [x.split([len(motion.root) for motion in sets.values()]) for x in found]
    return {name: Nearest(*(x[k] for x in parts)) for k, name in enumerate(sets)}


def rows(positions: Tensor, root: Tensor, orientation: Tensor) -> Tensor:
    """Windows (N, T, J, 3) as rows of every ``EVERY``-th pose's joints, metres, in the heading frame of the first."""
    frame = heading_frame(root, orientation)
    return world_to_local_positions(frame, positions[:, ::EVERY].flatten(1, 2)).flatten(1)


def nearest_of_batches(queries: Tensor, batches: Iterator[tuple[Tensor, int]]) -> tuple[Tensor, Tensor]:
    """Computes the distance (N,) and index (N,) of the nearest row for queries (N, D), over batches of (rows, number of
    the first one). The candidate of each batch is found by the quick expansion of the square, its distance exactly."""
    best = torch.full((len(queries),), torch.inf, dtype=torch.float64, device=queries.device)
    index = torch.zeros(len(queries), dtype=torch.long, device=queries.device)
    for rows, start in batches:
        candidate = (rows.square().sum(1) - 2 * queries @ rows.mT).argmin(1)
        distance = torch.linalg.vector_norm(queries - rows[candidate], dim=1)
        better = distance < best
        best, index = torch.where(better, distance, best), torch.where(better, candidate + start, index)
    return best, index


def threshold(held_out: Nearest) -> float:
    """The distance in metres below which a window counts as a copy: that of the ``NEAR`` nearest held-out ones."""
    return float(held_out.distance.quantile(NEAR))


def between(a: Motion, b: Motion) -> Tensor:
    """The same distance (N, M) in metres between two sets of windows, without mirroring."""
    x, y = (rows(m.positions, m.root[:, 0], m.rot[:, 0, 0]) for m in (a, b))
    return torch.cdist(x, y) / math.sqrt(x.shape[1] / 3)
