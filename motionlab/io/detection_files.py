"""What 2-D pose detectors write, one small reader a format: JSON of many kinds, YOLO-pose's lines, CSV, TRC in pixels,
npz of our own."""

import math
import re
from collections.abc import Iterable, Iterator
from functools import partial

import numpy as np

from motionlab.io import detections
from motionlab.io.detections import MEDIAPIPE_33, Detections, first_of, pixels, point_names, stated, whole_number
from motionlab.io.points import trc_table
from motionlab.io.reading import Location, checked_array, frame_rate, read_npz

_KEYPOINT = ("keypoint", "keypoint_name", "keypoint_id", "joint", "landmark", "point", "name")
_TIME = ("time", "timestamp", "time_ms", "timestamp_ms", "time_s")
#: Columns of a point by their name, and their place in it; presence says less than visibility, z nothing.
_AXES = {"x": 0, "y": 1, **dict.fromkeys(detections.SCORES, 2), "z": 3, "presence": 4}
_AXIS = f"({'|'.join(_AXES)})"
_COLUMN = re.compile(rf"{_AXIS}[_. ]?(\d+)|{_AXIS}[_. ](.+)|(.+)[_. ]{_AXIS}", re.IGNORECASE)
#: Points and numbers a point that the lines of YOLO-pose may hold: COCO, Halpe, whole body.
_YOLO = ((17, 3), (26, 3), (133, 3), (17, 2), (26, 2), (133, 2))
_METRES = 10.0  # half of the coordinates of people in an image are larger
_MOST_WORDS = 5 + 133 * 3 + 2  # beside the points class, box, confidence, id
_IMAGE = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark", "keypoints", "people", "persons", "poses")
_WORLD = ("pose_world_landmarks", "poseWorldLandmarks", "world_landmarks", "worldLandmarks", "keypoints3D")
#: Keys of a person's points: OpenPose's (version 1.0 writes no _2d), AlphaPose's, everybody else's.
_POINTS = ("pose_keypoints_2d", "pose_keypoints", "joints", "keypoints")
#: Detectors that leave no point out draw those from this score on; AlphaPose from here or from 0.4 on, by the model.
_MMPOSE, _VITPOSE, _ALPHAPOSE = 0.3, 0.5, 0.05


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

    def read(text: str) -> detections.Sighting:
        words = text.split(None, _MOST_WORDS)
        values = pixels(at, [float(word) for word in words[:_MOST_WORDS]], "N")
        choices = [values[5 : 5 + k * d].reshape(k, d) for k, d in _YOLO if 0 <= len(words) - 5 - k * d <= 2]
        points = next((points for points in choices if _in_box(points, values[1:5])), None)
        if points is None:
            raise at.error("no box and keypoints of a person in it", remedy="save a pose model's labels (save_txt)")
        more = words[5 + points.size :]
        tracked = len(more) == 2 or bool(more and whole_number(more[0]))  # one number: a confidence, or an id from 1
        scores = points[:, 2] if points.shape[1] == 3 else None
        return detections.with_scores(at, points[:, :2], scores), whole_number(more[-1]) if tracked else None

    people = dict.fromkeys(text for _, text in lines)  # a second run writes the lines again
    return detections.collect(at, "Ultralytics", [(0, people)], read)


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
    wanted = (detections.FRAME, detections.ID, ("person",), _KEYPOINT, _TIME)
    frame_at, id_at, person_at, name_at, time_at = (first_of(columns, words) for words in wanted)
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
    seen: dict[int, dict[object, tuple[dict, int | None]]] = {}
    for frame, (line, row) in zip(order, rows, strict=True):
        at.place = f"line {line}"
        if frame is None:
            raise at.error(f"{row[frame_at][:40]!r} is no frame number")
        who = tuple(row[k] for k in (id_at, person_at) if k is not None) if long else line
        new = {}, None if id_at is None else whole_number(row[id_at])
        body, _ = seen.setdefault(frame, {}).setdefault(who, new)
        for key, places in points:
            cells = (row[k] if k is not None else "" for k in places)
            body[row[name_at] if long else key] = tuple(float(cell) if cell else None for cell in cells)
    frames = [(frame, [*people.values()]) for frame, people in seen.items()]
    return detections.collect_named(at, "CSV table", frames, fps=fps)


