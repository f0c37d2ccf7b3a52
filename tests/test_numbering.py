"""What numbers of files mean: frames, every n-th frame, or times; and which of them no rule may touch."""

import json
from itertools import pairwise

import detected
import pytest

from motionlab.io import keypoints
from motionlab.io.video import frames_of


@pytest.mark.parametrize(
    "numbers",
    [[0], [5, 6, 7], [1, 2, 9], [0, 2, 4, 6], [3, 17, 40, 52, 53], [0, 40, 80, 120], [0, 4, 8, 12], [7, 1007]],
)
def test_frames_stay_frames(numbers):
    order, rate, notes = frames_of(numbers, fps=30.0)
    assert order == numbers and rate is None
    steps = {b - a for a, b in pairwise(numbers)}
    assert bool(notes) == (len(numbers) > 2 and len(steps) == 1 and steps != {1})  # one in n is said


@pytest.mark.parametrize("start", [0, 1_700_000_000_000])
@pytest.mark.parametrize("rate", [24.0, 25.0, 29.97, 30.0, 50.0, 59.94, 60.0, 100.0])
@pytest.mark.parametrize("cut", [int, round])
def test_milliseconds_are_times(start, rate, cut):
    kept = [n for n in range(80) if n not in (30, 31, 50)]  # in three of them nobody was seen
    order, found, notes = frames_of([start + cut(1000 * n / rate) for n in kept], fps=rate)
    assert order == kept and found == pytest.approx(rate, rel=0.01) and "ms" in notes[0] and "asked" not in notes[0]


@pytest.mark.parametrize(("unit", "word"), [(1e6, "us"), (1e9, "ns")])
def test_moments_since_1970_are_times(unit, word):
    order, found, notes = frames_of([int(1.7e9 * unit + unit * n / 30) for n in range(20)])
    assert order == [*range(20)] and found == pytest.approx(30, rel=1e-3) and f"times in {word}" in notes[0]


def test_steps_cut_to_whole_milliseconds_are_of_a_rate_that_cameras_have():
    start = 1_700_000_000_000
    assert frames_of([start + 33 * n for n in range(61)])[1] == 30
    assert frames_of([start + 37 * n for n in range(61)])[1] == pytest.approx(1000 / 37)  # control: no such rate
    assert "though 60 a second were asked for" in frames_of([start + 33 * n for n in range(61)], fps=60.0)[2][0]


def test_steps_of_one_size_are_times_only_at_the_rate_that_was_said():
    numbers = [40 * n for n in range(9)]
    assert frames_of(numbers, fps=25.0)[0] == [*range(9)] and frames_of(numbers, fps=30.0)[0] == numbers


def test_a_film_says_what_its_numbers_are():
    far = [0, 15, 30, 45, 60]
    assert frames_of(far, film=61, loose=True)[0] == far
    assert frames_of([*far, 900], film=61, loose=True)[0] == [*range(6)]  # control: they are no frames of it
    assert frames_of([10, 30, 50], film=[10, 20, 30, 40, 50])[0] == [0, 2, 4]
    assert frames_of([0, 1, 2], film=[10, 20, 30])[0] == [0, 1, 2]


def test_files_named_by_milliseconds_are_read_at_their_rate(tmp_path):
    for n, people in enumerate(detected.points(25, people=1, frames=31)):
        if n != 7:
            text = json.dumps({"people": [{"pose_keypoints_2d": people[0].ravel().tolist()}]})
            (tmp_path / f"{1_700_000_000_000 + 1000 * n // 30}.json").write_text(text)
    found = keypoints.load(tmp_path)
    assert found.frames == 31 and found.fps == pytest.approx(30, rel=2e-3) and "times in ms" in found.notes[0]
    assert found.person().visible.any(-1).tolist() == [n != 7 for n in range(31)]
