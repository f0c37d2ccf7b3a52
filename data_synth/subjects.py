"""Who moves: proportions per segment and a personal style."""

from dataclasses import dataclass, replace

import torch

from motionlab.skeleton import STANDARD, Skeleton

SEGMENTS = {
    "thigh": ("left_knee", "right_knee"), "shin": ("left_ankle", "right_ankle"), "foot": ("left_foot", "right_foot"),
    "hips": ("left_hip", "right_hip"), "trunk": ("spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"),
    "head": ("head",), "shoulders": ("left_shoulder", "right_shoulder"), "arm": ("left_elbow", "right_elbow"),
    "forearm": ("left_wrist", "right_wrist"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Subject:
    """One person: a skeleton and habits.

    skeleton: STANDARD with other segment lengths. walk_ratio: step length per cadence, metres per (step/min),
    for a leg of 0.9 m. step_width: metres between the ankles in gait. arm_swing, bounce, twist: factors on the
    amplitude of the arms, of the vertical bob and of the trunk's counter-rotation. lean: forward trunk lean,
    radians. elbow: habitual elbow flexion, radians. toe_out: foot angle, radians. carriage: how far the arms hang
    from the body, radians. tempo: factor on the speed of gestures. restless: factor on sway and noise.
    """

    name: str
    skeleton: Skeleton
    walk_ratio: float = 0.0064
    step_width: float = 0.11
    arm_swing: float = 1.0
    bounce: float = 1.0
    twist: float = 1.0
    lean: float = 0.03
    elbow: float = 0.30
    toe_out: float = 0.12
    carriage: float = 0.16
    tempo: float = 1.0
    restless: float = 1.0

    def length(self, joint: str) -> float:
        """Distance from a joint to its parent, metres."""
        return float(self.skeleton.offsets[self.skeleton.index(joint)].norm())

    @property
    def leg(self) -> float:
        """Hip to ankle, metres."""
        return self.length("left_knee") + self.length("left_ankle")

    @property
    def ankle(self) -> float:
        """Height of the ankle joint above the floor under a flat foot, metres."""
        return float(self.skeleton.sole - self.skeleton.offsets[self.skeleton.index("left_foot"), 1])

    @property
    def hip_drop(self) -> float:
        """How far the hip joints lie below the pelvis joint, metres."""
        return -float(self.skeleton.offsets[self.skeleton.index("left_hip"), 1])

    @property
    def standing(self) -> float:
        """Height of the pelvis when standing at ease, knees all but straight, metres."""
        return self.ankle + 0.998 * self.leg + self.hip_drop


def proportioned(scale: float = 1.0, **segments: float) -> Skeleton:
    """STANDARD times ``scale``, each named segment of SEGMENTS times its own factor as well."""
    factor = torch.full((len(STANDARD), 1), scale)
    for segment, value in segments.items():
        factor[STANDARD.indices(list(SEGMENTS[segment]))] *= value
    return replace(STANDARD, offsets=STANDARD.offsets * factor, sole=STANDARD.sole * scale * segments.get("foot", 1.0))


#: Four people, as many as the thesis had.
SUBJECTS = (
    Subject("ada", STANDARD),
    Subject(
        "ben", proportioned(1.06, thigh=1.02, shin=1.03, shoulders=1.10, arm=1.03, hips=0.96),
        walk_ratio=0.0067, step_width=0.14, arm_swing=0.75, bounce=0.8, twist=0.8, lean=0.05, elbow=0.38,
        toe_out=0.22, carriage=0.24, tempo=0.88, restless=0.8,
    ),
    Subject(
        "cai", proportioned(0.93, thigh=0.97, trunk=1.02, shoulders=0.93, forearm=0.97),
        walk_ratio=0.0060, step_width=0.08, arm_swing=1.30, bounce=1.25, twist=1.35, lean=0.0, elbow=0.42,
        toe_out=0.05, carriage=0.14, tempo=1.15, restless=1.3,
    ),
    Subject(
        "dee", proportioned(0.99, thigh=1.04, shin=0.97, trunk=0.97, shoulders=1.03, arm=0.97, forearm=1.04),
        walk_ratio=0.0062, step_width=0.10, arm_swing=1.10, bounce=1.1, twist=1.1, lean=0.09, elbow=0.20,
        toe_out=0.17, carriage=0.20, tempo=1.0, restless=1.1,
    ),
)  # fmt: skip
