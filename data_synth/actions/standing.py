"""What people do with their arms, and one leg, while they stand: idle, reach, wave, punch, kick."""

from data_synth.actions.gait import OTHER
from data_synth.score import BOTH, SIDES, SIGN, Score


def ease(score: Score, start: float, duration: float) -> None:
    """Bring trunk, head and arms back to standing at ease."""
    s = score.subject
    score.pose(
        start, duration, z=s.standing, sway=0, surge=0, yaw=0, pitch=0.5 * s.lean, flex=0.5 * s.lean, tilt=0,
        bend=0, twist=0, nod=0, turn=0, cock=0, steady=1,
    )  # fmt: skip
    score.limb(BOTH, start, duration, shrug=0, **score.arm_at_ease())


def lean_on(score: Score, side: str, start: float, duration: float, amount: float = 0.045) -> None:
    """Put the weight on one leg; the other hip drops."""
    score.pose(
        start, duration, sway=SIGN[side] * amount, tilt=SIGN[side] * amount, bend=-SIGN[side] * 0.9 * amount,
        z=score.subject.standing - 0.003,
    )  # fmt: skip


def restep(score: Score, side: str, forward: float, outward: float, start: float, duration: float = 0.45) -> None:
    """Put a foot elsewhere, given in metres in front of and beside its place under the body."""
    half = score.subject.step_width * 0.75 + outward
    place = score.local(SIGN[side] * half, forward - 0.035)
    yaw = score.value["heading"] + SIGN[side] * score.subject.toe_out
    score.step(side, place, yaw, start, start + duration, height=0.045, heel=0.4, early=0.2)


def idle(score: Score, *, seconds: float = 4.0) -> None:
    """Stand about: breathe, shift the weight, look around, fidget, now and then move a foot."""
    begin, side, v = score.now, score.choose(SIDES), score.uniform
    with score.action("idle"):
        while score.now < begin + seconds - 0.8:
            span = min(v(1.2, 2.6) / score.subject.tempo, begin + seconds - score.now)
            lean_on(score, side, score.now, 0.8 * span, v(0.01, 0.055))
            if score.chance(0.6):
                score.pose(score.now, 0.7, turn=v(-0.8, 0.8), nod=v(-0.15, 0.3))
            if score.chance(0.5):
                _fidget(score, score.choose(SIDES), score.now + 0.2, 0.9)
            if score.chance(0.25):
                restep(score, OTHER[side], v(-0.06, 0.08), v(-0.01, 0.06), score.now + 0.6 * span)
            side = OTHER[side] if score.chance(0.7) else side
            score.now += span
        ease(score, score.now, 0.8)
        score.now += 0.8


def _fidget(score: Score, side: str, start: float, duration: float) -> None:
    v = score.uniform
    pose = score.choose((
        score.arm_at_ease(),
        {"raised": v(-0.3, -0.1), "abduct": v(0.55, 0.7), "rotate": v(-0.5, -0.3), "elbow": v(1.5, 1.75)},  # on the hip
        {"raised": v(0.45, 0.65), "abduct": v(0.05, 0.12), "rotate": v(-0.7, -0.5), "elbow": v(1.4, 1.7)},  # folded
        {"raised": v(0.9, 1.1), "abduct": v(0.10, 0.25), "rotate": v(-0.2, 0.1), "elbow": v(2.1, 2.3)},  # to the chin
    ))  # fmt: skip
    score.limb(side, start, duration, **pose)


def reach(score: Score) -> None:
    """Reach twice for things, high, low, across, to the side, with one or both hands, and look there."""
    with score.action("reach"):
        for _ in range(2):
            side, both = score.choose(SIDES), score.chance(0.3)
            sign, v, fast = SIGN[side], score.uniform, score.subject.tempo
            go, hold, back = v(0.55, 0.95) / fast, v(0.1, 0.5), v(0.6, 0.9) / fast
            height = v(-0.2, 1.0)  # low .. high
            across = 0.0 if both else v(-0.35, 0.9)
            start = score.now
            for arm in SIDES if both else (side,):
                score.limb(
                    arm, start, go, rotate=v(-0.2, 0.1), elbow=v(0.15, 0.5), pronate=v(-0.3, 0.6),
                    abduct=across if arm == side and not both else v(0.0, 0.2), raised=1.30 + 0.72 * height,
                )  # fmt: skip
            deep = max(0.0, -height) + v(0.0, 0.3)
            score.pose(
                start - 0.05, 1.1 * go, pitch=0.15 + 0.9 * deep, flex=0.12 + 0.5 * deep, surge=-0.06 * deep,
                z=score.subject.standing - 0.12 * deep, twist=-sign * (0.25 - 0.45 * across) * (not both),
                sway=sign * 0.04 * across, turn=sign * 0.5 * across, nod=-0.35 * height, steady=0.6,
            )  # fmt: skip
            ease(score, start + go + hold, back)
            score.now = start + go + hold + back


