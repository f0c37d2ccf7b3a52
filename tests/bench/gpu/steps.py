"""The losses of ``CompleterTraining`` and of a plain denoiser as steps that never wait for the host.

A whole step, from the draw of its windows to the moved average, is then one CUDA graph: 2 ms on an H100 where the
library's own takes 250 ms of a core. tests/test_gpu_training.py compares them with the library's, number by number, and
runs them on torch's "meta" device, where whatever waits for the host fails.

Windows are on the standard body alone. Patterns in time are drawn from a table with the weights of their curves.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from motionlab.baselines import curve_weights
from motionlab.diffusion import windows
from motionlab.diffusion.completer import _LOUD, _ROOT, Completer, binomial_smoothed, motion_waves
from motionlab.diffusion.features import MADE, OWNERS, UNITS
from motionlab.motion import FPS
from motionlab.skeleton import STANDARD
from motionlab.training.completer_training import _SILENT, _SQUARED, _WEIGHTS

J, C, T = len(STANDARD), len(STANDARD.contact_names), 60
SPLIT = (3, 6 * J, C)
ORDER = ("nothing", "frames", "gap", "between", "keys", "joints", "entries", "legs")
Batch = tuple[Tensor, Tensor, Tensor, Tensor]  # root (B, T, 3), rot (B, T, J, 3, 3), contacts (B, T, C), seen (B, U)


class Constants:
    """What the arithmetic looks up, on one device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        names, partner = STANDARD.contact_names, STANDARD.mirror_indices
        there = lambda x: torch.as_tensor(x).to(device)  # noqa: E731
        self.mirror, self.flip, self.floor = there(partner), there([-1.0, 1.0, 1.0]), there([-1.0, -1.0, 0.0])
        self.swap = there([names.index(STANDARD.names[partner[j]]) for j in STANDARD.contact_indices])
        self.contact, self.owners = there(STANDARD.contact_indices), OWNERS.to(device)
        legs = torch.ones(UNITS, dtype=torch.bool)
        legs[[j for j, name in enumerate(STANDARD.names) if name.endswith(windows.LEGS)]] = False
        self.legs, self.last = there(legs), there(torch.arange(UNITS) == UNITS - 1)
        order, back, self.sizes, rows = STANDARD.level_order
        self.order, self.back = there(order), there(back)
        self.above = [None if x is None else there(x) for x in rows]
        self.offsets = there(STANDARD.offsets[order])
        self.time = torch.arange(T, device=device)
        self.away = (self.time[:, None] - self.time).float() / FPS
        self.waves = 2.0 ** torch.arange(8, device=device).float()
        self.motion, self.loud = there(motion_waves(T, FPS)), there([_ROOT] * 3 + [_LOUD] * (MADE - 3))


def fk(root: Tensor, rot: Tensor, k: Constants) -> Tensor:
    """Places (B, T, J, 3)."""
    rot = rot.permute(2, 3, 4, 0, 1).index_select(0, k.order)
    places, turns, at = [root.permute(2, 0, 1)[None]], [rot[:1]], 1
    for size, above in zip(k.sizes[1:], k.above, strict=True):
        up, turned = (x if above is None else x.index_select(0, above) for x in (places[-1], turns[-1]))
        offset, turn = k.offsets[at : at + size], rot[at : at + size]
        places.append(up + (turned * offset[:, None, :, None, None]).sum(2))
        turns.append((turned[:, :, :, None] * turn[:, None]).sum(2))
        at += size
    return torch.cat(places).index_select(0, k.back).permute(2, 3, 0, 1)


def matrix(sixd: Tensor) -> Tensor:
    a, b = sixd[..., :3], sixd[..., 3:]
    x = a * a.square().sum(-1, keepdim=True).clamp(min=1e-12).rsqrt()
    z = torch.linalg.cross(x, b, dim=-1)
    z = z * z.square().sum(-1, keepdim=True).clamp(min=1e-12).rsqrt()
    return torch.stack((x, torch.linalg.cross(z, x, dim=-1), z), -1)


def numbers_of(root: Tensor, rot: Tensor, contacts: Tensor) -> Tensor:
    return torch.cat((root, rot.mT[..., :2, :].flatten(-2).flatten(2), contacts), -1)


