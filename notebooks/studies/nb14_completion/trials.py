"""Every way of completing poses on the same poses and handles: how far handles and free joints are off."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.diffusion import pose_completion
from motionlab.diffusion.model import Trained
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb14_completion import measures
from studies.nb14_completion.known_poses import Poses

#: Poses (B, 1), their handles (B, 22) and a generator to poses whose handles are near, not yet finished.
Way = Callable[[Motion, Tensor, torch.Generator], Motion]
RIVALS = ("mean pose", "nearest neighbour", "ridge regression")
#: Handles by name: joints, or how many are drawn at random for every pose.
SETS: Mapping[str, tuple[str, ...] | int] = {
    "hands": ("left_wrist", "right_wrist"),
    "random 3": 3,
    "five effectors": ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle"),
    "random 6": 6,
}


def chosen_handles(handles: Sequence[str] | int, count: int, generator: torch.Generator) -> Tensor:
    """Which joints (count, 22) are handles: those of these names, or so many drawn anew for every pose.

    Raises:
        KeyError: no such joint. ValueError: a number of handles that there is not.
    """
    joints = len(STANDARD)
    if isinstance(handles, int):
        if not 0 <= handles <= joints:
            raise ValueError(f"handles: expected 0 to {joints}, got {handles}")
        return torch.rand(count, joints, generator=generator).argsort(-1).argsort(-1) < handles
    which = torch.zeros(count, joints, dtype=torch.bool)
    which[:, STANDARD.indices(list(handles))] = True
    return which


def rivals(library: Poses) -> dict[str, Way]:
    """Completions without a network. They see the handles' places, like the models."""
    return {
        "mean pose": lambda truth, which, _: library.mean(len(truth.root)),
        "nearest neighbour": lambda truth, which, _: library.nearest(truth.positions[:, 0], which),
        "ridge regression": lambda truth, which, _: library.regressed(truth.positions[:, 0], which),
    }


def kept(model: Trained, steps: int, *, chains: bool = True) -> Way:
    """Eq. 4.10. It sees the rotations of the handles, or with ``chains`` of all joints above them as well."""
    return lambda truth, which, generator: pose_completion.keep(
        model, truth, which, generator, chains=chains, steps=steps
    )


def completed(model: Trained, steps: int, guidance: float = 0.0) -> Way:
    """By diffusion, told or pulled."""
    how = {"steps": steps, "guidance": guidance, "finish": False}
    return lambda truth, which, generator: pose_completion.complete(
        model, truth.positions[:, 0], which, generator, **how
    )


@dataclass(frozen=True, eq=False)
class Found:
    """What one way did, a number per pose (B,), metres. before: mean distance of its handles from their targets. after:
    of its worst handle, behind the finish. rough, free: mean error of free joints before and behind the finish. known:
    distance to the nearest known pose, before the finish. poses (B, 1): behind the finish."""

    poses: Motion
    before: Tensor
    after: Tensor
    rough: Tensor
    free: Tensor
    known: Tensor


def tried(way: Way, truth: Motion, which: Tensor, library: Poses, generator: torch.Generator) -> Found:
    """One way on poses (B, 1) with handles (B, 22)."""
    targets = truth.positions[:, 0]
    made = way(truth, which, generator)
    done = pose_completion.finished(made, targets, which)
    return Found(
        done,
        measures.missed(made, targets, which).nanmean(-1),
        measures.missed(done, targets, which).nan_to_num(0.0).amax(-1),
        measures.unobserved(made, truth, which),
        measures.unobserved(done, truth, which),
        library.distance(made),
    )


def all_tried(
    ways: Mapping[str, Way],
    truth: Motion,
    library: Poses,
    seeded: Callable[[str], torch.Generator],
    sets: Mapping[str, tuple[str, ...] | int] = SETS,
) -> dict[tuple[str, str], Found]:
    """(set of handles, way) -> what it did on poses (B, 1); every way gets the same handles and the same noise."""
    found = {}
    for name, members in sets.items():
        which = chosen_handles(members, len(truth.root), seeded(name))
        for label, way in ways.items():
            found[name, label] = tried(way, truth, which, library, seeded(f"{name}, noise"))
    return found


def over_sets(found: Mapping[tuple[str, str], Found], way: str, measure: str) -> Tensor:
    """A measure of one way, a number per pose (B,): mean over the sets of handles."""
    return torch.stack([getattr(f, measure) for (_, label), f in found.items() if label == way]).mean(0)


def table(found: Mapping[tuple[str, str], Found], ways: Mapping[str, Way]) -> list[dict[str, object]]:
    """One row per way: means over poses and sets of handles."""
    rows = []
    for way in ways:
        mean = {m: over_sets(found, way, m) for m in ("before", "rough", "free", "known")}
        mine = [f for (_, label), f in found.items() if label == way]
        rows.append(
            {
                "way": way,
                "handles, cm": 100 * mean["before"].mean().item(),
                "median": 100 * torch.cat([f.before for f in mine]).median().item(),
                "after the finish, worst, mm": 1000 * torch.cat([f.after for f in mine]).max().item(),
                "free joints, cm": 100 * mean["rough"].mean().item(),
                "after the finish, cm": 100 * mean["free"].mean().item(),
                "to the nearest known pose, cm": 100 * mean["known"].mean().item(),
            }
        )
    return rows
