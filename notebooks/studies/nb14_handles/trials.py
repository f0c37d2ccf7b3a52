"""Every way of making poses on the same handles: how far handles and free joints are off, and what draws are worth."""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from motionlab.bench import by_person
from motionlab.diffusion.poses import NUMBERS, Poser, finished
from motionlab.metrics import masked_mean
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb14_handles.people import SETS, Known, Poses, handles

_LOT = 204  # poses of a kind: 12 of each of 17 people
#: Poses, their handles (N, 22) and a generator to poses (N, 1). Only places of handles are read, unless it says so.
Way = Callable[[Poses, Tensor, torch.Generator], Motion]


@torch.no_grad()
def drawn(
    model: Poser, targets: Tensor, which: Tensor, generator: torch.Generator, *, steps: int = 20,
    kept: tuple[Tensor, Tensor] | None = None,
) -> Motion:  # fmt: skip
    """Draws poses (B, 1) by DDIM in steps of equal angle. kept: numbers and which of them stay, each (B, ``NUMBERS``):
    they are put back, as noisy as the rest, behind every step (Eq. 4.10)."""
    x = torch.randn(len(targets), NUMBERS, generator=generator)
    angles = torch.linspace(math.pi / 2, 0.0, steps + 1).tolist()
    for angle, after in pairwise(angles):
        x0 = model(targets, which, x, torch.full((len(x),), angle))
        noise = (x - math.cos(angle) * x0) / math.sin(angle)
        x = math.cos(after) * x0 + math.sin(after) * noise
        if kept is not None:
            again = math.cos(after) * kept[0] + math.sin(after) * torch.randn(x.shape, generator=generator)
            x = torch.where(kept[1], again, x)
    return model.decode(x)


def chains(which: Tensor) -> Tensor:
    """The numbers (B, ``NUMBERS``) that stay for handles (B, 22): rotations of handles and of joints above them, the
    pelvis's height where it is a handle."""
    joints = which.clone()
    for joint in range(len(STANDARD) - 1, 0, -1):
        joints[:, STANDARD.parents[joint]] |= joints[:, joint]
    return torch.cat((which[:, :1], joints.repeat_interleave(6, -1)), -1)


def inpainted(model: Poser, told: bool) -> Way:
    """The thesis's way, Eq. 4.10: it reads the true rotations of ``chains``. told: the model hears of handles, too."""
    return lambda poses, which, generator: drawn(
        model, poses.places, which & told, generator, kept=(model.encode(poses.truth), chains(which))
    )


def mean_kept(model: Poser) -> Way:
    """The mean pose with the same rotations kept: what Eq. 4.10 must beat."""
    return lambda poses, which, _: model.decode(torch.where(chains(which), model.encode(poses.truth), 0.0))


def answer(model: Poser) -> Way:
    """The model's one answer."""
    return lambda poses, which, _: model.complete(poses.places, which)


def draw(model: Poser) -> Way:
    """A draw."""
    return lambda poses, which, generator: drawn(model, poses.places, which, generator)


def rivals(known: Known, ridges: Sequence[float]) -> dict[str, Way]:
    """Answers without a network: poses from which kinematics may begin."""
    return {
        "mean pose": lambda poses, which, _: known.gaussian(poses.places, which & False),
        "last pose": lambda poses, *_: poses.last,
        "nearest known pose": lambda poses, which, _: known.nearest(poses.places, which),
    } | {f"Gaussian, ridge {r:g}": lambda poses, which, _, r=r: known.gaussian(poses.places, which, r) for r in ridges}


def several(model: Poser, known: Known, count: int) -> dict[str, list[Way]]:
    """Draws: of the network, of a Gaussian, and so many nearest poses."""
    return {
        "network, draws": [draw(model)] * count,
        "Gaussian, draws": [lambda poses, which, g: known.gaussian(poses.places, which, generator=g)] * count,
        "nearest known poses": [lambda p, which, _, k=k: known.nearest(p.places, which, k) for k in range(count)],
    }


def colours(names: Iterable[str]) -> dict[str, str]:
    """The role of each way."""
    return {n: "ours" if n.startswith("network") else n if n == "truth" else "baseline" for n in names}


def tried(
    ways: Sequence[Way], poses: Poses, seeded: Callable[[str], torch.Generator], *, finish: bool = True
) -> dict[str, Tensor]:
    """By person (P,), means over sets of handles and over ways, which are several draws or one answer. Before inverse
    kinematics: how far handles are off, cm, and how often made and true poses are told apart. After it (before, without
    ``finish``): how far free joints are off, their energy score, draws from each other."""
    found: dict[str, list[Tensor]] = {}
    for name, chosen in SETS.items():
        which, generator = handles(chosen, len(poses.whose), seeded(name)), seeded(f"{name}, noise")
        made = [way(poses, which, generator) for way in ways]
        done = [finished(m, poses.places, which) if finish else m for m in made]
        free = ~which & ~poses.lacks
        pairs = [_off(a, b, free) for k, a in enumerate(done) for b in done[:k]]
        error = torch.stack([_off(m, poses.truth, free) for m in done]).mean(0)
        apart = torch.stack(pairs).mean(0) if pairs else torch.zeros_like(error)
        parts = {
            "handles": torch.stack([_off(m, poses.truth, which) for m in made]).mean(0),
            "apart": told_apart(made[0].positions.flatten(1), poses.places.flatten(1)),
            "free": error, "score": error - apart / 2, "spread": apart,
        }  # fmt: skip
        for measure, values in parts.items():
            found.setdefault(measure, []).append(by_person(values, poses.whose))
    return {measure: torch.stack(part).mean(0) for measure, part in found.items()}


def _off(made: Motion, truth: Motion, joints: Tensor) -> Tensor:
    return 100 * masked_mean((made.positions - truth.positions)[:, 0].norm(dim=-1), joints, 1)


def told_apart(made: Tensor, true: Tensor) -> Tensor:
    """How often (N,) the nearest other pose is of the same kind, made or true, for made poses (N, D) and true ones; a
    pair is not compared. 0.5: as if they were alike (Lopez-Paz and Oquab 2017). In lots of ``_LOT``, evenly from all:
    among more it is harder to be alike."""
    found, lots = torch.empty(len(made)), max(len(made) // _LOT, 1)
    for k in range(lots):
        both = torch.cat((made[k::lots], true[k::lots]))
        far = torch.cdist(both, both) + 1e6 * torch.eye(len(both) // 2).repeat(2, 2)
        same = (far.argmin(1) < len(both) // 2) == (torch.arange(len(both)) < len(both) // 2)
        found[k::lots] = same.float().unflatten(0, (2, -1)).mean(0)
    return found
