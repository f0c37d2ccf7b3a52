"""Down and up again with both feet on the floor: sit on a chair, crouch, jump."""

import math

from data_synth.actions.standing import ease
from data_synth.score import BOTH, SIDES, SIGN, Score

GRAVITY = 9.81


def sit(score: Score, *, seconds: float = 3.0) -> None:
    """Sit down on a chair, stay for ``seconds``, and stand up.

    Hips go back, the trunk leans forward until they touch, the feet stay. The pelvis joint rests 9 cm above
    the seat. A chair is no floor: the pelvis' contact stays off.
    """
    s, v = score.subject, score.uniform
    seat, down, up = v(0.40, 0.50), v(1.3, 1.9) / s.tempo, v(1.2, 1.7) / s.tempo  # seat: its height, metres
    knee = s.ankle + s.length("left_ankle")
    back = math.sqrt(max(0.05, s.length("left_knee") ** 2 - (seat + 0.08 - knee) ** 2)) + v(-0.03, 0.02)
    with score.action("sit down"):
        t = score.now
        score.pose(t, 0.75 * down, pitch=v(0.40, 0.55), flex=v(0.25, 0.40), steady=0.75)
        score.pose(t + 0.10 * down, 0.9 * down, z=seat + 0.09, surge=0.02 - back)
        for side in SIDES:
            score.limb(side, t, 0.7 * down, elbow=0.45, abduct=0.25, raised=v(0.25, 0.8))
            score.move(f"{side}_splay", v(0.0, 0.15), t, down)
        score.pose(t + 0.65 * down, 0.7 * down, pitch=v(-0.15, 0.0), flex=v(0.1, 0.25), steady=0.9)
        _hands_on_lap(score, t + 0.6 * down, 0.7 * down)
        score.now += 1.4 * down
    with score.action("sit"):
        end = score.now + seconds
        while score.now < end - 0.6:
            span = min(v(1.0, 2.0), end - score.now)
            look = {"turn": v(-0.6, 0.6), "nod": v(-0.1, 0.35), "pitch": v(-0.2, 0.08), "flex": v(0.05, 0.4)}
            look |= {"twist": v(-0.15, 0.15), "bend": v(-0.08, 0.08), "cock": v(-0.1, 0.1)}
            score.pose(score.now, 0.8 * span, **look)
            if score.chance(0.4):
                side = score.choose(SIDES)
                score.limb(side, score.now, 0.5, elbow=v(1.2, 2.1), rotate=v(-0.4, 0.2), raised=v(0.3, 1.0))
            else:
                _hands_on_lap(score, score.now, 0.7)
            score.now += span
    with score.action("stand up"):
        t = score.now
        score.pose(t, 0.6 * up, pitch=v(0.55, 0.70), flex=v(0.25, 0.4), twist=0, bend=0, turn=0, steady=0.7)
        for side in SIDES:
            score.limb(side, t, 0.6 * up, elbow=0.5, abduct=0.2, rotate=0.0, raised=v(0.4, 0.8))
            score.move(f"{side}_splay", 0.0, t + 0.3 * up, up)
        score.pose(t + 0.35 * up, 0.9 * up, z=s.standing, surge=0)
        ease(score, t + 0.6 * up, 0.75 * up)
        score.now += 1.4 * up


def _hands_on_lap(score: Score, start: float, duration: float) -> None:
    v = score.uniform
    for side in SIDES:
        pose = {"raised": v(0.30, 0.45), "abduct": v(0.10, 0.2), "rotate": v(-0.45, -0.15), "elbow": v(1.0, 1.25)}
        score.limb(side, start, duration, pronate=0.6, **pose)


def crouch(score: Score) -> None:
    """Go down on the haunches by 0.25 to 0.62 of the leg's length, stay for a second, come up."""
    s, v = score.subject, score.uniform
    with score.action("crouch"):
        t, depth, down, up = score.now, v(0.25, 0.62), v(0.8, 1.2) / s.tempo, v(0.8, 1.2) / s.tempo
        rise, lean = (depth - 0.12) * 2.1, v(0.9, 1.2) * depth
        score.pose(t, down, z=s.standing - depth * s.leg + 0.09 * rise, surge=-0.20 * depth + 0.10 * rise)
        score.pose(t, down, pitch=0.8 * lean, flex=0.5 * lean, steady=0.8, nod=v(0.0, 0.4))
        for side in SIDES:
            score.limb(side, t, down, elbow=v(0.4, 1.2), abduct=v(0.1, 0.3), rotate=v(-0.3, 0.1), raised=v(0.7, 1.2))
            score.move(f"{side}_splay", v(0.1, 0.3), t, down)
        score.release(BOTH, t + 0.25 * down, "ankle")
        score.limb(BOTH, t + 0.25 * down, 0.75 * down, heel=rise)
        if score.chance(0.6):  # pick something up
            side = score.choose(SIDES)
            low = t + down - 0.2
            score.limb(side, low, 0.5, elbow=0.15, rotate=0.0, raised=0.9)
            score.pulse("twist", -SIGN[side] * 0.25, low, 0.5, 0.5)
            score.limb(side, low + 0.6, 0.6, elbow=1.3, raised=0.8)
        score.now += down + 1.0
        t = score.now
        score.limb(BOTH, t, up, splay=0.0)
        score.limb(BOTH, t, 0.7 * up, heel=0.0)
        score.plant(BOTH, t + 0.7 * up, "ankle")
        ease(score, t, 1.1 * up)
        score.now += 1.15 * up


