"""Down to the belly over a knee, both knees and the hands, and up the same way."""

import math

import torch

from data_synth.actions.gait import OTHER
from data_synth.actions.standing import ease
from data_synth.anatomy import RADIUS
from data_synth.perform import KNEE, solve
from data_synth.score import BOTH, SIDES, SIGN, Score
from motionlab.skeleton import fk

#: How far the heel is raised over toes that are tucked under, radians.
TUCKED = 1.26
#: Half the distance between the knees, metres.
HALF = 0.07
#: Trunk and head of someone on all fours.
FOURS = {"pitch": 1.38, "flex": 0.10, "steady": 0.35, "nod": -0.2, "twist": 0.0, "bend": 0.0}


def knee_ahead(score: Score) -> float:
    """How far in front of the place of a foot with tucked toes its knee meets the floor, metres."""
    s = score.subject
    _, down, long = s.skeleton.offsets[s.skeleton.index("left_foot")].tolist()
    height = s.skeleton.sole - down * math.cos(TUCKED) + long * math.sin(TUCKED)
    behind = -down * math.sin(TUCKED) - long * math.cos(TUCKED)
    return long + behind + math.sqrt(s.length("left_ankle") ** 2 - (height - KNEE) ** 2)


def kneel_down(score: Score) -> None:
    """A foot back, the other forward, the knee of the first to the floor, then the other knee beside it."""
    s, v, t = score.subject, score.uniform, score.now
    front = score.choose(SIDES)
    back, h = OTHER[front], score.value["heading"]
    ahead, down = knee_ahead(score) - 0.10, v(1.1, 1.4) / s.tempo
    score.move("low", 1.0, t, 0.5)
    score.pose(t, 0.6, z=0.92 * s.standing, sway=0.0)
    t += 0.35
    score.step(back, score.local(SIGN[back] * HALF, -0.10), h, t, t + 0.42, height=0.04, heel=0.3, early=0.12)
    t += 0.45
    place = score.local(SIGN[front] * HALF, ahead + 0.33 * s.leg / 0.9)
    score.step(front, place, h, t + 0.15, t + 0.70, height=0.06, heel=0.4, toe=0.1, early=0.12)
    x, y = score.local(0.0, ahead)
    score.release(back, t + 0.05, "ankle")
    score.move(f"{back}_heel", TUCKED, t + 0.05, 0.85)
    score.pose(t + 0.05, 0.5 + 0.7 * down, x=x, y=y)
    score.pose(t, 0.65 + down, z=KNEE + s.length("left_knee") + s.hip_drop, pitch=0.10, flex=0.15)
    score.limb(BOTH, t + 0.3, down, elbow=0.6, abduct=0.3, rotate=0.0, raised=0.35)
    t += 0.65 + down
    score.move(f"{back}_kneel", 1.0, t - 0.8 * down, 0.8 * down)
    score.plant(back, t, "knee")
    score.move("low", 0.0, t, 0.5)
    x, y = score.local(SIGN[front] * HALF, -knee_ahead(score))  # the foot in front goes behind, on its ball
    t, span = t + 0.1, v(0.9, 1.2) / s.tempo
    score.release(front, t, "ankle", "foot")
    score.limb(front, t, span, foot_x=x, foot_y=y)
    score.limb(front, t + 0.3 * span, 0.65 * span, heel=TUCKED)
    score.pulse(f"{front}_lift", 0.11, t, 0.45 * span, 0.55 * span)
    score.limb(front, t + 0.25 * span, 0.5 * span, kneel=1.0)
    score.plant(front, t + span, "foot", "knee")
    score.now = t + span


def _hands(score: Score, start: float, duration: float) -> None:
    """Both hands to the floor, in front of where the shoulders will be."""
    h, skeleton = score.value["heading"], score.subject.skeleton.to(torch.float64)
    reached = {name: torch.tensor([value], dtype=torch.float64) for name, value in score.value.items()}
    positions, _ = fk(skeleton, *solve(score.subject, reached))
    for side in SIDES:
        x, y, _ = positions[0, skeleton.index(f"{side}_shoulder")].tolist()
        out = SIGN[side] * 0.08
        x, y = x - out * math.cos(h) - 0.10 * math.sin(h), y - out * math.sin(h) + 0.10 * math.cos(h)
        score.limb(side, start - 0.02, 0.02, hand_x=x, hand_y=y, hand_z=RADIUS["left_wrist"])
        score.move(f"{side}_grip", 1.0, start, duration)
        score.plant(side, start + duration, "wrist")