def wave(score: Score, *, times: int | None = None) -> None:
    """Raise a hand and wave."""
    with score.action("wave"):
        side, v, fast = score.choose(SIDES), score.uniform, score.subject.tempo
        times = int(v(3, 6)) if times is None else times
        abduct, rotate, elbow = v(0.9, 1.5), v(1.0, 1.25), v(1.3, 1.8)
        raising, beat, size = v(0.45, 0.7) / fast, v(0.20, 0.28) / fast, v(0.22, 0.5)
        score.limb(side, score.now, raising, abduct=abduct, rotate=rotate, elbow=elbow, pronate=-0.4, raised=v(0, 0.4))
        lean_on(score, OTHER[side], score.now, raising, 0.03)
        score.pose(score.now, raising, turn=SIGN[side] * v(-0.2, 0.4), cock=v(-0.1, 0.1))
        score.now += 0.85 * raising
        for k in range(2 * times):
            out = 1 if k % 2 else -1
            score.limb(side, score.now, 1.2 * beat, elbow=elbow + out * size, abduct=abduct + 0.15 * out * size)
            score.nudge("bend", 0.02 * out, score.now, 1.2 * beat)
            score.now += beat
        ease(score, score.now, v(0.7, 0.9) / fast)
        score.now += 0.9 / fast


def guard(score: Score, lead: str, start: float, duration: float) -> None:
    """A fighter's stance: one foot back, knees soft, fists before the face."""
    back = OTHER[lead]
    restep(score, back, -0.32, 0.04, start + 0.15, 0.4)
    z = score.subject.standing - 0.055 * score.subject.leg / 0.9
    score.pose(start, duration, surge=-0.165, z=z, pitch=0.10, flex=0.18, steady=0.9)
    score.pose(start, duration, yaw=SIGN[back] * 0.30, twist=SIGN[back] * 0.05)
    score.limb(BOTH, start, duration, abduct=0.22, rotate=-0.25, pronate=0.3)
    for side, ahead in ((lead, 0.15), (back, 0.0)):
        score.limb(side, start, duration, elbow=2.05 - ahead, raised=0.75 + ahead)


def bounce(score: Score, start: float, stop: float) -> None:
    """Spring in the knees two to three times a second, the weight going from one leg to the other."""
    side = score.choose((-1, 1))
    while start < stop - 0.3:
        down, up = score.uniform(0.15, 0.2), score.uniform(0.17, 0.24)
        score.pulse("z", -score.uniform(0.028, 0.052) * score.subject.leg / 0.9, start, down, up)
        score.pulse("sway", side * score.uniform(0.0, 0.035), start, 1.3 * down, 1.3 * up)
        score.pulse("surge", score.uniform(-0.03, 0.015), start, 1.3 * down, 1.3 * up)
        for arm in SIDES:
            score.pulse(f"{arm}_raised", score.uniform(-0.10, 0.06), start + 0.04, down, up)
        start += down + up - 0.02
        side = -side


def advance(score: Score, lead: str, by: float, start: float) -> None:
    """Shift the whole stance by metres forward; the foot on that side goes first."""
    x, y = score.local(0.0, by)
    score.pose(start, 0.38, x=x, y=y)
    first = lead if by > 0 else OTHER[lead]
    for side, begin in ((first, start), (OTHER[first], start + 0.2)):
        restep(score, side, 0.0 if side == lead else -0.32, 0.04 * (side != lead), begin, 0.24)


