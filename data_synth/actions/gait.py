"""Footfalls and what the body does about them: the machinery of every walk, turn and run."""

import math
from dataclasses import dataclass

from data_synth.score import BOTH, SIGN, Score

OTHER = {"left": "right", "right": "left"}


@dataclass(frozen=True)
class Gait:
    """One manner of stepping; lengths in metres, angles in radians, shares of the stride (two steps) or step.

    duty: share of the stride that a foot is on the floor. width: between the ankles. clearance: lift of the
    whole foot. heel, toe: heel raised at toe-off, toes raised at touch-down. bob, sway: amplitudes of the
    pelvis up and sideways (it sinks further where the step is long). yaw, twist, tilt: of the pelvis' and the
    trunk's rotations. swing, elbow: of the arms. drop: how much lower than standing. lean: forward lean of the
    trunk. limp: how much one leg is spared, the left one if positive: the trunk leans over it and sinks, and its foot
    rolls less.
    """

    duty: float = 0.61
    width: float = 0.11
    clearance: float = 0.035
    heel: float = 1.05
    toe: float = 0.30
    bob: float = 0.018
    sway: float = 0.018
    yaw: float = 0.07
    twist: float = 0.14
    tilt: float = 0.05
    swing: float = 0.32
    elbow: float = 0.25
    drop: float = 0.022
    lean: float = 0.04
    limp: float = 0.0


def tread(
    score: Score, centres: list[tuple[float, float]], headings: list[float], step_time: float, gait: Gait, first: str
) -> None:
    """Walk over a list of places, one step for each, and end with both feet under the body.

    centres: where the middle of the body passes at each footfall, world metres; the last one repeats the one
    before, so that the feet close. The pelvis goes from place to place with overlapping minimum-jerk moves,
    each centred at its heel strike: fastest in double support, as people are.
    """
    swing_time, begin = (1 - gait.duty) * 2 * step_time, score.now
    side, strike = first, begin + 0.30 + swing_time
    score.move("low", 0.02, begin, strike - begin)  # no leg lands straight
    # lean over the foot that stays, and sink a little, before the first step
    score.move("sway", -SIGN[first] * 1.6 * gait.sway, begin, 0.9 * (strike - begin))
    score.move("z", score.subject.standing - gait.drop, begin, strike - begin)
    score.pose(begin, 0.6, pitch=0.5 * gait.lean, flex=0.5 * gait.lean)
    parity = 0.0 if first == "left" else 0.5
    was = score.value["x"], score.value["y"]
    for k, ((x, y), heading) in enumerate(zip(centres, headings, strict=True)):
        last = k == len(centres) - 1
        lift = strike - swing_time
        score.pose(strike - step_time, 2 * step_time, x=x, y=y, heading=heading)
        _footfall(score, side, (x, y), heading, lift, strike, gait, step_time, last=last)
        _body(score, side, strike, step_time, gait, math.dist(was, (x, y)), last=last)
        score.gait.append((strike, parity + 0.5 * k))
        side, strike, was = OTHER[side], strike + step_time, (x, y)
    score.move("low", 0.0, strike, 0.6)
    score.now = strike + 0.25


def _footfall(score, side, centre, heading, lift, strike, gait, step_time, *, last) -> None:
    half = SIGN[side] * (gait.width if not last else 1.3 * gait.width) / 2
    x = centre[0] - half * math.cos(heading) + 0.035 * math.sin(heading)
    y = centre[1] - half * math.sin(heading) - 0.035 * math.cos(heading)
    dx, dy = x - score.value[f"{side}_foot_x"], y - score.value[f"{side}_foot_y"]
    way = math.hypot(dx, dy)
    ahead = -dx * math.sin(heading) + dy * math.cos(heading)
    size = min(1.0, way / (0.9 * score.subject.leg))  # short steps roll less
    roll = size * (1 - 0.4 * max(0.0, SIGN[side] * gait.limp))
    forward = max(0.0, ahead) / way if way > 1e-6 else 0.0
    support = gait.duty * 2 * step_time
    early = min((0.34 + 2.5 * max(0.0, gait.drop - 0.03)) * support, 0.45)  # who walks low lifts the heel sooner
    score.step(
        side, (x, y), heading + SIGN[side] * score.subject.toe_out, lift, strike,
        height=gait.clearance * (0.6 + 0.4 * size), heel=0.25 + (gait.heel - 0.25) * roll,
        toe=gait.toe * size * forward * (0.4 if last else 1.0), early=early, late=0.12 * support,
        shape=(0.5, 0.5, 1.5), rise=0.32, fall=0.50,
    )  # fmt: skip


def _body(score: Score, side: str, strike: float, step_time: float, gait: Gait, length: float, *, last: bool) -> None:
    sign, s = SIGN[side], score.subject
    on = 0.0 if last else 1.0
    middle = strike + 0.5 * step_time  # the other leg passes
    longer = 1.15 * step_time
    vary = 1 + 0.15 * score.uniform(-1, 1)
    spared = on * max(0.0, sign * gait.limp)
    sunk = max(gait.drop + gait.bob, 0.88 * length**2 / (8 * s.leg))  # as two straight legs make it, nearly
    low, high = s.standing - sunk, s.standing - gait.drop + 1.2 * gait.bob - 0.05 * spared
    score.move("z", low, strike - 0.50 * step_time, 0.5 * step_time)
    score.move("z", high if not last else s.standing, strike + 0.03 * step_time, 0.5 * step_time * (1 + last))
    score.move("sway", on * sign * (gait.sway + 0.04 * spared) * vary, middle - longer, longer)
    yaw, twist = -on * sign * gait.yaw * vary, on * sign * (gait.yaw + gait.twist) * vary
    score.pose(strike - longer, longer, yaw=yaw, twist=twist)
    tilt, bend = on * sign * gait.tilt * vary, -on * sign * (0.8 * gait.tilt + 0.25 * spared) * vary
    score.pose(strike - 0.35 * step_time, 0.7 * step_time, tilt=tilt, bend=bend)
    if last:
        score.pose(strike - 0.2, 0.7, pitch=0.5 * s.lean, flex=0.5 * s.lean)
    lag = 0.04 * step_time
    for arm, size, bent in ((side, -0.9, 0.25), (OTHER[side], 1.0, 1.0)):
        score.limb(arm, strike - longer + lag, longer, raised=0.05 + on * gait.swing * size * vary)
        score.limb(arm, strike - longer + 3 * lag, longer, elbow=s.elbow + on * (bent * gait.elbow))
    score.limb(BOTH, strike - longer, longer, abduct=s.carriage - on * 0.02)
