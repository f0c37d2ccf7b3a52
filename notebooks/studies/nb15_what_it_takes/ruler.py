"""Which measures see a fault: recorded windows of validation people, as they were and spoilt, beside test people."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Generator, Tensor

from motionlab import rotation
from motionlab.bench import PersonWindows
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD
from studies.shared.generated import Judged, frechet, pseudo, shares

PLAIN, MIRRORED = "as they were", "mirrored"  # the second is as real as the first
MEASURES, OVER = ("coverage", "recall", "Frechet"), "Frechet, over"


def spoilt(motion: Motion, generator: Generator) -> dict[str, Motion]:
    """Windows (N, T) as they were, mirrored, and with one fault each."""
    plain = replace(motion, contacts=None)
    count, frames, joints = plain.rot.shape[:3]
    way = torch.rand(count, 1, generator=generator) * 2 * torch.pi
    drift = 0.2 / motion.fps * torch.arange(frames) * torch.stack((way.cos(), way.sin(), 0 * way))
    tremble = rotation.exp(torch.randn(count, frames, joints, 3, generator=generator) * torch.pi / 90)
    mean = rotation.mean(plain.rot.flatten(0, 1)[::50].transpose(0, 1))
    order = torch.cat((torch.zeros(count, 1), 1 + torch.rand(count, joints - 1, generator=generator)), 1).argsort(1)
    legs = [j for j, name in enumerate(STANDARD.names) if name.endswith(("hip", "knee", "ankle", "foot"))]
    swapped, up = plain.rot.clone(), torch.tensor([0.0, 0.0, 1.0])
    swapped[:, :, legs] = plain.rot.roll(count // 2, 0)[:, :, legs]
    root, still = plain.root, (plain.root.mean((0, 1)) * up).expand_as(plain.root)
    return {
        PLAIN: plain,
        MIRRORED: replace(mirror(plain), contacts=None),
        "frozen": replace(plain, root=root[:, :1].expand_as(root), rot=plain.rot[:, :1].expand_as(plain.rot)),
        "mean pose": replace(plain, root=still, rot=mean.expand_as(plain.rot)),
        "trembling 2 deg": replace(plain, rot=plain.rot @ tremble),
        "sliding 20 cm/s": replace(plain, root=root + drift.permute(1, 2, 0)),
        "floating 15 cm": replace(plain, root=root + 0.15 * up),
        "joints shuffled": replace(plain, rot=plain.rot.gather(2, order[:, None, :, None, None].expand_as(plain.rot))),
        "legs of another": replace(plain, rot=swapped),
    }


def by_people(made: Mapping[str, Motion], test: PersonWindows) -> dict[str, dict[str, Tensor]]:
    """By what was made and by measure: a number for each person (P,). OVER: Frechet distance over that of PLAIN."""
    every, found = {name: Judged.of(motion) for name, motion in made.items()}, {}
    real, plain, whose = Judged.of(test.motion), every[PLAIN], test.whose
    for name, mine in every.items():
        found[name] = shares(mine, real, whose)
        found[name]["Frechet"] = pseudo(lambda some, x=mine: frechet(x, some), [real], whose)
        found[name][OVER] = pseudo(lambda some, x=mine: frechet(x, some) / frechet(plain, some), [real], whose)
    return found


def tests(found: Mapping[str, Mapping[str, Tensor]]) -> dict[str, tuple[Tensor, Tensor, str]]:
    """By measure: what the fault that is seen least adds to it (P,), what the mirror adds, and the fault's name. Of the
    Frechet distance, how many times as far they make it."""
    both = {}
    for measure in MEASURES:
        key, sign = (OVER, 1) if measure == "Frechet" else (measure, -1)  # a fault makes it larger, or smaller
        mean = {name: sign * float(some[key].mean()) for name, some in found.items() if name not in (PLAIN, MIRRORED)}
        least, nothing = min(mean, key=mean.get), 0 if sign > 0 else found[PLAIN][key]
        both[measure] = found[least][key] - nothing, found[MIRRORED][key] - nothing, least
    return both
