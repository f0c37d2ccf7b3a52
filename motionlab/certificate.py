"""Certifies rigs: whether a recording on the standard 22 joints says again what the file said."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch

from motionlab import rotation
from motionlab.motion import Motion
from motionlab.retarget import match_joints, put_on, retarget
from motionlab.rigs import dropped_joints

PLACE, ANGLE = 0.02, 5.0  # metres and degrees that a round trip may cost, at the 95th percentile
_CLOSE = 0.95


@dataclass(frozen=True)
class Certificate:
    """What the way of recordings of one rig to the standard 22 joints and back costs.

    rig: names and parents. file: the first recording. files: how many. joints: of the 22 that the rig has. source:
    where its rest pose is taken from. place, angle: metres and degrees by which the body's joints are off, at the
    95th percentile, in the worst recording. lost: joints that stand where one of the 22 is missing.
    """

    rig: tuple
    file: str
    files: int
    joints: int
    source: str
    place: float
    angle: float
    lost: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing is lost and the way costs no more than ``PLACE`` and ``ANGLE``."""
        return not self.lost and self.place <= PLACE and self.angle <= ANGLE


def by_rig(certificates: Iterable[Certificate]) -> list[Certificate]:
    """Returns the worst of every rig, in the order in which they come; rigs differ in names or tree."""
    found: dict[object, Certificate] = {}
    for row in certificates:
        old = found.get(row.rig, replace(row, files=0))
        worst = {"place": max(old.place, row.place), "angle": max(old.angle, row.angle)}
        found[row.rig] = replace(old, files=old.files + row.files, **worst)
    return list(found.values())


def certify(motion: Motion) -> Certificate:
    """Certifies the rig of one recording (T frames).

    Raises:
        DataError: a skeleton whose joints are not known.
    """
    body, motion = match_joints(motion), motion.to(torch.float64)
    skeleton = motion.skeleton
    back = put_on(retarget(motion, floor=False, body=body).motion, skeleton, body)
    lost = dropped_joints(skeleton, body.joints)
    judged = set(body.joints.values()) | set(lost)
    for j in range(len(skeleton) - 1, 0, -1):  # what carries the body belongs to it, fingers and faces do not
        if j in judged and j != body.joints["pelvis"]:
            judged.add(skeleton.parents[j])
    judged |= {j for j, parent in enumerate(skeleton.parents) if parent in lost}
    joints = sorted(judged)
    place = (back.positions - motion.positions).norm(dim=-1)[:, joints]
    angle = torch.rad2deg(rotation.geodesic(back.world[1], motion.world[1]))[:, joints]
    return Certificate(
        rig=(skeleton.names, skeleton.parents),
        file=motion.name,
        files=1,
        joints=len(body.joints),
        source=body.source,
        place=float(place.flatten().quantile(_CLOSE)),
        angle=float(angle.flatten().quantile(_CLOSE)),
        lost=tuple(skeleton.names[j] for j in lost),
    )