def jump(score: Score, *, height: float | None = None) -> None:
    """Jump off both feet, ``height`` metres (drawn if None), on the spot or ahead, with or without a turn on the way.

    Crouch, extend, fly as gravity has it (z'' = -g between take-off and landing), absorb.
    """
    s, v = score.subject, score.uniform
    speed = math.sqrt(2 * GRAVITY * (v(0.10, 0.32) if height is None else height))
    distance, spin = score.choose((0.0, v(0.1, 0.6))), score.choose((0.0, 0.0, v(-1.6, 1.6)))  # metres, radians
    flight = 2 * speed / GRAVITY
    with score.action("jump"):
        t, sink, push, give = score.now, v(0.45, 0.7), v(0.30, 0.36), v(0.26, 0.34)
        off, land = t + sink + push, t + sink + push + flight
        low, out = s.standing - v(0.22, 0.28) * s.leg / 0.9, s.standing - 0.065
        bottom = s.standing - v(0.16, 0.25) * s.leg / 0.9
        score.knots("z", [
            (t, score.value["z"], 0, 0), (t + sink, low, 0, 0), (off, out, speed, -GRAVITY),
            (land, out, -speed, -GRAVITY), (land + give, bottom, 0, 0), (land + give + 0.6, s.standing, 0, 0),
        ])  # fmt: skip
        _go(score, distance, t + sink, off, land, land + give)
        score.nudge("heading", spin, off - 0.10, flight + 0.2)
        score.pulse("air", 1.0, off - 0.10, 0.12, 0.12, flight - 0.04)
        for side in SIDES:
            _leap(score, side, spin, off, land, speed, flight)
            score.limb(side, t, sink, elbow=0.25, abduct=0.2, rotate=0.0, raised=-0.75)
            score.limb(side, t + sink - 0.02, push + 0.08, elbow=0.6, raised=v(1.2, 2.2))
            score.limb(side, off + 0.5 * flight, 0.5 * flight + give, elbow=0.5, abduct=0.35, raised=0.5)
        score.pose(t, sink, pitch=0.50, flex=0.28, surge=-0.22, steady=0.85)
        score.pose(t + sink, push, pitch=0.03, flex=-0.02, surge=0)
        score.pose(land - 0.12, give + 0.12, pitch=0.34, flex=0.22, surge=-0.19)
        ease(score, land + give + 0.02, 0.65)
        score.now = land + give + 0.75


def _go(score: Score, distance: float, start: float, off: float, land: float, stop: float) -> None:
    """Carry the pelvis ahead at constant speed while in the air."""
    h, flight = score.value["heading"], land - off
    for channel, part in (("x", -math.sin(h) * distance), ("y", math.cos(h) * distance)):
        x, v = score.value[channel], 0.75 * part / flight
        a, b = 0.10 * part, 0.85 * part
        score.knots(channel, [(start, x, 0, 0), (off, x + a, v, 0), (land, x + b, v, 0), (stop + 0.1, x + part, 0, 0)])


def _leap(score: Score, side: str, spin: float, off: float, land: float, speed: float, flight: float) -> None:
    """One foot of a jump: roll up on the ball, follow the body through the air, land on the ball, set the heel down."""
    catch = min(0.09, 0.3 * flight)
    v1, y1 = speed - GRAVITY * catch, 0.42 * speed * catch
    score.release(side, off - 0.26, "ankle")
    score.release(side, off, "foot")
    tuck = score.uniform(0.0, 0.10)
    score.knots(f"{side}_lift", [
        (off, 0, 0, 0), (off + catch, y1, v1, -GRAVITY), (land - catch, y1, -v1, -GRAVITY), (land, 0, 0, 0)
    ])  # fmt: skip
    score.pulse(f"{side}_lift", tuck, off + 0.1 * flight, 0.4 * flight, 0.4 * flight)
    score.pulse(f"{side}_heel", 0.75, off - 0.26, 0.26 + 0.4 * catch, 0.14, flight - 0.4 * catch)
    score.pulse(f"{side}_heel", 0.35, off - 0.05, 0.05 + catch, 0.5 * flight)
    x, y = score.stance(side)
    score.limb(side, off, flight, foot_x=x, foot_y=y)
    score.nudge(f"{side}_foot_yaw", spin, off, flight)
    score.plant(side, land, "foot")
    score.plant(side, land + 0.14, "ankle")
