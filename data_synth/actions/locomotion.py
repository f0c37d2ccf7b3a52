"""Getting about: walking, running, turning on the spot."""

import math
from dataclasses import replace
from itertools import accumulate

from data_synth.actions.gait import OTHER, Gait, tread
from data_synth.actions.standing import ease
from data_synth.score import BOTH, SIDES, SIGN, Score

GRAVITY = 9.81


def walking_gait(score: Score, speed: float) -> tuple[float, float, Gait]:
    """Step length, step time and manner of a walk at ``speed`` m/s.

    length = sqrt(60 speed W): people keep the walk ratio W = length / cadence over speeds above 1 m/s.
    Source: Murakami & Otaka 2017 (constancy and where it ends); Terrier & Schutz 2003 (W 0.41 m s, that is 0.0068
    m min, the same within 12 % among people). The share of stance is our choice.
    """
    s = score.subject
    ratio = s.walk_ratio * s.leg / 0.902
    length = math.sqrt(60 * speed * ratio)
    brisk = speed / 1.3
    gait = Gait(
        duty=min(0.60, 0.60 - 0.045 * speed), width=s.step_width, clearance=0.050 + 0.015 * brisk,
        heel=0.95 + 0.20 * brisk, toe=0.12 + 0.18 * brisk, bob=0.017 * brisk**1.2 * s.bounce,
        sway=0.020 / (0.6 + 0.4 * brisk), yaw=0.10 * brisk * s.twist, twist=0.13 * brisk * s.twist, tilt=0.045 * brisk,
        swing=0.42 * brisk * s.arm_swing, elbow=0.28 * brisk * s.arm_swing, drop=0.012 + 0.020 * brisk**2,
        lean=s.lean + 0.03 * (brisk - 1),
    )  # fmt: skip
    return length, length / speed, gait


