"""What 2-D pose detectors write as tables: YOLO-pose's lines, CSV of several kinds, TRC in pixels, npz of our own."""

from __future__ import annotations

import math
import re

import numpy as np

from motionlab.io import detections
from motionlab.io.detections import PLAIN, Detections, Sighting, first_of, pixels, point_names, whole_number
from motionlab.io.layouts import MEDIAPIPE_33, standard_name
from motionlab.io.points import trc_table
from motionlab.io.reading import Location, checked_array, frame_rate, read_npz

_KEYPOINT = ("keypoint", "keypoint_name", "keypoint_id", "joint", "landmark", "point", "name")
_TIME = ("time", "timestamp", "time_ms", "timestamp_ms", "time_s")
#: Columns of a point by their name, and their place in it; presence says less than visibility, z nothing.
_AXES = {"x": 0, "y": 1, **dict.fromkeys(detections.SCORES, 2), "z": 3, "presence": 4}
_AXIS = "|".join(_AXES)
#: Points and numbers a point that the lines of YOLO-pose may hold: COCO, Halpe, whole body.
_YOLO = ((17, 3), (26, 3), (133, 3), (17, 2), (26, 2), (133, 2))
_METRES = 10.0  # half of the coordinates of people in an image are larger
_MOST_WORDS = 5 + 133 * 3 + 2  # beside the points class, box, confidence, id


def from_lines(at: Location, text: str) -> Detections:
    """Reads a table: one image's lines of numbers as YOLO-pose writes them, or CSV with a header."""
    lines = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
    if not lines:
        raise at.error("the file is blank")
    if re.fullmatch(r"[-+.\deE\s]+", lines[0][1]):
        return _yolo(at, lines)
    mark = max(",;\t", key=lines[0][1].count)
    return _csv(at, [(n, [cell.strip().strip('"') for cell in line.split(mark)]) for n, line in lines])


def _yolo(at: Location, lines: list[tuple[int, str]]) -> Detections:
    """Each line: class, box, points; then the box's confidence, where asked for, and the track's id, where tracked."""

    def read(text: str) -> Sighting:
        words = text.split(None, _MOST_WORDS)
        values = pixels(at, [_cell(at, word) for word in words[:_MOST_WORDS]], "N")
        choices = [values[5 : 5 + k * d].reshape(k, d) for k, d in _YOLO if 0 <= len(words) - 5 - k * d <= 2]
        points = next((points for points in choices if _in_box(points, values[1:5])), None)
        if points is None:
            message = f"{len(words)} words are no class, box and keypoints of a person in it"
            raise at.error(message, remedy="save the labels of a pose model (save_txt)")
        more = words[5 + points.size :]
        tracked = len(more) == 2 or bool(more and whole_number(more[0]))  # one number: a confidence, or an id from 1
        scores = points[:, 2] if points.shape[1] == 3 else None
        return detections.with_scores(at, points[:, :2], scores), whole_number(more[-1]) if tracked else None

    people = dict.fromkeys(text for _, text in lines)  # a second run writes the lines again
    return detections.collect(at, "Ultralytics", [(0, people)], read)


