"""AniDance on the 22 joints: 24 markers of a dancer to a motion of the standard body, and a split by dance.

No model of ours has seen these dances. Their floor drifts, so a window is put on the floor by its own lowest foot, and
their markers sit on the skin, so what the body cannot follow is told (``Danced.residual``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from motionlab import rotation, splits
from motionlab.contact import resting_heights
from motionlab.errors import ShapeError
from motionlab.io.points import NAMES, Positions
from motionlab.io.recordings import recordings
from motionlab.motion import Motion, resample, windows
from motionlab.skeleton import FEET, STANDARD, fk

#: Which marker stands for which joint, where one does.
MARKERS = {
    f"{side}_{joint}": f"{side}_{joint}"
    for side in ("left", "right") for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
}  # fmt: skip
STRAIGHT = 0.15  # how much the rest pose says about a hinge, against the sine of its angle
UP, LEFT, FORWARD = torch.eye(3)[[1, 0, 2]]


@dataclass(frozen=True, eq=False)
class Danced:
    """motion: of the standard body at 30 fps. residual: metres from a joint to its marker, mean over all of them."""

    motion: Motion
    residual: float


def load(folder: Path | str, *, most: int | None = None) -> dict[str, list[Danced]]:
    """Dances of ``folder`` / anidance, "train" and "test": every third of a kind (cha-cha, rumba, waltz) is test.

    most: so many of each part, evenly over it; None: all.

    Raises:
        MissingData: there are none. DataError: a file is at fault.
    """
    found: dict[str, list] = {"train": [], "test": []}
    kinds: dict[str, int] = {}
    for _, path, loader in recordings(folder, "anidance"):
        kind = path.stem.split("_")[1]
        kinds[kind] = kinds.get(kind, -1) + 1
        found["train" if kinds[kind] % 3 else "test"].append((path, loader))
    return {part: [danced(loader(path)) for path, loader in splits.evenly(some, most)] for part, some in found.items()}


def cut(dances: Sequence[Danced], length: int, count: int) -> Motion:
    """At most ``count`` windows (N, length) evenly over all dances, each with its lowest foot on the floor."""
    every = [windows(d.motion, length, 10) for d in dances if d.motion.frames >= length]
    root, rot = (torch.cat([getattr(m, name) for m in every]) for name in ("root", "rot"))
    at = torch.linspace(0, len(root) - 1, min(count, len(root))).round().long()
    cuts = replace(every[0], root=root[at], rot=rot[at], name="AniDance")
    feet = [STANDARD.contact_names.index(name) for name in FEET]
    above = cuts.positions[..., STANDARD.indices(FEET), 2] - resting_heights(STANDARD)[feet]
    return replace(cuts, root=cuts.root - above.amin((-1, -2))[:, None, None] * torch.tensor([0.0, 0.0, 1.0]))


# ------------------------------------------------------------------------------------------- markers to joints
def danced(points: Positions) -> Danced:
    """The standard body with its bones along those of the markers: directions, hinges, and the hips' middle.

    Every frame by itself and in closed form: limbs turn with the plane of their hinge, which the rest pose steadies
    where a limb is straight; the spine shares evenly what the shoulders turn against the hips. Wrists stay straight.

    Raises:
        ShapeError: points of another kind.
    """
    if points.names != NAMES:
        raise ShapeError(f"expected AniDance's {len(NAMES)} points, got {len(points.names)} others")
    p = dict(zip(NAMES, points.positions.double().unbind(1), strict=True))
    legs = sum((p[f"{s}_{a}"] - p[f"{s}_{b}"]).norm(dim=-1) for s in ("left", "right") for a, b in _LEG).median() / 2
    own = sum(STANDARD.offsets[STANDARD.index(name)].norm() for name in ("left_knee", "left_ankle"))
    p = {name: x * (own / legs) for name, x in p.items()}
    turns = _orientations(p)
    world = torch.stack([turns[name] for name in STANDARD.names], -3)
    parents = [0, *STANDARD.parents[1:]]
    rot = world[..., parents, :, :].mT @ world
    rot[..., 0, :, :] = world[..., 0, :, :]
    middle = (STANDARD.offsets[1] + STANDARD.offsets[2]).double() / 2
    root = (p["left_hip"] + p["right_hip"]) / 2 - (turns["pelvis"] @ middle)
    placed = fk(STANDARD.to(torch.float64), root, rot)[0]
    apart = torch.stack([placed[:, STANDARD.index(j)] - p[m] for j, m in MARKERS.items()], 1).norm(dim=-1)
    motion = Motion(STANDARD, root.float(), rot.float(), points.fps, name=points.name)
    return Danced(resample(motion, 30.0), apart.mean().item())


_LEG = (("hip", "knee"), ("knee", "ankle"))


def _orientations(p: dict[str, Tensor]) -> dict[str, Tensor]:
    """World orientations (T, 3, 3) of all joints by name."""
    hips, shoulders = ((p[f"left_{part}"] + p[f"right_{part}"]) / 2 for part in ("hip", "shoulder"))
    found = {"pelvis": _aligned(LEFT, UP, p["left_hip"] - p["right_hip"], shoulders - hips)}
    chest = _aligned(UP, LEFT, shoulders - hips, p["left_shoulder"] - p["right_shoulder"])
    third = rotation.exp(rotation.log(found["pelvis"].mT @ chest) / 3)
    found["spine1"] = found["pelvis"] @ third
    found["spine2"], found["spine3"] = found["spine1"] @ third, chest
    crown = (p["left_head"] + p["right_head"]) / 2 - shoulders
    head = _aligned(UP, LEFT, crown, p["left_head"] - p["right_head"])
    found["neck"], found["head"] = chest @ rotation.exp(rotation.log(chest.mT @ head) / 2), head
    for side, sign in (("left", 1.0), ("right", -1.0)):
        found[f"{side}_collar"] = chest
        arm = [p[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist")]
        leg = [p[f"{side}_{part}"] for part in ("hip", "knee", "ankle")]
        upper, fore, _ = _limb(chest, sign * LEFT, -sign * UP, arm)
        thigh, shank, hinge = _limb(found["pelvis"], -UP, LEFT, leg)
        found |= {f"{side}_shoulder": upper, f"{side}_elbow": fore, f"{side}_wrist": fore}
        found |= {f"{side}_hip": thigh, f"{side}_knee": shank}
        foot = _aligned(FORWARD, LEFT, p[f"{side}_toe"] - p[f"{side}_heel"], hinge)
        found |= {f"{side}_ankle": foot, f"{side}_foot": foot}
    return found


def _limb(base: Tensor, along: Tensor, hinge: Tensor, chain: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Orientations of both bones of a limb of three points, and its hinge's axis, world (T, 3).

    along, hinge (3,): of the straight limb at rest, in the frame of ``base`` (T, 3, 3).
    """
    first, second = (torch.nn.functional.normalize(b - a, dim=-1) for a, b in pairwise(chain))
    rest = (base @ along.double()).expand_as(first)
    swung = (rotation.rotation_between(rest, first) @ (base @ hinge.double())[..., None])[..., 0]
    axis = torch.linalg.cross(first, second, dim=-1) + STRAIGHT * swung
    return _aligned(along, hinge, first, axis), _aligned(along, hinge, second, axis), axis


def _aligned(first: Tensor, second: Tensor, to_first: Tensor, to_second: Tensor) -> Tensor:
    """Rotations (..., 3, 3) that take ``first`` to the direction of ``to_first``, ``second`` as near as they can."""
    rest = rotation.sixd_to_matrix(torch.cat((first, second)).double())
    return rotation.sixd_to_matrix(torch.cat((to_first, to_second), -1)) @ rest.mT
