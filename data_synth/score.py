"""The score of a performance: what each control of the body does when, before it becomes a pose.

Actions write minimum-jerk moves into named channels; :func:`data_synth.perform.perform` plays them. As all
actions write into one score, there is no seam between them: every channel has continuous acceleration.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise

import torch

from data_synth.curves import MINIMUM_JERK, quintic
from data_synth.subjects import Subject

SIDES, BOTH = ("left", "right"), "both"
#: +1 where left is positive (x of the rest frame).
SIGN = {"left": 1.0, "right": -1.0}

_BODY = (
    "x", "y", "z", "heading", "sway", "surge", "yaw", "pitch", "roll", "tilt", "flex", "bend", "twist",
    "nod", "turn", "cock", "steady", "settle", "air", "bent", "low",
)  # fmt: skip
SIDED = (
    "raised", "abduct", "rotate", "elbow", "pronate", "wrist", "shrug",  # the arm, by angles
    "grip", "hand_x", "hand_y", "hand_z",  # the arm, by where the wrist is
    "foot_x", "foot_y", "lift", "foot_yaw", "heel", "toe", "splay", "kneel",  # the leg, by where the foot is
    "loose", "hip_flex", "hip_abduct", "hip_twist", "knee", "ankle",  # the leg, by angles
)  # fmt: skip
#: All channels: metres, radians, or weights between 0 and 1 (steady, settle, air, bent, low, grip, kneel, loose).
CHANNELS = _BODY + tuple(f"{side}_{name}" for name in SIDED for side in SIDES)


def _of(side: str, *parts: str) -> list[str]:
    return [f"{each}_{part}" for part in parts for each in (SIDES if side == BOTH else (side,))]


def uniform(generator: torch.Generator, low: float, high: float) -> float:
    """One draw from [low, high)."""
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


@dataclass
class Score:
    """What a subject does: quintic pieces per channel, contacts, labels and phase, and the time reached.

    Body: x, y, z of the pelvis (sway and surge to its left and forward); heading, then yaw, pitch (forward),
    roll (about the long axis), tilt; flex, bend, twist of the spine; nod, turn, cock of the head, which is held
    level with weight ``steady``; settle: weight with which the body lies on the floor; air: 1 in flight;
    bent: 1 where no leg may come near its full length; low: where the pelvis gives way before one does, as well.
    """

    subject: Subject
    generator: torch.Generator
    now: float = 0.0
    value: dict[str, float] = field(default_factory=dict)
    initial: dict[str, float] = field(default_factory=dict)
    pieces: list[tuple[str, float, float, tuple[float, ...]]] = field(default_factory=list)
    contacts: list[tuple[str, float, float]] = field(default_factory=list)
    labels: list[tuple[float, float, str]] = field(default_factory=list)
    gait: list[tuple[float, float]] = field(default_factory=list)
    planted: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s = self.subject
        self.value = dict.fromkeys(CHANNELS, 0.0)
        self.value |= {"z": s.standing, "steady": 1.0, "pitch": 0.5 * s.lean, "flex": 0.5 * s.lean}
        for side in SIDES:
            self.value |= {f"{side}_{name}": v for name, v in self.arm_at_ease().items()}
            x, y = self.stance(side)
            self.value |= {f"{side}_foot_x": x, f"{side}_foot_y": y, f"{side}_foot_yaw": SIGN[side] * s.toe_out}
            self.plant(side, 0.0, "ankle", "foot")
        self.initial = dict(self.value)

    def uniform(self, low: float, high: float) -> float:
        """One draw from [low, high)."""
        return uniform(self.generator, low, high)

    def choose(self, options):
        """One of several options."""
        return options[int(torch.randint(len(options), (), generator=self.generator))]

    def chance(self, p: float) -> bool:
        """True with probability p."""
        return self.uniform(0, 1) < p

    def arm_at_ease(self) -> dict[str, float]:
        """Angles of an arm that hangs."""
        s = self.subject
        return {"raised": 0.05, "abduct": s.carriage, "rotate": 0.15, "elbow": s.elbow, "pronate": 0.1, "wrist": 0.05}

    def stance(self, side: str) -> tuple[float, float]:
        """Where a foot stands under the body at its present place and heading: (x, y), metres."""
        return self.local(SIGN[side] * (self.subject.step_width * 1.5) / 2, -0.035)

    def local(self, left: float, forward: float) -> tuple[float, float]:
        """World (x, y) of a point given to the left and in front of the pelvis."""
        h = self.value["heading"]
        x, y = self.value["x"], self.value["y"]
        return x - left * math.cos(h) - forward * math.sin(h), y - left * math.sin(h) + forward * math.cos(h)

    def move(self, channel: str, to: float, start: float, duration: float) -> None:
        """Bring a channel to a value with one minimum-jerk move that may overlap earlier ones."""
        self.nudge(channel, to - self.value[channel], start, duration)

    def nudge(self, channel: str, by: float, start: float, duration: float) -> None:
        """Change a channel by an amount with one minimum-jerk move."""
        if by != 0.0:
            self.pieces.append((channel, start, duration, tuple(by * c for c in MINIMUM_JERK)))
            self.value[channel] += by

    def pulse(self, channel: str, by: float, start: float, rise: float, fall: float, hold: float = 0.0) -> None:
        """There and back again."""
        self.nudge(channel, by, start, rise)
        self.nudge(channel, -by, start + rise + hold, fall)

    def knots(self, channel: str, knots: list[tuple[float, float, float, float]]) -> None:
        """A chain of quintics through (time, value, velocity, acceleration); first and last must be at rest."""
        for (t0, *a), (t1, *b) in pairwise(knots):
            self.pieces.append((channel, t0, t1 - t0, quintic(tuple(a), tuple(b), t1 - t0)))
        self.value[channel] += knots[-1][1] - knots[0][1]

    def pose(self, start: float, duration: float, **to: float) -> None:
        """Several channels at once."""
        for channel, value in to.items():
            self.move(channel, value, start, duration)

    def limb(self, side: str, start: float, duration: float, **to: float) -> None:
        """Several channels of one side at once, or of BOTH."""
        self.pose(start, duration, **{name: value for part, value in to.items() for name in _of(side, part)})

    def plant(self, side: str, start: float, *parts: str) -> None:
        """Contact joints of a side, or of BOTH, touch down at a time, those that do not stand already."""
        for joint in _of(side, *parts):
            self.planted.setdefault(joint, start)

    def release(self, side: str, stop: float, *parts: str) -> None:
        """Contact joints of a side, or of BOTH, leave the floor at a time."""
        for joint in _of(side, *parts):
            if joint in self.planted:
                self.contacts.append((joint, self.planted.pop(joint), stop))

    @contextmanager
    def action(self, label: str) -> Iterator[None]:
        """Label what is written inside, from the time reached before to the time reached after."""
        begin = self.now
        yield
        self.labels.append((begin, self.now, label))

    def step(
        self, side: str, to: tuple[float, float], yaw: float, lift: float, land: float, *,
        height: float, heel: float, toe: float = 0.0, early: float, late: float = 0.1,
        shape: tuple[float, float, float] | None = None, rise: float = 0.45, fall: float = 0.55,
    ) -> None:  # fmt: skip
        """Move a foot from where it stands to another place.

        lift, land: the times when the ball leaves the floor and the foot touches it again. heel: radians the
        heel is raised, from ``early`` seconds before lift on. toe: radians the toes are raised at touch-down,
        lowered within ``late`` seconds. shape: (time, way, speed) shares through which the swing passes. rise,
        fall: shares of the swing in which the whole foot is lifted and lowered.
        """
        swing = land - lift
        for channel, value in ((f"{side}_foot_x", to[0]), (f"{side}_foot_y", to[1])):
            if shape is None:
                self.move(channel, value, lift, swing)
            else:
                at, way, speed = shape
                start, by = self.value[channel], value - self.value[channel]
                middle = (lift + at * swing, start + way * by, speed * by / swing, 0.0)
                self.knots(channel, [(lift, start, 0.0, 0.0), middle, (land, value, 0.0, 0.0)])
        self.move(f"{side}_foot_yaw", yaw, lift, swing)
        self.pulse(f"{side}_lift", height, lift, rise * swing, fall * swing)
        self.pulse(f"{side}_heel", heel, lift - early, early + 0.2 * swing, 0.55 * swing)
        self.pulse(f"{side}_toe", toe, lift + 0.45 * swing, 0.5 * swing, 0.05 * swing + late)
        self.release(side, lift - early, "ankle")
        self.release(side, lift, "foot")
        self.plant(side, land + late if toe else land, "ankle", "foot")