def _cell(at: Location, cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        raise at.error(f"{cell[:40]!r} is not a number") from None


def _in_box(points: np.ndarray, box: np.ndarray) -> bool:
    """Whether most points (K, 2 or more) that are not at zero lie in a box (centre and sides) grown by a half."""
    there = (points[:, :2] != 0).any(-1)
    inside = (np.abs(points[:, :2] - box[:2]) <= 0.75 * box[2:]).all(-1)
    return 2 * (inside & there).sum() >= there.sum()


def _csv(at: Location, rows: list[tuple[int, list[str]]]) -> Detections:
    """A line per point (frame, keypoint, x, y), or a line per person and frame (nose_x, nose_y, ...)."""
    title = rows.pop(0)[1]
    if title[0].lower() == "scorer":  # DeepLabCut: a row each for points and coordinates, one for people if several
        heads = {row[0].lower(): row[1:] for _, row in rows[:3]}
        title = ["frame", *map("_".join, zip(heads["bodyparts"], heads["coords"], strict=True))]
        rows = rows[2 + ("individuals" in heads) :]
    head = [cell.lower() for cell in title]
    columns = {name: k for k, name in reversed([*enumerate(head)])}
    frame_at, id_at, person_at, name_at, time_at = (
        first_of(columns, words) for words in (detections.FRAME, detections.ID, ("person",), _KEYPOINT, _TIME)
    )
    at.place = "line 1"
    long = name_at is not None and {"x", "y"} <= columns.keys()
    one = [columns.get("x"), columns.get("y"), first_of(columns, detections.SCORES)]
    points = [("", one)] if long else _wide_points(at, title)
    if long and frame_at is None:
        raise at.error("expected a column frame beside keypoint, x and y")
    for line, row in rows:
        if len(row) != len(head):
            raise at.error(f"expected {len(head)} cells, got {len(row)}", place=f"line {line}")
    order, fps = _clock(at, head, rows, frame_at, time_at)
    people: dict[tuple, tuple[int | None, dict]] = {}
    for frame, (line, row) in zip(order, rows, strict=True):
        at.place = f"line {line}"
        who = tuple(row[k] for k in (id_at, person_at) if k is not None) if long else line
        name, body = people.setdefault((frame, who), (None if id_at is None else whole_number(row[id_at]), {}))
        for key, places in points:
            body[row[name_at] if long else key] = tuple(
                _cell(at, row[k]) if k is not None and row[k] else None for k in places
            )
    seen: dict[int, list] = {}
    for (frame, _), (name, body) in people.items():
        seen.setdefault(frame, []).append((body, name))
    return detections.collect_named(at, "CSV table", [*seen.items()], fps=fps)


def _wide_points(at: Location, title: list[str]) -> list[tuple[str, list[int | None]]]:
    """Name and columns (x, y, confidence) of every point of a header such as X_NOSE, Y_NOSE or nose_x, nose_y."""
    found: list[tuple[str, list]] = []
    latest: dict[str, list] = {}
    for k, cell in enumerate(title):
        first = re.fullmatch(rf"({_AXIS})[_. ]?(\d+)|({_AXIS})[_. ](.+)", cell, re.IGNORECASE)
        last = re.fullmatch(rf"(.+)[_. ]({_AXIS})", cell, re.IGNORECASE)
        if first or last:
            axis, name = (first[1] or first[3], first[2] or first[4]) if first else (last[2], last[1])
            place = _AXES[axis.lower()]
            if name not in latest or latest[name][place] is not None:
                latest[name] = [None] * 5
                found.append((name, latest[name]))
            latest[name][place] = k
    points = [(name, places[:3]) for name, places in found if None not in places[:2]]
    if not points:
        raise detections.unknown(at)
    if len(points) == len(MEDIAPIPE_33) and {standard_name(name) for name, _ in points} <= set(MEDIAPIPE_33):
        points = [(name, places) for name, (_, places) in zip(MEDIAPIPE_33, points, strict=True)]  # one is misnamed
    elif all(name.isdecimal() for name, _ in points):
        points = [(str(n), places) for n, (_, places) in enumerate(points)]  # some count from 1
    if len({name for name, _ in points}) < len(points):
        raise at.error("two keypoints have one name")
    return points


def _clock(
    at: Location, head: list[str], rows: list[tuple[int, list[str]]], frame_at: int | None, time_at: int | None
) -> tuple[list[int], float | None]:
    """The frame number of every row, by its own or by its time; and the frame rate by the times, s or ms."""
    order: list[int] = []
    for n, (line, row) in enumerate(rows):
        number = n if frame_at is None else whole_number(row[frame_at])
        if number is None:
            raise at.error(f"{row[frame_at][:40]!r} is no frame number", place=f"line {line}")
        order.append(number)
    if time_at is None:
        return order, None
    at.place = head[time_at]
    times = checked_array(at, [_cell(at, row[time_at]) for _, row in rows], "T", largest=1e15)
    moments, where = np.unique(times, return_inverse=True)
    step = float(np.median(np.diff(moments))) if len(moments) > 1 else 0.0
    if step == 0:
        return order, None
    if frame_at is None:
        at_frame = np.round((moments - moments[0]) / step)
        rising = at_frame[-1] < detections.MOST_FRAMES and (np.diff(at_frame) > 0).all()
        order = (at_frame if rising else np.arange(len(moments))).astype(int)[where].tolist()
    return order, frame_rate(at, (1000 if step >= 1 else 1) / step)  # nobody films at a frame per second


def from_trc(at: Location, text: str) -> Detections:
    """Reads one person's points in pixels from a TRC, as Sports2D writes it: x, y and a z of 0; blank is not seen."""
    head, names, rows = trc_table(at, text)
    at.place = "line 3"
    fps = frame_rate(at, _cell(at, head["DataRate"]))
    points, order = pixels(at, rows[:, 2:], "T N"), [whole_number(number) for number in rows[:, 0].tolist()]
    points = points.reshape(len(rows), -1, 3)
    if None in order or len(rows) < float(head["NumFrames"]):
        raise at.error(f"{len(rows)} frames, by number, of {head['NumFrames']}", place="frames")
    known = np.abs(points[np.isfinite(points).all(-1) & (points[..., :2] != 0).any(-1)])
    if (known[:, 2] > 0).any() or (len(known) and np.median(known[:, :2]) < _METRES):
        remedy = "give the file in pixels (Sports2D: ..._px_person00.trc)"
        raise at.error("3-D points, or metres, where a fit needs pixels", place="coordinates", remedy=remedy)
    points[..., 2] = math.nan  # no confidences
    frames = ((number, [(here, None)]) for number, here in zip(order, points, strict=True))
    return detections.collect(at, "Sports2D", frames, tuple, names=point_names(at, [*names]), fps=fps, notes=at.notes)


def from_npz(at: Location) -> Detections:
    """Reads the plain layout that ``keypoints`` describes; an array that is pickled is never opened."""
    keys = ("keypoints", "positions_2d", "confidence", "scores", "names", "fps", "size", "ids")  # the second is pickled
    arrays = read_npz(at, keys)
    if "keypoints" not in arrays:
        remedy = f"unpack it, if it is a folder's archive, and name the folder; else {PLAIN}"
        raise at.error("the key keypoints is missing", place="keys", remedy=remedy)
    array = arrays["keypoints"]
    points = pixels(at, array, "T P K D" if array.ndim == 4 else "T K D", "keypoints")
    points = points if array.ndim == 4 else points[:, None]
    *lead, axes = points.shape
    if axes not in (2, 3):
        raise at.error(f"expected x, y and confidence, got {axes} numbers a point", place="keypoints")
    scores = points[..., 2] if axes == 3 else np.full(lead, np.nan)
    if key := next((key for key in ("confidence", "scores") if key in arrays), None):
        shape = " ".join(str(n) for n in array.shape[:-1])
        scores = pixels(at, arrays[key], shape, key).reshape(lead)
    points = np.concatenate([points[..., :2], scores[..., None]], -1)
    ids: list[int | None] = [None] * lead[1]
    if "ids" in arrays:
        ids = [whole_number(number) for number in checked_array(at, arrays["ids"], str(lead[1]), "ids").tolist()]
    names = point_names(at, [str(name) for name in arrays.get("names", np.zeros(0)).ravel()[: lead[2] + 1]])
    frames = enumerate(zip(people, ids, strict=True) for people in points)
    return detections.collect(at, "plain npz", frames, tuple, names=names, **detections.stated(at, arrays))