def _wide_points(at: Location, title: list[str]) -> list[tuple[str, list[int | None]]]:
    """Name and columns (x, y, confidence) of every point of a header such as X_NOSE, Y_NOSE or nose_x, nose_y."""
    found, latest = [], {}
    for k, cell in enumerate(title):
        if one := _COLUMN.fullmatch(cell):
            place, name = _AXES[(one[1] or one[3] or one[6]).lower()], one[2] or one[4] or one[5]
            if name not in latest or latest[name][place] is not None:
                latest[name] = [None] * 5
                found.append((name, latest[name]))
            latest[name][place] = k
    points = [(name, places[:3]) for name, places in found if None not in places[:2]]
    if not points:
        raise detections.unknown(at)
    known = {detections.standard_name(name) for name, _ in points} <= {*MEDIAPIPE_33}
    if known and len(points) == len(MEDIAPIPE_33):
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
    order = [n if frame_at is None else whole_number(row[frame_at]) for n, (_, row) in enumerate(rows)]
    if time_at is None:
        return order, None
    at.place = head[time_at]
    times = checked_array(at, [float(row[time_at]) for _, row in rows], "T", largest=1e15)
    moments, where = np.unique(times, return_inverse=True)
    step = float(np.median(np.diff(moments))) if len(moments) > 1 else 0.0
    if step == 0:
        return order, None
    if frame_at is None:
        at_frame = np.round((moments - moments[0]) / step)
        rising = at_frame[-1] < detections.MOST_FRAMES and (np.diff(at_frame) > 0).all()
        order = (at_frame.astype(int) if rising else np.arange(len(moments)))[where].tolist()
    return order, frame_rate(at, (1000 if step >= 1 else 1) / step)  # nobody films at a frame per second


def from_trc(at: Location, text: str) -> Detections:
    """Reads one person's points in pixels from a TRC, as Sports2D writes it: x, y and a z of 0; blank is not seen."""
    head, names, rows = trc_table(at, text)
    at.place = "line 3"
    fps = frame_rate(at, float(head["DataRate"]))
    points, order = pixels(at, rows[:, 2:], "T N"), [whole_number(number) for number in rows[:, 0].tolist()]
    points = points.reshape(len(rows), -1, 3)
    if None in order or len(rows) < float(head["NumFrames"]):
        raise at.error(f"{len(rows)} frames, by number, of {head['NumFrames']}", place="frames")
    known = np.abs(points[np.isfinite(points).all(-1) & (points[..., :2] != 0).any(-1)])
    if (known[:, 2] > 0).any() or (len(known) and np.median(known[:, :2]) < _METRES):
        remedy = "give the file in pixels (Sports2D: ..._px_person00.trc)"
        raise at.error("3-D points, or metres", place="coordinates", remedy=remedy)
    points[..., 2] = math.nan  # no confidences
    frames = ((number, [(here, None)]) for number, here in zip(order, points, strict=True))
    return detections.collect(at, "Sports2D", frames, tuple, names=point_names(at, [*names]), fps=fps, notes=at.notes)


def from_npz(at: Location) -> Detections:
    """Reads the plain layout that ``keypoints`` describes; one that is pickled, as positions_2d, is never opened."""
    arrays = read_npz(at, ("keypoints", "positions_2d", "confidence", "scores", "names", "fps", "size", "ids"))
    if "keypoints" not in arrays:
        remedy = f"unpack it, if it is a folder's archive, and name the folder; else {detections.PLAIN}"
        raise at.error("the key keypoints is missing", place="keys", remedy=remedy)
    array = arrays["keypoints"]
    points = pixels(at, array[:, None] if array.ndim == 3 else array, "T P K D", "keypoints")
    *lead, axes = points.shape
    if axes not in (2, 3):
        raise at.error(f"expected x, y and confidence, got {axes} numbers a point", place="keypoints")
    scores = points[..., 2] if axes == 3 else np.full(lead, np.nan)
    if key := next((key for key in ("confidence", "scores") if key in arrays), None):
        scores = pixels(at, arrays[key], " ".join(map(str, array.shape[:-1])), key).reshape(lead)
    points = np.concatenate([points[..., :2], scores[..., None]], -1)
    ids = checked_array(at, arrays["ids"], str(lead[1]), "ids") if "ids" in arrays else np.full(lead[1], -1)
    ids = [whole_number(number) for number in ids.tolist()]
    names = point_names(at, [str(name) for name in arrays.get("names", np.zeros(0)).ravel()[: lead[2] + 1]])
    frames = enumerate(zip(people, ids, strict=True) for people in points)
    return detections.collect(at, "plain npz", frames, tuple, names=names, **stated(at, arrays))