def motion_of(numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    root, sixd, contacts = numbers.split(SPLIT, -1)
    return root, matrix(sixd.unflatten(-1, (J, 6))), contacts


def _yaw(rot: Tensor) -> Tensor:
    return torch.atan2(-rot[..., 1, 0], -rot[..., 0, 0])


def _about_z(angle: Tensor) -> Tensor:
    c, s, o = angle.cos(), angle.sin(), torch.zeros_like(angle)
    return torch.stack((c, -s, o, s, c, o, o, o, o + 1), -1).unflatten(-1, (3, 3))


def _change(x: Tensor, rate: float) -> Tensor:
    moved = x.diff(dim=1) * rate
    return torch.cat((moved[:, :1], moved), 1)


def rows(root: Tensor, rot: Tensor, contacts: Tensor, k: Constants) -> Tensor:
    """``features.states``."""
    heading, places = _yaw(rot[:, :, 0]), fk(root, rot, k)
    turn = _about_z(-heading)
    moves = _change(places.flatten(2), FPS).unflatten(2, (J, 3)) @ turn.mT
    turned = _change(heading[..., None], 1.0)
    local = (places + (root * k.floor)[:, :, None]) @ turn.mT
    speed = torch.atan2(turned.sin(), turned.cos()) * FPS
    sixd = rot.mT[..., :2, :].flatten(2)
    return torch.cat((root, sixd, local.flatten(2), moves.flatten(2), moves[:, :, 0], speed, contacts), -1)


# ---------------------------------------------------------------------------------------------------- windows
class Data:
    """All frames of ``Windows`` on one device; draws windows by person, mirrored, in their stuck frame."""

    def __init__(self, root: Tensor, rot: Tensor, contacts: Tensor, clip: Tensor, seen: Tensor, people: Tensor) -> None:
        counts = clip.bincount()
        starts = counts.cumsum(0) - counts
        begins = torch.cat(
            [at + torch.arange(n - T + 1) for at, n in zip(starts.tolist(), counts.tolist(), strict=True)]
        )
        whose = torch.unique(people[clip[begins]], return_inverse=True)[1]
        each, device = whose.bincount(), root.device
        self.root, self.rot, self.contacts, self.clip = root, rot, contacts, clip.to(device)
        self.seen = torch.cat((seen, torch.ones(len(seen), 2, dtype=torch.bool)), 1).to(device)
        self.begins, self.each = begins[whose.argsort(stable=True)].to(device), each.to(device)
        self.first = (each.cumsum(0) - each).to(device)

    def draw(self, count: int, k: Constants, generator: torch.Generator | None) -> Batch:
        uniform = lambda **how: torch.rand(count, device=k.device, generator=generator, **how)  # noqa: E731
        person = (uniform() * len(self.each)).long().clamp(max=len(self.each) - 1)
        begin = self.begins[self.first[person] + (uniform(dtype=torch.float64) * self.each[person]).long()]
        at, flip = begin[:, None] + k.time, (uniform() < 0.5)[:, None, None]
        root, rot, contacts = self.root[at], self.rot[at], self.contacts[at]
        root = torch.where(flip, root * k.flip, root)
        rot = torch.where(flip[..., None, None], k.flip[:, None] * rot.index_select(2, k.mirror) * k.flip, rot)
        contacts = torch.where(flip, contacts.index_select(2, k.swap), contacts)
        turn = _about_z(-_yaw(rot[:, :1, 0]))
        root = ((root + root[:, :1] * k.floor)[..., None, :] @ turn.mT)[..., 0, :]
        rot = torch.cat(((turn @ rot[:, :, 0])[:, :, None], rot[:, :, 1:]), 2)
        return root, rot, contacts, self.seen[self.clip[begin]]


class Masks:
    """Patterns in time (N, T) with the weights of their curves (N, T, T); masks of the kinds of ``windows.draw_units``.

    Differs: of *entries* the joints of a window are missing in the same frames, each with the window's chance.
    """

    def __init__(self, k: Constants, pool: int = 2000) -> None:
        time, drawn = torch.arange(T), torch.Generator().manual_seed(3)
        inner, edge, (least, most) = T - 2 * windows._EDGE, windows._EDGE, windows._APART
        hole = lambda first, length: (time < first) | (time >= first + length)  # noqa: E731
        ends = [torch.ones(T, dtype=torch.bool), torch.zeros(T, dtype=torch.bool)]
        gaps = [hole(s, n) for n in range(1, T) for s in range(T - n + 1)]
        between = [hole(s + edge, n) for n in range(1, inner) for s in range(inner - n + 1)]
        keys = [(time - s) % n == 0 for n in range(least, most + 1) for s in range(n)]
        frames = list(torch.rand(pool, T, generator=drawn) < torch.rand(pool, 1, generator=drawn))
        every = torch.stack([*ends, *gaps, *between, *keys, *frames]).to(k.device)
        self.patterns, self.weights = every, torch.cat([curve_weights(x).float() for x in every.split(500)])
        first = [2, 2 + len(gaps), 2 + len(gaps) + len(between)]
        self.first, self.pool, self.inner = (*first, first[2] + len(keys)), pool, inner
        before = lambda sizes: (sizes.cumsum(0) - sizes).to(k.device)  # noqa: E731
        self.gaps, self.between = before(T + 1 - torch.arange(1, T)), before(inner + 1 - torch.arange(1, inner))
        apart = torch.arange(least, most + 1)
        self.apart, self.keys = apart.to(k.device), before(apart)

    def draw(self, count: int, k: Constants, generator: torch.Generator | None, odds: Tensor) -> tuple[Tensor, Tensor]:
        """Known (B, T, U), and the weights of curves (B, T, T). odds: their running sums in ``ORDER``, but the last."""
        uniform = lambda *shape: torch.rand(*shape, device=k.device, generator=generator)  # noqa: E731
        kind, a, b = torch.bucketize(uniform(count), odds), uniform(count), uniform(count)
        n = (a * (T - 1)).long()
        gap = self.first[0] + self.gaps[n] + (b * (T - n)).long()
        n = (a * (self.inner - 1)).long()
        between = self.first[1] + self.between[n] + (b * (self.inner - n)).long()
        n = (a * len(self.apart)).long()
        keys = self.first[2] + self.keys[n] + (b * self.apart[n]).long()
        frames = self.first[3] + (a * self.pool).long()
        whole = torch.zeros_like(frames)
        which = torch.stack((whole + 1, frames, gap, between, keys, whole, frames, whole)).gather(0, kind[None])[0]
        some = uniform(count, UNITS) < uniform(count, 1)
        joints, entries, legs = ((kind == n)[:, None] for n in (5, 6, 7))
        leg = k.legs & ~((k.last.roll(-1)) & (b < 0.5)[:, None])
        units = torch.where(joints, some, torch.where(legs, leg, True)) & ~(k.last & (joints | entries | legs))
        return (self.patterns[which][:, :, None] | (entries & some)[:, None]) & units[:, None], self.weights[which]


# ----------------------------------------------------------------------------------------------------- losses
def _mean(values: Tensor, weight: Tensor) -> Tensor:
    total = weight.flatten(1).sum(1)
    return ((values * weight).flatten(1).sum(1) / total.clamp(min=1.0)).sum() / (total > 0).sum().clamp(min=1)


def _losses(
    made: tuple, truth: tuple, known: Tensor, seen: Tensor, scale: Tensor, squared: bool, k: Constants
) -> Tensor:
    told, open_ = known | ~seen[:, None], []
    for parent in STANDARD.parents:
        open_.append(~told[..., J] if parent < 0 else open_[parent] | ~told[..., parent])
    open_ = torch.stack(open_, -1).float()
    off = fk(made[0], torch.where(told[..., :-2, None, None], truth[1], made[1]), k) - fk(truth[0], truth[1], k)
    places, moves = off.square().sum(-1), off.diff(dim=1).square().sum(-1)
    if squared:
        places, moves = places * _SQUARED["places"], moves * _SQUARED["moves"]
    else:
        places, moves = places.add(1e-6).sqrt(), moves.add(1e-6).sqrt()
    asked = (~known & seen[:, None]).float()
    squares = ((numbers_of(*made) - numbers_of(*truth)) / scale).square()[..., 3:-C]
    steps = (made[2] - truth[2]).square()
    parts = {
        "places": _mean(places, open_), "moves": _mean(moves, torch.maximum(open_[:, 1:], open_[:, :-1])),
        "rotations": _mean(squares, asked[..., k.owners][..., 3:-C]),
        "contacts": _mean(steps, asked[..., -1:].expand_as(steps)),
    }  # fmt: skip
    return sum(_WEIGHTS[name] * part for name, part in parts.items())


def _said(model: Completer, states: Tensor, known: Tensor, shown: Tensor | None, angle: Tensor | None, k: Constants):
    some = known[..., :-2].any(-1)[:, None]
    sides = (torch.where(some & (x >= 0), x, 2.0).amin(-1) for x in (k.away, -k.away))
    x = torch.cat(((states - model.mean) / model.scale, known.float(), torch.stack(tuple(sides), -1)), -1)
    patch = model.recipe.patch
    tokens = model.taken(x.unflatten(1, (-1, patch)).flatten(2)) + model.place
    if shown is not None:
        waves = angle[:, None] * k.waves
        tokens = tokens + model.noisy(shown.unflatten(1, (-1, patch)).flatten(2))
        tokens = tokens + model.angle(torch.cat((waves.sin(), waves.cos()), -1))[:, None]
    said = model.said(model.encoder(tokens)).unflatten(2, (patch, -1)).flatten(1, 2)
    return binomial_smoothed(said * ~known[..., k.owners])


def curves(numbers: Tensor, known: Tensor, weights: Tensor, k: Constants) -> Tensor:
    """``completer.through``, by the weights of the masks."""
    columns = known[..., k.owners]
    told = torch.where(columns, numbers, 0.0)
    return torch.where(columns, told, weights @ told)


def completer_loss(
    model: Completer, batch: Batch, known: Tensor, weights: Tensor, units: tuple, noise: tuple | None, k: Constants
) -> Tensor:
    """What ``CompleterTraining`` minimises. units: ``Completer.sizes``. noise: angles (B,), noise (B, T, ``MADE``)."""
    *truth, seen = batch
    mean, scale = units
    with torch.no_grad():
        numbers, columns = numbers_of(*truth), known[..., k.owners]
        guessed = motion_of(curves((numbers - mean) / scale, known, weights, k) * scale + mean)
        begun, states, open_, shown, angle = numbers_of(*guessed), rows(*guessed, k), (~columns).float(), None, None
        if noise is not None:
            angle, turned = noise[0], noise[0][:, None, None]
            shown = (turned.cos() * (numbers - begun) / scale + turned.sin() * noise[1]) * open_
    with torch.autocast("cuda", torch.bfloat16, enabled=k.device.type == "cuda", cache_enabled=False):
        said = _said(model, states, known, shown, angle, k).float()
    if noise is not None:
        said = turned.cos() * shown + turned.sin() * said
    made = motion_of(begun + said * scale * open_)
    return _losses(made, tuple(truth), known, seen, scale, noise is not None, k)


def drawn(count: int, data: Data, table: Masks, odds: Tensor, blind: float | None, k: Constants, generator) -> tuple:
    """A batch for ``completer_loss``: windows, what is known, weights, and noise (blind None: none)."""
    uniform = lambda *shape: torch.rand(*shape, device=k.device, generator=generator)  # noqa: E731
    batch = data.draw(count, k, generator)
    known, weights = table.draw(count, k, generator, odds)
    known = known & batch[3][:, None] & ~((uniform(count, 1, 1) < _SILENT) & k.last)
    if blind is None:
        return batch, known, weights, None
    angle = torch.where(uniform(count) < blind, math.pi / 2, uniform(count) * math.pi / 2)
    noise = k.motion @ torch.randn(count, T, MADE, device=k.device, generator=generator) * k.loud
    return batch, known, weights, (angle, noise - curves(noise, known, weights, k))


def plain_loss(
    x: Tensor, truth: Tensor, mean: Tensor, scale: Tensor, counts: dict, seen: Tensor, k: Constants
) -> Tensor:
    """``denoising_losses``; counts: of its parts."""
    x = torch.where(seen[:, None], x, truth)
    simple, velocity = (x - truth).square().mean(), (x - truth)[..., :-C].diff(dim=1).square().mean()
    made, true = motion_of(x * scale + mean), motion_of(truth * scale + mean)
    places = fk(made[0], made[1], k)
    far = (places - fk(true[0], true[1], k)).square().sum((-1, -2)).mean()
    way = places.index_select(2, k.contact).diff(dim=1) * made[2][:, :-1, :, None].clamp(0, 1)
    parts = {"simple": simple, "velocity": velocity, "fk": far, "contact": way.square().sum((-1, -2)).mean()}
    return sum(counts.get(name, 0.0) * part for name, part in parts.items())
