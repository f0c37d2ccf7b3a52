"""Dance on a beat: step-touches, bounces, and arm accents that hit fast and hold."""

from data_synth.actions.gait import OTHER
from data_synth.actions.standing import ease
from data_synth.score import SIDES, SIGN, Score

#: Arm shapes to hit: raise, abduct, rotate, elbow of one arm.
SHAPES = {
    "down": (0.0, 0.25, 0.1, 0.35), "up": (2.15, 0.20, 0.1, 0.35), "out": (0.15, 1.35, 0.1, 0.25),
    "ahead": (1.45, 0.10, 0.0, 0.25), "box": (0.30, 1.30, 1.10, 1.50), "chest": (0.70, 0.55, -0.75, 1.95),
    "hip": (-0.25, 0.65, -0.45, 1.60), "cross": (1.15, -0.10, -0.85, 1.15), "back": (-0.60, 0.30, 0.2, 0.50),
    "point": (1.8, 0.55, 0.0, 0.20), "open": (0.9, 0.95, 0.3, 0.60), "chin": (0.95, 0.20, -0.1, 2.15),
}  # fmt: skip


def dance(score: Score, *, seconds: float = 6.0) -> None:
    """Dance to 96 to 128 beats a minute: phrases of four beats, each phrase with its own moves."""
    beat = 60 / score.uniform(96, 128)
    begin = score.now
    with score.action("dance"):
        score.now += beat
        while score.now + 4 * beat < begin + seconds:
            feet = score.choose((_step_touch, _step_touch, _bounce, _march, _turning, _rock, _vine))
            shapes = [score.choose(tuple(SHAPES)) for _ in range(4)]
            mirror, every = score.chance(0.6), score.choose((1, 1, 2))
            for k in range(4):
                at = score.now + k * beat
                if k % every == 0:
                    _accent(score, shapes[k], shapes[k] if mirror else shapes[(k + 1) % 4], at, beat)
                _groove(score, at, beat, k)
            feet(score, beat)
            score.now += 4 * beat
        _home(score, beat)


def _accent(score: Score, left: str, right: str, at: float, beat: float) -> None:
    """Both arms hit a shape on the beat: a fast move that overlaps a slow one into the hold."""
    fast = score.uniform(0.34, 0.48) * beat + 0.06
    for side, shape in zip(SIDES, (left, right), strict=True):
        raised, abduct, rotate, elbow = (value + score.uniform(-0.06, 0.06) for value in SHAPES[shape])
        score.limb(side, at - fast, fast, abduct=abduct, rotate=rotate, elbow=max(0.15, elbow), raised=raised)


def _groove(score: Score, at: float, beat: float, k: int) -> None:
    """Sink on the beat, rise after it; hips and head go along."""
    v, s = score.uniform, score.subject
    sign = 1 if k % 2 else -1
    dip = v(0.035, 0.075) * s.bounce
    score.move("z", s.standing - 0.025 - dip, at - 0.45 * beat, 0.5 * beat)
    score.move("z", s.standing - 0.025, at + 0.05 * beat, 0.5 * beat)
    score.pose(at - 0.5 * beat, 0.7 * beat, twist=sign * v(0.08, 0.38), yaw=-sign * v(0.0, 0.14))
    score.move("bend", sign * v(0.0, 0.12), at - 0.5 * beat, 0.7 * beat)
    score.pose(at - 0.5 * beat, 0.8 * beat, tilt=sign * v(0.02, 0.10), flex=0.05 + v(0.0, 0.12))
    score.move("nod", v(0.05, 0.25) * (1 if k % 2 else -0.3), at - 0.4 * beat, 0.6 * beat)


def _put(score: Score, side: str, at: float, beat: float, outward: float, forward: float, height: float = 0.05) -> None:
    """A foot lands on the beat."""
    place = score.local(SIGN[side] * (0.75 * score.subject.step_width + outward), forward - 0.035)
    yaw = score.value["heading"] + SIGN[side] * score.subject.toe_out
    swing = min(0.34, 0.62 * beat)
    score.step(side, place, yaw, at - swing, at, height=height, heel=0.45, early=0.18)


def _step_touch(score: Score, beat: float) -> None:
    """Step to one side, bring the other foot, and back again."""
    side, wide = score.choose(SIDES), score.uniform(0.22, 0.36)
    for k, foot in enumerate((side, OTHER[side], OTHER[side], side)):
        at = score.now + k * beat
        if k in (0, 2):
            x, y = score.local(SIGN[foot] * wide, 0.0)
            _put(score, foot, at, beat, outward=wide, forward=0.0)
            score.pose(at - 0.55 * beat, 1.1 * beat, x=x, y=y)
        else:
            _put(score, foot, at, beat, outward=0.0, forward=score.uniform(-0.06, 0.06))


def _bounce(score: Score, beat: float) -> None:
    """Both feet stay; the weight goes from one to the other."""
    for k in range(4):
        score.move("sway", (1 if k % 2 else -1) * score.uniform(0.03, 0.06), score.now + (k - 0.5) * beat, beat)
    score.move("sway", 0.0, score.now + 3.4 * beat, 0.8 * beat)


def _march(score: Score, beat: float) -> None:
    """Step on the spot with high knees."""
    first = score.choose(SIDES)
    for k, side in enumerate(2 * (first, OTHER[first])):
        at = score.now + k * beat
        score.move("sway", -SIGN[side] * 0.045, at - 0.85 * beat, 0.6 * beat)
        _put(score, side, at, beat, outward=0.0, forward=0.0, height=score.uniform(0.12, 0.24))
    score.move("sway", 0.0, score.now + 3.2 * beat, 0.7 * beat)


def _rock(score: Score, beat: float) -> None:
    """Rock forward onto one foot and back, twice."""
    side, far = score.choose(SIDES), score.uniform(0.14, 0.24)
    for k in range(4):
        at, ahead = score.now + k * beat, far * (1 - k % 2)
        score.move("surge", 0.6 * ahead, at - 0.6 * beat, 0.8 * beat)
        _put(score, side, at, beat, outward=0.0, forward=ahead)


def _vine(score: Score, beat: float) -> None:
    """Travel to one side: apart, together, apart, together."""
    side, wide = score.choose(SIDES), score.uniform(0.22, 0.32)
    for k in range(4):
        at = score.now + k * beat
        if k % 2:
            _put(score, OTHER[side], at, beat, outward=0.0, forward=0.0)
            continue
        x, y = score.local(SIGN[side] * wide, 0.0)
        _put(score, side, at, beat, outward=wide, forward=0.0)
        score.pose(at - 0.55 * beat, 1.1 * beat, x=x, y=y)


def _turning(score: Score, beat: float) -> None:
    """A quarter to a half turn in four small steps."""
    angle = score.choose((-1, 1)) * score.uniform(1.2, 3.0)
    for k, side in enumerate(2 * SIDES if angle > 0 else 2 * SIDES[::-1]):
        at = score.now + k * beat
        score.nudge("heading", angle / 4, at - 0.9 * beat, 1.3 * beat)
        _put(score, side, at, beat, outward=0.02, forward=0.0)


def _home(score: Score, beat: float) -> None:
    """Feet under the body, arms down."""
    for k, side in enumerate(SIDES):
        score.move("sway", -SIGN[side] * 0.03, score.now + k * beat - 0.5, 0.45)
        _put(score, side, score.now + (k + 0.4) * beat, beat, outward=0.0, forward=0.0)
    ease(score, score.now + beat, 0.8)
    score.now += beat + 0.85