def walk(
    score: Score, *, seconds: float = 4.0, speed: float | None = None, turn: float = 0.0, manner: str | None = None,
) -> None:  # fmt: skip
    """Walk for about ``seconds`` at ``speed`` m/s (drawn if None) while the heading changes by ``turn`` radians.

    manner: None, or one of MANNERS; people who step backwards or sideways keep to about half the speed.
    """
    speed = score.uniform(0.8, 1.6) if speed is None else speed
    with score.action("walk"):
        length, step_time, gait = walking_gait(score, speed)
        gait = styled(score, gait, manner)
        steps = max(2, round((seconds - 0.55) / step_time) - 1)
        first = score.choose(SIDES)
        if manner == "sideways":
            way = SIGN[first] * 0.45 * length  # to that side, and the other foot beside it
            centres = [score.local(way * (k // 2 + 1), 0.0) for k in range(2 * max(1, steps // 2))]
            headings = [score.value["heading"]] * len(centres)
        else:
            centres, headings = _path(score, length * (-0.55 if manner == "backwards" else 1.0), turn, steps)
        tread(score, centres, headings, step_time, gait, first)


#: How people may walk, apart from the usual.
MANNERS = ("proud", "tired", "sneaking", "marching", "limping", "backwards", "sideways")


def styled(score: Score, gait: Gait, manner: str | None) -> Gait:
    """A gait in one of MANNERS, or for None a personal one drawn around the usual."""
    v, g = score.uniform, gait
    g = replace(g, swing=g.swing * v(0.87, 1.13), twist=g.twist * v(0.85, 1.15), lean=g.lean + v(-0.01, 0.01))
    if manner is None:
        return g
    return replace(g, **{
        "proud": {"lean": g.lean - 0.02, "swing": 1.2 * g.swing, "bob": 1.2 * g.bob},
        "tired": {"lean": g.lean + 0.28, "swing": 0.4 * g.swing, "heel": 0.75 * g.heel, "drop": g.drop + 0.01},
        "sneaking": {"lean": g.lean + 0.35, "drop": g.drop + 0.015, "clearance": 0.10, "swing": 0.3 * g.swing},
        "marching": {"swing": 1.6 * g.swing, "elbow": 0.4 * g.elbow, "clearance": 0.09, "bob": 0.8 * g.bob},
        "limping": {"limp": score.choose((-1, 1)) * v(0.4, 0.7), "swing": 0.7 * g.swing},
        "backwards": {"heel": 0.5 * g.heel, "swing": 0.35 * g.swing, "bob": 0.5 * g.bob},
        "sideways": {"width": 1.4 * g.width, "heel": 0.4, "swing": 0.15 * g.swing, "yaw": 0.0, "twist": 0.05},
    }[manner])  # fmt: skip


def _path(score: Score, length: float, turn: float, steps: int) -> tuple[list[tuple[float, float]], list[float]]:
    """Places and headings of the footfalls: a first half step, full steps along an arc, and a step to close."""
    begun = score.value["heading"]
    last = steps - 1 if steps > 2 else 0
    shares = [{last: 0.9, 0: 0.72}.get(k) or score.uniform(0.96, 1.04) for k in range(steps)]
    headings = [begun + turn * (k + 1) / steps for k in range(steps)]
    centres = _along(score, [share * length for share in shares], headings)
    return [*centres, centres[-1]], [*headings, headings[-1]]


def _along(score: Score, ways: list[float], headings: list[float]) -> list[tuple[float, float]]:
    """Places that steps of so many metres lead to, each half in the old heading and half in the new."""
    x, y, heading = (score.value[name] for name in ("x", "y", "heading"))
    places = []
    for way, new in zip(ways, headings, strict=True):
        middle = (heading + new) / 2
        x, y, heading = x - way * math.sin(middle), y + way * math.cos(middle), new
        places.append((x, y))
    return places


def turn(score: Score, *, angle: float | None = None) -> None:
    """Turn on the spot by ``angle`` radians to the left (drawn if None) in small steps; head and eyes lead."""
    angle = score.choose((-1, 1)) * score.uniform(0.8, 3.2) if angle is None else angle
    with score.action("turn"):
        steps = max(1, math.ceil(abs(angle) / score.uniform(0.5, 0.85)))
        step_time = score.uniform(0.42, 0.56) / score.subject.tempo
        gait = Gait(
            duty=0.66, width=1.3 * score.subject.step_width, clearance=0.045, heel=0.5, toe=0.0, bob=0.007, sway=0.03,
            yaw=0.04, twist=0.04, tilt=0.03, swing=0.12, elbow=0.12, drop=0.007, lean=score.subject.lean,
        )  # fmt: skip
        lead = math.copysign(min(0.5, abs(angle) / 2), angle)
        score.pulse("turn", lead, score.now, 0.5, steps * step_time + 0.4, 0.1)
        score.pulse("twist", 0.3 * lead, score.now + 0.1, 0.5, steps * step_time + 0.3, 0.1)
        here = (score.value["x"], score.value["y"])
        headings = [score.value["heading"] + angle * (k + 1) / steps for k in range(steps)]
        tread(score, [here] * (steps + 1), [*headings, headings[-1]], step_time, gait, "left" if angle > 0 else "right")


def run(score: Score, *, seconds: float = 4.5, speed: float | None = None, turn: float = 0.0) -> None:
    """Run for about ``seconds`` at ``speed`` m/s (drawn if None), with a flight phase after every step.

    Between toe-off and the next landing the pelvis is in free fall, z'' = -g; in stance a quintic joins the two.
    Source: Cavanagh & Kram 1989 (stride frequency rises by only 4 % from 3.2 to 4.1 m/s).
    The share of flight and every amplitude are our own choice.
    """
    s = score.subject
    speed = score.uniform(2.0, 3.2) if speed is None else speed
    with score.action("run"):
        step_time = math.sqrt(s.leg / 0.902) / (2.45 + 0.12 * speed)
        flight = step_time * min(0.42, 0.24 + 0.04 * speed)
        stance = step_time - flight  # of a step: the other foot is in the air throughout
        count = max(6, round((seconds - 1.5) / step_time))
        ways = [0.4, 0.75] + [1.0] * (count - 4) + [0.75, 0.4]
        headings = list(accumulate([turn / count] * count, initial=score.value["heading"]))[1:]
        places = _along(score, [w * speed * step_time for w in ways], headings)
        first = side = score.choose(SIDES)
        strikes = [score.now + 0.75 + k * step_time for k in range(count)]
        _run_height(score, strikes, stance, flight)
        for k, strike in enumerate(strikes):
            _run_step(score, side, strike, stance, flight, places[k], headings[k], ways[k])
            score.gait.append((strike, (0.0 if first == "left" else 0.5) + 0.5 * k))
            side = OTHER[side]
        lift, stop = strikes[-1] - flight, strikes[-1] + stance + 0.22
        yaw = headings[-1] + SIGN[side] * s.toe_out
        score.step(side, score.stance(side), yaw, lift, stop, height=0.10, heel=0.9, early=0.6 * stance)
        ease(score, strikes[-1] + 0.25, 0.8)
        score.now = strikes[-1] + 1.1


def _run_height(score: Score, strikes: list[float], stance: float, flight: float) -> None:
    """Parabola in flight, quintic in stance; a dip to start from and one to stop in."""
    s, g = score.subject, GRAVITY
    up = g * flight / 2
    level = s.standing - 0.064 * s.leg
    dip = strikes[0] - flight - 0.22
    knots = [(score.now, score.value["z"], 0, 0), (dip, level - 0.06, 0, 0), (strikes[0] - flight, level, up, -g)]
    for strike in strikes[:-1]:
        knots += [(strike, level, -up, -g), (strike + stance, level, up, -g)]
    end = strikes[-1]
    knots += [(end, level, -up, -g), (end + 0.18, level - 0.015, 0, 0), (end + 0.80, s.standing, 0, 0)]
    score.knots("z", knots)
    score.pulse("bent", 1.0, score.now, 0.5, 0.5, end - score.now - 0.4)
    score.pulse("air", 1.0, strikes[0] - flight - 0.1, 0.15, 0.15, end - strikes[0] + flight)


def _run_step(score, side, strike, stance, flight, place, heading, way) -> None:
    s, sign = score.subject, SIGN[side]
    step_time = stance + flight
    middle = strike + stance / 2
    score.pose(middle - 2.0 * step_time, 3 * step_time, x=place[0], y=place[1], heading=heading)
    half, ahead = sign * 0.3 * s.step_width, -0.035 + 0.04
    x = place[0] - half * math.cos(heading) - ahead * math.sin(heading)
    y = place[1] - half * math.sin(heading) + ahead * math.cos(heading)
    lift = max(score.now + 0.2, strike - (step_time + flight))
    score.step(
        side, (x, y), heading + sign * 0.5 * s.toe_out, lift, strike, height=0.10 + 0.10 * way, heel=0.95 + 0.3 * way,
        toe=0.10, early=0.75 * stance, late=0.05, shape=(0.55, 0.50, 1.55),
    )  # fmt: skip
    score.pose(middle - step_time, step_time, sway=sign * 0.012, tilt=sign * 0.05, bend=-sign * 0.04)
    yaw, twist = -sign * 0.13 * s.twist, sign * 0.32 * s.twist
    score.pose(middle - 1.1 * step_time, 1.1 * step_time, yaw=yaw, twist=twist)
    score.pose(middle - 2 * step_time, 2 * step_time, pitch=0.07 + 0.06 * way, flex=0.10 + 0.04 * way)
    for arm in SIDES:
        out = 1 if arm == OTHER[side] else -1
        swung = 0.05 + out * (0.62 if out > 0 else 0.68) * s.arm_swing**0.5 * (0.4 + 0.6 * way)
        score.limb(arm, middle - 1.1 * step_time, 1.1 * step_time, elbow=1.5 + 0.40 * out, raised=swung)
    score.limb(BOTH, middle - 1.1 * step_time, 1.1 * step_time, abduct=0.28, rotate=-0.25)