def punch(score: Score) -> None:
    """Take a stance and throw straight punches and hooks: fast out, slower back."""
    lead, v = score.choose(SIDES), score.uniform
    with score.action("punch"):
        guard(score, lead, score.now, 0.7)
        score.now += 0.8
        side, begin = lead, score.now - 0.2
        for k in range(int(v(4, 9))):
            if k and score.chance(0.4):  # look for an opening
                advance(score, lead, v(-0.14, 0.14), score.now + 0.05)
                score.now += v(0.5, 0.9)
            sign, out, back = SIGN[side], v(0.17, 0.24) / score.subject.tempo, v(0.28, 0.4)
            was = {name: score.value[f"{side}_{name}"] for name in ("raised", "abduct", "rotate", "elbow", "shrug")}
            hook = score.chance(0.3)
            to = {"raised": v(1.35, 1.6), "abduct": v(-0.12, 0.05), "rotate": -0.3, "elbow": v(0.12, 0.3)}
            if hook:
                to = {"raised": v(1.0, 1.2), "abduct": v(0.7, 0.9), "rotate": v(-1.2, -0.9), "elbow": v(1.35, 1.6)}
            to["shrug"] = 0.1 if hook else 0.12
            turn = (0.40 if side == lead else 0.65) * (1.2 if hook else 1.0)
            score.limb(side, score.now, out, **to)
            score.pulse("twist", -sign * turn, score.now - 0.05, out, 1.1 * back)
            score.pulse("yaw", -sign * 0.55 * turn, score.now - 0.09, out, 1.1 * back)
            score.pulse("surge", v(0.04, 0.07), score.now - 0.05, 1.2 * out, back)
            score.limb(side, score.now + out, back, **was)
            score.now += out + v(0.75, 1.3) * back
            side = OTHER[side] if score.chance(0.65) else side
        bounce(score, begin, score.now)
        score.now += 0.15
        restep(score, OTHER[lead], 0.0, 0.0, score.now + 0.25, 0.42)
        ease(score, score.now, 0.85)
        score.now += 0.95


def kick(score: Score) -> None:
    """Stand on one leg and kick: knee up, snap, knee back, foot down."""
    v = score.uniform
    with score.action("kick"):
        side = score.choose(SIDES)
        sign, stance = SIGN[side], OTHER[side]
        start, high, wide = score.now, v(1.3, 1.8), v(0.0, 0.45)
        lean_on(score, stance, start, 0.5, 0.075)
        score.limb(BOTH, start, 0.5, abduct=0.3, rotate=-0.1, elbow=1.6, raised=0.5)
        up = start + 0.45
        score.release(side, up - 0.15, "ankle")
        score.pulse(f"{side}_heel", 0.5, up - 0.15, 0.22, 0.3)
        score.release(side, up, "foot")
        score.limb(side, up - 0.1, 0.01, hip_flex=0.35, knee=0.75, ankle=0.25)
        chamber, snap, fold, down = 0.34, v(0.19, 0.24), v(0.22, 0.28), 0.42
        score.pulse(f"{side}_loose", 1.0, up, 0.8 * chamber, down, 0.2 * chamber + snap + fold)
        score.pulse(f"{side}_lift", 0.17, up, 0.15, down, chamber + snap + fold - 0.15)
        score.limb(side, up, chamber, hip_flex=0.85 * high, knee=v(1.5, 1.8), hip_abduct=wide, ankle=0.5)
        score.limb(side, up + chamber, snap, hip_flex=high, knee=v(0.15, 0.3), ankle=0.7)
        score.limb(side, up + chamber + snap, fold, hip_flex=0.8 * high, knee=1.5)
        score.limb(side, up + chamber + snap + fold, down, hip_flex=0.2, knee=0.4, hip_abduct=0.0, ankle=0.0)
        score.pulse("pitch", -0.16 * high, up, chamber + snap, fold + down)
        score.pulse("flex", 0.10, up, chamber + snap, fold + down)
        score.pulse("yaw", -sign * 0.25, up + 0.1, chamber + snap, fold + down)
        score.pulse("twist", sign * 0.3, up + 0.1, chamber + snap, fold + down)
        score.limb(stance, up, chamber + snap, elbow=1.1, abduct=0.5)
        score.limb(side, up, chamber + snap, elbow=0.9, abduct=0.4, raised=-0.3)
        land = up + chamber + snap + fold + down
        score.plant(side, land, "ankle", "foot")
        ease(score, land - 0.15, 0.8)
        score.now = land + 0.7