def to_belly(score: Score) -> None:
    """From the knees to all fours, hips forward and down between the hands, legs out, arms to the sides."""
    s, v = score.subject, score.uniform
    t, span = score.now, v(0.9, 1.2) / s.tempo
    score.pose(t, span, **FOURS)
    score.limb(BOTH, t, 0.8 * span, elbow=0.9, abduct=0.1, rotate=0.0, raised=1.35)
    _hands(score, t + 0.1 + 0.3 * span, 0.7 * span)
    t, span = t + 0.1 + span, v(1.1, 1.5) / s.tempo
    x, y = score.local(0.0, 0.96 * s.length("left_knee"))
    score.pose(t, span, x=x, y=y, z=0.14, pitch=math.pi / 2, flex=-0.05, steady=0.0, nod=-0.3)
    t += span
    score.release(BOTH, t, "knee", "foot")
    score.move("settle", 1.0, t, 0.35)
    t += 0.25
    score.limb(BOTH, t - 0.02, 0.02, hip_flex=0.03, knee=0.08, ankle=1.05, hip_abduct=0.06, hip_twist=0.0)
    score.limb(BOTH, t, 0.9, loose=1.0, kneel=0.0)
    score.limb(BOTH, t - 0.3, 0.7, elbow=0.3, abduct=0.4, rotate=0.0, raised=-0.45)
    score.release(BOTH, t + 0.4, "wrist")
    score.limb(BOTH, t + 0.4, 1.0, grip=0.0)
    score.limb(BOTH, t + 1.2, 0.6, raised=-0.05)
    score.now = t + 1.8


def from_belly(score: Score) -> None:
    """Hands beside the chest, toes tucked, push up to all fours, sit up on the knees."""
    s, v, t = score.subject, score.uniform, score.now
    knee = s.length("left_knee")
    for side in SIDES:
        x, y = score.local(SIGN[side] * HALF, -0.96 * knee - knee_ahead(score))
        score.limb(side, t - 0.02, 0.02, foot_x=x, foot_y=y, foot_yaw=score.value["heading"], heel=TUCKED)
    score.limb(BOTH, t, 0.9, loose=0.0, kneel=1.0)
    score.plant(BOTH, t + 1.25, "knee", "foot")
    score.pose(t, 0.8, z=0.14)
    score.move("settle", 0.0, t + 0.9, 0.35)
    score.limb(BOTH, t - 0.2, 0.5, elbow=0.3, abduct=0.4, rotate=0.0, raised=-0.45)
    score.limb(BOTH, t + 1.1, 0.9, elbow=0.9, abduct=0.1, rotate=0.0, raised=1.35)
    was = dict(score.value)
    x, y = score.local(0.0, -0.96 * knee)
    up = {"x": x, "y": y, "z": KNEE + knee + s.hip_drop, **FOURS}
    score.value |= up
    _hands(score, t + 0.25, 0.85)
    score.value |= {name: was[name] for name in up}
    t, span = t + 1.25, v(1.1, 1.5) / s.tempo
    score.pose(t, span, **up)
    t, span = t + span, v(0.8, 1.1) / s.tempo
    score.release(BOTH, t, "wrist")
    score.limb(BOTH, t, 0.6 * span, grip=0.0)
    score.limb(BOTH, t + 0.2 * span, span, elbow=0.5, abduct=0.25, raised=0.3)
    score.pose(t + 0.15 * span, span, pitch=0.08, flex=0.12, steady=0.8, nod=0.0)
    score.now = t + 1.2 * span


def stand_up(score: Score) -> None:
    """A foot forward, weight over it, the other foot beside it."""
    s, v = score.subject, score.uniform
    t, span, up = score.now, v(0.9, 1.2) / s.tempo, v(1.2, 1.5) / s.tempo
    front = score.choose(SIDES)
    back = OTHER[front]
    x, y = score.local(SIGN[front] * HALF, 0.33 * s.leg / 0.9)
    score.release(front, t, "knee", "foot")
    score.move(f"{front}_kneel", 0.0, t + 0.2 * span, 0.5 * span)
    score.limb(front, t, span, foot_x=x, foot_y=y)
    score.move(f"{front}_heel", 0.0, t + 0.05 * span, 0.65 * span)
    score.pulse(f"{front}_lift", 0.11, t, 0.55 * span, 0.45 * span)
    score.plant(front, t + span, "ankle", "foot")
    score.move("low", 1.0, t, span)
    score.move("low", 0.0, t + span + 0.8 * up, 0.7 * up)
    t += span
    x, y = score.local(0.0, 0.33 * s.leg / 0.9 + 0.035)
    score.release(back, t, "knee")
    score.move(f"{back}_kneel", 0.0, t, 0.5 * up)
    score.pose(t, 1.05 * up, x=x, y=y)
    score.pose(t, 0.5 * up, pitch=0.45, flex=0.25)
    score.move("z", s.standing - 0.02, t + 0.12 * up, up)
    lift, land = t + 0.5 * up, t + 1.1 * up
    x, y = score.stance(back)
    score.release(back, lift, "foot")
    score.limb(back, lift, land - lift, foot_x=x, foot_y=y)
    score.nudge(f"{back}_foot_yaw", SIGN[back] * s.toe_out, lift, land - lift)
    score.move(f"{back}_heel", 0.0, lift, 0.9 * (land - lift))
    score.pulse(f"{back}_lift", 0.06, lift, 0.45 * (land - lift), 0.55 * (land - lift))
    score.plant(back, land, "foot", "ankle")
    ease(score, t + 0.6 * up, 0.8 * up)
    score.now = t + 1.5 * up
