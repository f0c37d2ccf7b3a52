"""Whether motion that was made is a copy: how far its nearest training window is, at any shift, mirrored too."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.heading import heading_frame, world_to_local_positions
from motionlab.motion import Motion, mirror

EVERY = 6  # frames between the poses that are compared: five a second
NEAR = 0.05  # share of held-out windows that are nearer to training motion than what counts as no copy
_BATCH = 4096  # windows


def nearest(sets: Mapping[str, Motion], library: Sequence[Motion]) -> dict[str, Tensor]:
    """Searches all windows of a library (recordings (frames,) on the standard body) for each of several sets (N_i, T):
    the distance (N_i,) of the nearest one in metres, root mean square over joints and poses.

    Windows are compared by joints in the heading frame of their first frame, so neither place nor heading counts.
    """
    every = [*sets.values()]
    root, rot = (torch.cat([getattr(motion, name) for motion in every]) for name in ("root", "rot"))
    queries = replace(every[0], root=root, rot=rot, contacts=None)
    both = torch.cat([rows(m.positions, m.root[:, 0], m.rot[:, 0, 0]) for m in (queries, mirror(queries))])
    best = torch.full((len(both),), torch.inf, dtype=torch.float64, device=both.device)
    for motion in library:
        cuts = motion.positions.unfold(0, queries.frames, 1).movedim(-1, 1) if motion.frames >= queries.frames else ()
        for at in range(0, len(cuts), _BATCH):  # of (windows, T, J, 3), a view
            part = slice(at, at + _BATCH)
            found = rows(cuts[part], motion.root[: len(cuts)][part], motion.rot[: len(cuts), 0][part])
            # the candidate is found by the quick expansion of the square, its distance exactly
            candidate = (found.square().sum(1) - 2 * both @ found.mT).argmin(1)
            best = torch.minimum(best, torch.linalg.vector_norm(both - found[candidate], dim=1))
    distance = best.reshape(2, -1).amin(0) / math.sqrt(both.shape[1] / 3)
    return dict(zip(sets, distance.split([len(motion.root) for motion in sets.values()]), strict=True))


def rows(positions: Tensor, root: Tensor, orientation: Tensor) -> Tensor:
    """Windows (N, T, J, 3) as rows of every ``EVERY``-th pose's joints, metres, in the heading frame of the first."""
    frame = heading_frame(root, orientation)
    return world_to_local_positions(frame, positions[:, ::EVERY].flatten(1, 2)).flatten(1)


def between(a: Motion, b: Motion) -> Tensor:
    """The same distance (N, M) in metres between two sets of windows, without mirroring."""
    x, y = (rows(m.positions, m.root[:, 0], m.rot[:, 0, 0]) for m in (a, b))
    return torch.cdist(x, y) / math.sqrt(x.shape[1] / 3)