def from_json(at: Location, document: object) -> Detections:
    """Converts a document, told by its keys or by those of the first thing in it; [] is a frame that shows nobody.
    3-D poses are refused."""
    if document == []:
        return detections.NOBODY
    item = document
    while isinstance(item, list):
        item = next((value for value in item if value), None)
    keys = item.keys() if isinstance(item, dict) else set()
    inner = item.get("keypoints") if keys else None
    if "people" in keys:
        return _openpose(at, document)
    if keys & {"instance_info", "instances", "keypoint_scores"}:
        return _mmpose(at, document)
    if {"images", "annotations"} <= keys and item is document:  # COCO's own, as CVAT and others write it
        called, marked = {image["id"]: image.get("file_name", image["id"]) for image in document["images"]}, {}
        for entry in document["annotations"]:
            marked.setdefault(called[entry["image_id"]], []).extend([entry] * ("keypoints" in entry))
        found = _of_images(at, {name: marked.get(name, []) for name in called.values()}, alphapose=False)
        points = next((kind["keypoints"] for kind in document.get("categories", []) if "keypoints" in kind), None)
        found.names, found.size = point_names(at, points), stated(at, document["images"][0])["size"]
        return found
    if {"image_id", "keypoints"} <= keys and item is not document:
        images: dict[object, list] = {}
        for entry in document:
            images.setdefault(entry["image_id"], []).append(entry)
        return _of_images(at, images, alphapose=any(isinstance(image, str) for image in images))
    if {"skeleton", "keypoints"} <= keys and item is document:
        return _vitpose(at, document)
    if isinstance(inner, dict) and isinstance(inner.get("x"), list) and item is not document:  # Ultralytics' tojson()
        frames = [document] if any(isinstance(entry, dict) for entry in document) else document
        people = ([one for one in frame if isinstance(one.get("keypoints"), dict)] for frame in frames)
        return detections.collect(at, "Ultralytics", enumerate(people), partial(_person, at))
    if keys and all(isinstance(value, dict) and value.keys() & {"bodies", "people"} for value in item.values()):
        images = {image: first_of(frame, ("bodies", "people")) for image, frame in item.items()}
        return _of_images(at, images, alphapose=True)  # its formats cmu and open
    return _landmarks(at, document)


def _person(at: Location, one: object, *, needed: bool = False) -> detections.Sighting:
    """A flat list x, y, confidence, x, ...; or rows of coordinates, or x and y apart, with the scores beside them.

    No points, or an empty list, is somebody who was not found. needed: the key of the points has to be there.
    """
    if not isinstance(one, dict) or (needed and not {*_POINTS} & one.keys()):
        raise at.error(f'expected an object with "{_POINTS[-1 if needed else 0]}" of every person')
    key = next((key for key in _POINTS if key in one), _POINTS[0])
    values, points = one.get(key), np.zeros((0, 3))
    if isinstance(values, dict):  # Ultralytics
        xy = pixels(at, [values.get("x"), values.get("y")], "2 K").T
        points = detections.with_scores(at, xy, first_of(values, detections.SCORES))
    elif isinstance(values, list) and values and isinstance(values[0], list):  # MMPose
        xy = pixels(at, values, "K D")
        if xy.shape[1] != 2:
            raise at.error(f"{xy.shape[1]} coordinates a point: 3-D", remedy="give the 2-D detector's file")
        points = detections.with_scores(at, xy, one.get("keypoint_scores"))
    elif values is not None or key == "keypoints":
        if not isinstance(values, list) or len(values) % 3:
            raise at.error(f'"{key}": expected x, y, confidence of every keypoint')
        points = pixels(at, values, str(len(values))).reshape(-1, 3)
    return points, whole_number(first_of(one, ("idx", "track_id", "person_id")))


def _openpose(at: Location, document: object) -> Detections:
    """What OpenPose writes of one frame, or a list of such frames."""
    frames = document if isinstance(document, list) else [document]
    for n, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("people"), list):
            raise at.error('expected an object with a list "people"', place=f'frame {n}, "people"')
    people = enumerate(frame["people"] for frame in frames)
    found = detections.collect(at, "OpenPose", people, partial(_person, at), **stated(at, frames[0]))
    if any(len(points) in (26, 133) for people in found.frames.values() for points, _ in people):
        found.detector, found.lowest = "RTMPose as OpenPose", _MMPOSE  # Pose2Sim's
    return found


def _mmpose(at: Location, document: dict | list) -> Detections:
    meta = document.get("meta_info") or {} if isinstance(document, dict) else {}
    frames = document["instance_info"] if "instance_info" in document else document
    frames = [frames] if isinstance(frames, dict) else frames
    if not any("instances" in frame for frame in frames):
        frames = [{"instances": frames}]  # one image
    people = ((whole_number(frame.get("frame_id", n)), frame["instances"]) for n, frame in enumerate(frames))
    names = point_names(at, meta.get("keypoint_id2name"))
    return detections.collect(at, "MMPose", people, partial(_person, at, needed=True), names=names, lowest=_MMPOSE)


