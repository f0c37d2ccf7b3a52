"""What the numbers of files, images and frames mean: frames in a row, every n-th frame of a film, or times."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from motionlab.io.reading import RATES

#: Where fewer of the numbers between the first and the last image are there than this share, they are no film's.
_SPARSE = 0.1
#: No film has so many frames; a number from here on is a moment since 1970, in ms, us or ns.
_MOMENT = 10**11
#: Numbers that are times: how many a second there are, and may be.
_UNITS, _RATES = {"ms": 1e3, "us": 1e6, "ns": 1e9}, (4.0, 1000.0)
_LEAST = 8  # step from which numbers may be times: fewer are frames
_NEAR = 0.03  # share by which a rate may be off and still be the same


def frames_of(
    numbers: Sequence[int], *, fps: float | None = None, film: int | Sequence[int] | None = None, loose: bool = False
) -> tuple[list[int], float | None, list[str]]:
    """Returns the frame of every number (distinct, rising), frames per second where the numbers are times, and notes.

    Numbers are frames, unless they are times, or too far apart to be a film's.

    Args:
        fps: frames per second that somebody said.
        film: frames of the film, where it is known, or the numbers of its images.
        loose: they may be those of any pictures.
    """
    first, last, steps = numbers[0], numbers[-1], np.diff(np.array(numbers, np.int64))
    if not isinstance(film, int | None):
        places = {number: n for n, number in enumerate(film)}
        if places.keys() >= {*numbers}:
            return [places[number] for number in numbers], None, []
        film = len(places)
    if len(steps) == 0 or (film is not None and last <= film):
        return [*numbers], None, []
    step = float(np.median(steps))
    counts = np.maximum(np.round(steps / step), 1)
    exact = (last - first) / counts.sum()
    rates = {name: unit / exact for name, unit in _UNITS.items()}
    unit = next((name for name, rate in rates.items() if _RATES[0] <= rate <= _RATES[1]), None)
    if unit is not None and len(steps) > 1 and _are_times(first, steps, step, counts, rates[unit], fps):
        rate = rates[unit]
        if unit == "ms" and (steps == steps[0]).all():  # cut to whole ones
            rate = next((float(each) for each in RATES if 1e3 / (step + 1) < each <= rate), rate)
        told = "" if fps is None or abs(fps / rate - 1) < _NEAR else f", though {fps:g} a second were asked for"
        note = f"numbers from {first} to {last} in steps of {exact:.4g} are times in {unit}: {rate:.4g} a second{told}"
        return [0, *counts.cumsum().astype(int).tolist()], rate, [note]
    if loose and len(numbers) < _SPARSE * (last - first + 1):
        note = f"{len(numbers)} images numbered from {first} to {last}: taken as pictures in a row, not as a film"
        return [*range(len(numbers))], None, [note]
    n = math.gcd(*steps.tolist())
    note = f"one frame in {n} from {first} to {last} is there: those between them show nobody"
    return [*numbers], None, [note] if n > 1 and len(steps) > 1 else []


def _are_times(first: int, steps: np.ndarray, step: float, counts: np.ndarray, rate: float, fps: float | None) -> bool:
    if first >= _MOMENT:
        return True
    if step < _LEAST:
        return False
    if (steps % steps[0] == 0).all():  # every n-th frame has such steps, too
        return fps is not None and abs(rate / fps - 1) < _NEAR
    near = np.abs(steps - counts * step) <= (1 if step < 20 else max(1.5, 0.06 * step))
    return bool(near.mean() >= 0.9)
