"""Getting about: walking, running, turning on the spot."""

from __future__ import annotations

import math
from dataclasses import replace

from data_synth.actions.gait import Gait, tread
from data_synth.score import Score


def walking_gait(score: Score, speed: float) -> tuple[float, float, Gait]:
    """Step length, step time and manner of a walk at ``speed`` m/s.

    length = sqrt(60 speed W): people keep the walk ratio W = length / cadence over speeds.
    Source: Sekiya & Nagasaki 1998 (W about 0.0064 m min); Murray 1984 (stance 60 %, less when faster).
    """
    s = score.subject
    ratio = s.walk_ratio * s.leg / 0.902
    length = math.sqrt(60 * speed * ratio)
    brisk = speed / 1.3
    gait = Gait(
        duty=min(0.67, 0.665 - 0.045 * speed),
        width=s.step_width,
        clearance=0.030 + 0.008 * brisk,
        heel=0.85 + 0.25 * brisk,
        toe=0.12 + 0.18 * brisk,
        bob=0.016 * brisk * s.bounce,
        sway=0.020 / (0.6 + 0.4 * brisk),
        yaw=0.075 * brisk * s.twist,
        twist=0.13 * brisk * s.twist,
        tilt=0.045 * brisk,
        swing=0.33 * brisk * s.arm_swing,
        elbow=0.28 * brisk * s.arm_swing,
        drop=0.020 + 0.006 * brisk,
        lean=s.lean + 0.03 * (brisk - 1),
    )
    return length, length / speed, gait


def walk(
    score: Score,
    *,
    seconds: float = 4.0,
    speed: float | None = None,
    turn: float = 0.0,
    manner: str | None = None,
) -> None:
    """Walk for about ``seconds`` at ``speed`` m/s (drawn if None) while the heading changes by ``turn`` radians."""
    speed = score.uniform(0.8, 1.6) if speed is None else speed
    with score.action("walk"):
        length, step_time, gait = walking_gait(score, speed)
        gait = styled(score, gait, manner)
        steps = max(2, round((seconds - 0.55) / step_time) - 1)
        centres, headings = _path(score, length, turn, steps)
        tread(score, centres, headings, step_time, gait, score.choose(("left", "right")))


def styled(score: Score, gait: Gait, manner: str | None) -> Gait:
    """A gait in a manner: proud, tired, sneaking, marching, or a personal one drawn around the usual."""
    v = score.uniform
    gait = replace(
        gait, swing=gait.swing * v(0.8, 1.2), twist=gait.twist * v(0.8, 1.2), lean=gait.lean + v(-0.02, 0.02)
    )
    if manner is None:
        return gait
    return {
        "proud": replace(gait, lean=gait.lean - 0.10, swing=1.2 * gait.swing, bob=1.2 * gait.bob),
        "tired": replace(
            gait, lean=gait.lean + 0.28, swing=0.4 * gait.swing, heel=0.75 * gait.heel, drop=gait.drop + 0.02
        ),
        "sneaking": replace(gait, lean=gait.lean + 0.35, drop=gait.drop + 0.10, clearance=0.10, swing=0.3 * gait.swing),
        "marching": replace(gait, swing=1.6 * gait.swing, elbow=0.4 * gait.elbow, clearance=0.09, bob=0.8 * gait.bob),
    }[manner]


def _path(score: Score, length: float, turn: float, steps: int) -> tuple[list[tuple[float, float]], list[float]]:
    """Places and headings of the footfalls: a first half step, full steps along an arc, and a step to close."""
    x, y, heading = (score.value[name] for name in ("x", "y", "heading"))
    centres, headings = [], []
    for k in range(steps):
        share = 0.5 - 0.5 * math.cos(math.pi * (k + 1) / steps)
        new = score.value["heading"] + turn * share
        way = (0.72 if k == 0 else 0.9 if k == steps - 1 and steps > 2 else 1.0) * length
        middle = (heading + new) / 2
        x, y, heading = x - way * math.sin(middle), y + way * math.cos(middle), new
        centres.append((x, y))
        headings.append(heading)
    return [*centres, centres[-1]], [*headings, heading]
