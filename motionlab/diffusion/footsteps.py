"""Makes steps of what glides: feet that were filled in come to rest, go on quickly, and rise on the way.

What a model or a curve fills in is a mean of what may happen: where people take a step at some moment, it glides. Who
stands before a gap and stands elsewhere behind it has stepped; so a foot that is said to stand but travels is timed
anew along its own way (:func:`retimed`), and one that goes from place to place is lifted (:func:`lifted`).

Numbers: of recordings of people who choose, at 30 frames per second, lengths in legs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from motionlab.baselines import nearest_known

_STRIDE = 1.2  # legs that a foot goes in one step
_TRAVELS = 0.1  # legs: a foot that stands before and behind a gap, farther apart than this, stepped between
_SECONDS = (0.25, 0.3)  # that a step takes, and so much more per leg
_TURNS = 0.2  # of a step's way, by which feet that step together are moved apart in time
#: A step rises to so much of its length, and of a leg at most; over the first share of its time, and sinks as long.
_HIGH, _RISE = (0.12, 0.08), 0.3


@dataclass(frozen=True)
class _Glide:
    """Frames first to last of a clip's foot that is said to stand and travels.

    q: share of its way at each. rests: shares of the way where it comes to rest, n + 1 of them. length: metres.
    """

    clip: int
    foot: int
    first: int
    last: int
    q: Tensor
    rests: Tensor
    length: float


def retimed(points: Tensor, stands: Tensor, known: Tensor, leg: float, fps: float) -> tuple[Tensor, Tensor, Tensor]:
    """Computes when feet are where: (B, T, F) times along their own ways, the frames that are timed anew, and of these
    those of a step, bool (B, T, F).

    points: of the feet (B, T, F, 3), whose ways count on the floor. stands: bool (B, T, F), said. known: bool
    (B, T, 1), frames that are right already. leg: metres.
    """
    when = torch.arange(stands.shape[1], dtype=torch.float64)[:, None].repeat(len(stands), 1, stands.shape[2])
    anew, moving = torch.zeros_like(stands), torch.zeros_like(stands)
    glides = _glides(points, stands, known.expand_as(stands), leg)
    for glide in glides:
        inside = torch.arange(glide.first, glide.last + 1, dtype=torch.float64)
        share, steps = torch.full_like(inside, float(glide.rests[0])), torch.zeros_like(inside, dtype=torch.bool)
        middle = 0.5 + _TURNS * _turn(glide, glides, points)
        for a, b in zip(glide.rests[:-1].tolist(), glide.rests[1:].tolist(), strict=True):
            long = min((_SECONDS[0] + _SECONDS[1] * (b - a) * glide.length / leg) * fps, glide.last - glide.first)
            at = float(inside[(glide.q >= a + middle * (b - a)).long().argmax()])
            at = min(max(at, glide.first + long / 2), glide.last - long / 2)
            u = ((inside - at) / long + 0.5).clamp(0, 1)
            share += (3 * u**2 - 2 * u**3) * (b - a)
            steps |= (u > 0) & (u < 1)
        high = torch.searchsorted(glide.q, share).clamp(1, len(inside) - 1)
        part = (share - glide.q[high - 1]) / (glide.q[high] - glide.q[high - 1]).clamp(min=1e-9)
        mine = (glide.clip, slice(glide.first, glide.last + 1), glide.foot)
        open_ = ~known[glide.clip, mine[1], 0]
        when[mine] = torch.where(open_, glide.first + high - 1 + part.clamp(0, 1), when[mine])
        anew[mine], moving[mine] = anew[mine] | open_, moving[mine] | (open_ & steps)
    return when, anew, moving


def _glides(points: Tensor, stands: Tensor, known: Tensor, leg: float) -> list[_Glide]:
    """The runs of ``stands`` between known frames that travel too far for one place."""
    found = []
    edges = pad((stands & ~known).mT.long(), (1, 1)).diff()
    ends = [(edges == way).nonzero().tolist() for way in (1, -1)]
    for (clip, foot, begin), (_, _, end) in zip(*ends, strict=True):
        sure = pad((stands & known)[clip, :, foot], (1, 1))
        held = [bool(sure[begin]), bool(sure[end + 1])]
        first, last = begin - held[0], end - 1 + held[1]
        way = points[clip, first : last + 1, foot, :2].double()
        far = float((way[-1] - way[0]).norm()) / leg
        count = round(far / _STRIDE)
        if all(held) and far > _TRAVELS:
            count = max(count, 1)
        if count < 1 or last - first < 3:
            continue
        path = pad(way.diff(dim=0).norm(dim=-1).cumsum(0), (1, 0))
        spare = [0.0 if h else 0.5 for h in held]  # of a stride: there it comes, or goes, on the move
        rests = (torch.arange(count + 1).double() + spare[0]) / (count + sum(spare))
        found.append(_Glide(clip, foot, first, last, path / path[-1], rests, float(path[-1])))
    return found


def _turn(glide: _Glide, glides: list[_Glide], points: Tensor) -> int:
    """-1 for the foot that steps first of two that glide together: the one behind; 1 for the other, 0 alone."""
    for other in glides:
        both = min(glide.last, other.last) - max(glide.first, other.first)
        if other.clip == glide.clip and other.foot != glide.foot and both > 0.5 * (glide.last - glide.first):
            mine = points[glide.clip, :, glide.foot, :2]
            ahead = (mine - points[glide.clip, :, other.foot, :2])[glide.first]
            side = float((ahead * (mine[glide.last] - mine[glide.first])).sum())
            return 1 if side > 0 or (side == 0 and glide.foot > other.foot) else -1
    return 0


def at_times(x: Tensor, when: Tensor) -> Tensor:
    """Computes x (B, T, F, 3) at times (B, T, F), linear between frames."""
    low = when.floor().long().clamp(0, x.shape[1] - 1)
    a, b = (x.gather(1, at[..., None].expand_as(x)) for at in (low, (low + 1).clamp(max=x.shape[1] - 1)))
    return torch.lerp(a, b, (when - low).to(x)[..., None])


def lifted(ankle: Tensor, still: Tensor, rest: Tensor, leg: float) -> Tensor:
    """Computes metres (B, T, F) by which ankles (B, T, F, 3) have to rise where they are not ``still``, bool (B, T, F).

    rest: (F,) their height on the floor. leg: metres.
    """
    time = torch.arange(still.shape[1])[:, None]
    before, after = (at.mT for at in nearest_known(still.mT))
    inside = (before < time) & (time < after)
    ends = [ankle.gather(1, at[..., None].expand_as(ankle))[..., :2] for at in (before, after)]
    far = (ends[1] - ends[0]).norm(dim=-1)
    u = (torch.minimum(time - before, after - time) / (after - before).clamp(min=1) / _RISE).clamp(0, 1)
    bump = torch.where(inside, 3 * u**2 - 2 * u**3, 0.0)
    need = (_HIGH[0] * far).clamp(max=_HIGH[1] * leg)
    lacks = torch.where(inside, (need * bump - (ankle[..., 2] - rest)).clamp(min=0), 0.0)
    most = torch.zeros_like(lacks).scatter_reduce(1, before, lacks, "amax")
    return most.gather(1, before) * bump
