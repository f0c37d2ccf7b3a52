"""Down to the floor: sit down on it, lie back, roll over and over or to the belly, sit up, stand up."""

import math

from data_synth.actions.kneeling import from_belly, kneel_down, stand_up, to_belly
from data_synth.actions.standing import ease
from data_synth.score import BOTH, SIDES, SIGN, Score


def floor(score: Score, *, rolls: float | None = None, way: str | None = None) -> None:
    """Lie down, roll about the long axis ``rolls`` times half a turn and back (drawn if None), get up.

    way (drawn if None): "kneel", over a knee, both knees and the hands to the belly and back; or "seat", over a
    squat and the seat to the back.

    Lying, the body is posed by angles and laid on the floor by its lowest part; pelvis contact is on while it
    rests. The feet leave their places when the seat is down, and are put flat again before the body rises.
    """
    s, v = score.subject, score.uniform
    rolls = score.choose((0, 1, 1, 2, -1, -2)) if rolls is None else rolls
    way = score.choose(("kneel", "kneel", "seat")) if way is None else way
    with score.action("lie down"):
        if way == "kneel":
            kneel_down(score)
            to_belly(score)
        else:
            _to_seat(score, 1.5 / s.tempo)
            _to_back(score, v(1.3, 1.8) / s.tempo)
    with score.action("lie"):
        score.now += 1.0
        _roll(score, rolls, -1 if way == "kneel" else 1)
        score.now += 1.0
    with score.action("get up"):
        if way == "kneel":
            from_belly(score)
            stand_up(score)
        else:
            _sit_up(score, v(1.2, 1.6) / s.tempo)
            _rise(score, v(1.2, 1.6) / s.tempo)


def _to_seat(score: Score, down: float) -> None:
    """Squat, hands to the back, until the seat is on the floor."""
    s, t = score.subject, score.now
    score.pose(t, down, z=0.36 * s.leg + 0.05, surge=-0.36 * s.leg / 0.9, pitch=0.10, flex=0.85, steady=0.7)
    score.limb(BOTH, t, down, elbow=0.5, abduct=0.5, rotate=0.0, raised=-0.1, splay=0.15)
    score.release(BOTH, t + 0.2 * down, "ankle")
    score.limb(BOTH, t + 0.2 * down, 0.6 * down, heel=0.42)
    t += down
    score.release(BOTH, t, "foot")
    score.limb(BOTH, t, 0.5, heel=0.0)
    # the pose by angles that the blend goes to: seated, knees drawn up
    score.limb(BOTH, t - 0.02, 0.02, hip_flex=1.95, knee=1.95, ankle=0.0, hip_abduct=0.1, hip_twist=0.0)
    score.move("settle", 1.0, t, 0.3)
    score.limb(BOTH, t + 0.3, 0.8, loose=1.0)
    score.pose(t + 0.1, 1.0, z=0.12, pitch=-0.20, flex=0.55)
    score.now = t + 1.1


def _to_back(score: Score, span: float) -> None:
    t = score.now
    score.pose(t, span, pitch=-math.pi / 2, flex=0.05, steady=0.0, nod=0.05)
    score.limb(BOTH, t + 0.15 * span, span, hip_flex=0.04, knee=0.12, ankle=0.5, hip_abduct=0.08)
    score.limb(BOTH, t + 0.3 * span, span, elbow=0.25, abduct=0.45, rotate=0.0, raised=0.10)
    score.limb(BOTH, t, span, splay=0.0)
    score.now = t + 1.4 * span


def _roll(score: Score, rolls: float, left: int) -> None:
    """Half turns about the long axis, arms at the sides; back again, or on to a whole turn. left: 1 where a positive
    turn carries the body to the left of its heading (head behind), -1 where to the right."""
    if not rolls:
        return
    v, way = score.uniform, 1 if rolls > 0 else -1
    score.limb(BOTH, score.now, 0.9, abduct=0.06, elbow=0.15, rotate=0.1, raised=0.06)
    score.now += 0.8
    score.limb(BOTH, score.now, 1.0, ankle=0.95)
    turns = [way] * 2 if abs(rolls) > 1 else [way, -way]
    for turn in turns:
        t, span = score.now, v(1.2, 1.8) / score.subject.tempo
        score.nudge("roll", turn * math.pi, t, span)
        x, y = score.local(left * turn * 0.42, 0.0)
        score.pose(t, span, x=x, y=y)
        lead, other = ("left", "right") if turn > 0 else ("right", "left")
        for side, bend in ((lead, 0.1), (other, 0.55)):
            score.pulse(f"{side}_hip_flex", bend, t, 0.5 * span, 0.5 * span)
            score.pulse(f"{side}_knee", 1.5 * bend, t, 0.5 * span, 0.5 * span)
        score.pulse("twist", turn * 0.25, t, 0.5 * span, 0.6 * span)
        score.now += span + v(0.2, 0.8)
    score.limb(BOTH, score.now, 0.9, elbow=0.3, abduct=0.45, rotate=0.0, raised=0.10)
    score.now += 0.9


def _sit_up(score: Score, span: float) -> None:
    t = score.now
    score.pose(t, span, pitch=-0.15, flex=0.75, nod=0.0)
    score.limb(BOTH, t, span, hip_flex=1.95, knee=1.95, ankle=0.0, hip_abduct=0.1)
    score.limb(BOTH, t, span, elbow=0.35, abduct=0.3, raised=0.8)
    score.now = t + span


def _rise(score: Score, up: float) -> None:
    """Put the feet down in front of the seat, bring the weight over them, stand."""
    s, t = score.subject, score.now
    for side in SIDES:
        fx, fy = score.stance(side)
        yaw = score.value["heading"] + SIGN[side] * s.toe_out
        score.limb(side, t - 0.5, 0.4, foot_x=fx, foot_y=fy, foot_yaw=yaw)
    score.limb(BOTH, t, 0.7, heel=0.42)
    score.limb(BOTH, t, 0.8, loose=0.0)
    score.plant(BOTH, t + 1.15, "foot")
    score.move("settle", 0.0, t + 0.8, 0.35)
    score.pose(t, 0.8, pitch=0.10, flex=0.8, steady=0.7, z=0.40 * s.leg + 0.05)
    t += 1.15
    score.limb(BOTH, t, 0.7 * up, heel=0.0)
    score.plant(BOTH, t + 0.7 * up, "ankle")
    score.pose(t, up, z=s.standing, surge=0.0)
    ease(score, t + 0.15 * up, 0.95 * up)
    score.now = t + 1.15 * up