def _of_images(at: Location, images: dict[object, Iterable], *, alphapose: bool) -> Detections:
    """AlphaPose and COCO results: people by image, whose order is the number at the end of its name, or the file's."""
    number = re.compile(r"(\d{1,19})(?:_keypoints)?(?:\.\w{1,5})?$")
    tails = {image: number.search(image) if isinstance(image, str) else None for image in images}
    order = {image: int(tail[1]) if tail else whole_number(image) for image, tail in tails.items()}
    more: dict[str, object] = {"loose": True}
    if None in order.values():
        order = {image: n for n, image in enumerate(images)}
        more = {"notes": ["images have no numbers: taken in the file's order"]}
    if len({*order.values()}) < len(order):
        raise at.error("two images have the same number", place="image_id", remedy="one file per camera")
    people = ((order[image], people) for image, people in images.items())
    detector, lowest = ("AlphaPose", _ALPHAPOSE) if alphapose else ("COCO results", 0.0)
    return detections.collect(at, detector, people, partial(_person, at, needed=not alphapose), lowest=lowest, **more)


def _vitpose(at: Location, document: dict) -> Detections:
    """easy_ViTPose: frames of people by id, or in a list; each point is y, x, score."""

    def read(one: tuple[object, object]) -> detections.Sighting:
        return pixels(at, one[1], "K 3")[:, [1, 0, 2]], whole_number(one[0])

    frames = document["keypoints"]
    people = (frame.items() if isinstance(frame, dict) else [(None, one) for one in frame] for frame in frames)
    names = point_names(at, document["skeleton"])
    return detections.collect(at, "ViTPose", enumerate(people), read, names=names, lowest=_VITPOSE)


def _landmarks(at: Location, document: object) -> Detections:
    """MediaPipe, MoveNet and others who write points by name, or BlazePose's 33 in a row, frame by frame."""
    frames = document.get("frames", [document]) if isinstance(document, dict) else document
    frames = frames if isinstance(frames, list) and not _is_body(frames) else [frames]
    given = [whole_number(first_of(frame, detections.FRAME)) if isinstance(frame, dict) else None for frame in frames]
    seen = []
    for number, frame in zip(range(len(frames)) if None in given else given, frames, strict=True):
        at.place = f"frame {number}"
        seen.append((number, [*_bodies(at, frame)]))
    found = detections.collect_named(at, "named points", seen, **stated(at, document, *frames[:1]))
    found.detector = "MoveNet" if found.names == detections.COCO_17 else found.detector
    return found


def _is_body(value: object) -> bool:
    """Whether a list is one person's points, not people or frames."""
    one = value[0] if isinstance(value, list) and value else None
    if isinstance(one, dict):
        return not isinstance(one.get("x", []), dict | list)
    return isinstance(one, list) and len(one) in (2, 3, 4) and all(isinstance(x, int | float) for x in one)


def _bodies(at: Location, value: object, name: int | None = None) -> Iterator[tuple[dict[str, tuple], int | None]]:
    """Everybody's points in what stands for a frame or for people, with their ids."""
    table = isinstance(value, dict)
    if table and (inner := first_of(value, _IMAGE)) is not None:
        mine = whole_number(first_of(value, detections.ID))
        yield from _bodies(at, inner, name if mine is None else mine)
    elif table and first_of(value, _WORLD) is not None:
        raise at.error("world landmarks alone: 3-D, in metres", remedy="save the image landmarks (pose_landmarks)")
    elif value and (table or _is_body(value)):
        yield _by_name(at, value), name
    elif isinstance(value, list | dict | None):
        for one in value or []:
            yield from _bodies(at, one, name)
    else:
        raise detections.unknown(at)


def _by_name(at: Location, body: dict | list) -> dict[str, tuple]:
    """(x, y, confidence) by name or number of one person; None where it is not said."""
    named = isinstance(body, dict)
    points = {}
    for name, point in body.items() if named else enumerate(body):
        if isinstance(point, dict) and {"x", "y"} <= point.keys():
            points[str(point.get("name", name))] = (point["x"], point["y"], first_of(point, detections.SCORES))
        elif isinstance(point, list) and 2 <= len(point) <= 4 and (named or len(body) == len(MEDIAPIPE_33)):
            last = point[-1] if len(point) == 4 or (len(point) == 3 and named) else None  # the third of a row is z
            points[str(name)] = (*point[:2], last)
        elif point is not None and (not named or isinstance(point, dict | list)):
            raise detections.unknown(at)
    if not points:
        raise detections.unknown(at)
    return points
