"""What 2-D pose detectors write as JSON: one small reader a format, from a document to people in frames.

A reader moves ``at.place`` along and keeps what the file says: NaN where it says nothing, units and scores as they
are. What these mean is for ``keypoints`` to say.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from motionlab.errors import DataError
from motionlab.io import numbering
from motionlab.io.layouts import COCO_17, MEDIAPIPE_33, standard_name
from motionlab.io.reading import Spot, frame_rate, image_size, numbers, reading

#: No pixel, no share of an image and no score lies beyond.
FARTHEST = 1e6
#: What to save instead of what cannot be read.
PLAIN = "save it with numpy.savez(path, keypoints=(frames, people, joints, 3), names=joints, fps=fps)"
#: Words for one thing, as keys of JSON and as columns of tables.
SCORES = ("score", "confidence", "visibility", "visible", "conf", "likelihood", "c", "v")
FRAME = ("frame", "frame_id", "frame_number", "frame_idx", "frame_index")
ID = ("id", "track_id", "person_id", "track")
_IMAGE = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark", "keypoints", "people", "persons", "poses")
_WORLD = ("pose_world_landmarks", "poseWorldLandmarks", "world_landmarks", "worldLandmarks", "keypoints3D")
#: Frame numbers that span more than this are taken for a mistake; so are more points of a person than this.
MOST_FRAMES = 200_000
_MOST_POINTS = 200
_FORMATS = "OpenPose, MMPose, AlphaPose, COCO results, Ultralytics, MediaPipe, MoveNet, ViTPose, Sports2D and CSV"
#: Detectors that leave no point out draw those from this score on; AlphaPose from here or from 0.4 on, by the model.
_MMPOSE, _VITPOSE, _MEDIAPIPE, _ALPHAPOSE = 0.3, 0.5, 0.5, 0.05
_NOBODY = np.zeros((0, 0, 3))

Sighting = tuple[np.ndarray, "int | None"]  # points (K, 3): x, y, confidence; the file's id


@dataclass
class Detections:
    """Who was seen in which frame, as a file says it.

    detector: who wrote it. frames: frame number -> people (P, K, 3): x, y, confidence. ids: frame number -> their P
    ids, None for who has none. names: of the K points, None where the file has none. lowest: the confidence below
    which this detector itself takes a point for not seen. fps, size (width, height): None where it does not say.
    loose: the numbers are those of pictures, which need not be a film's.
    """

    detector: str
    frames: dict[int, np.ndarray]
    ids: dict[int, list[int | None]]
    names: tuple[str, ...] | None = None
    lowest: float = 0.0
    fps: float | None = None
    size: tuple[float, float] | None = None
    notes: list[str] = field(default_factory=list)
    loose: bool = False

    def renumbered(self, at: Spot, fps: float | None = None, film: int | Sequence[int] | None = None) -> Detections:
        """Returns the same by frame: numbers that are times or those of any pictures become frames, and a note says so.

        fps: frames per second that somebody said. film: frames of the film, or the numbers of its images.

        Raises:
            DataError: no frame.
        """
        if not self.frames:
            raise at.error("holds no frames", place="")
        numbers = sorted(self.frames)
        order, rate, notes = numbering.frames_of(numbers, fps=fps or self.fps, film=film, loose=self.loose)
        frames, ids = ({n: of[k] for n, k in zip(order, numbers, strict=True)} for of in (self.frames, self.ids))
        return replace(self, frames=frames, ids=ids, fps=self.fps or rate, notes=[*self.notes, *notes])

    def in_order(self, at: Spot) -> tuple[list[np.ndarray], int]:
        """Puts people in a list from the first frame to the last; a number without a frame shows nobody.

        Raises:
            DataError: numbers that lie too far apart, people with different numbers of keypoints.
        """
        first, last = min(self.frames), max(self.frames)
        if last - first >= MOST_FRAMES:
            raise at.error(f"frame numbers run from {first} to {last}", place="", remedy="remove the stray file")
        counts = {n: self.frames[n].shape[1] for n in sorted(self.frames) if len(self.frames[n])}
        count = next(iter(counts.values()), 0)
        if other := next((n for n in counts if counts[n] != count), None):
            message = f"expected {count} keypoints as in the frames before, got {counts[other]}"
            raise at.error(message, place=f"frame {other}")
        return [self.frames.get(n, _NOBODY) for n in range(first, last + 1)], first


#: One frame in which nobody was seen.
NOBODY = Detections("nobody", {0: _NOBODY}, {0: []})


# ------------------------------------------------------------------------------------------------------------- folders
def from_folder(at: Spot, read: Callable[[Spot], Detections], *suffixes: str) -> Detections:
    """Reads a folder with one file per frame, ordered by the number at the end of its name, as a number.

    Files that are named otherwise before the number than most are left out. The first suffix of which there are
    numbered files counts.

    Raises:
        DataError: no numbered file, two of one number, several series, a file that holds several frames.
    """
    if not at.path.exists():
        raise at.error("no such folder", remedy="check the path")
    if not at.path.is_dir():
        raise at.error("is a file, expected a folder")
    files = next((files for suffix in suffixes if (files := _series(at, suffix))), None)
    if files is None:
        raise at.error(f"no numbered {' or '.join(suffixes)[1:].upper().replace('.', '')} file in it")
    frames, ids, whole = {}, {}, None
    for number in sorted(files):
        with reading(files[number], "run the detector again for this frame") as one:
            found = NOBODY if _is_blank(files[number]) else read(one)
            if len(found.frames) != 1:
                raise one.error(f"holds {len(found.frames)} frames", place="", remedy="name this file, not its folder")
            (frames[number],), (ids[number],) = found.frames.values(), found.ids.values()
            whole = whole or (found if len(frames[number]) else None)
            if len(frames[number]) and found.names != whole.names:
                raise one.error("names other points than the frames before", place="names")
    return replace(whole or found, frames=frames, ids=ids)


def _is_blank(file: Path) -> bool:
    """Whether a file of labels holds none: YOLO writes such a one for an image without people."""
    return file.suffix == ".txt" and file.stat().st_size < 64 and not file.read_bytes().strip()


def _series(at: Spot, suffix: str) -> dict[int, Path] | None:
    """The files of a folder by frame number, those named as most are; None where there is none."""
    series: dict[str, dict[int, Path]] = {}
    for file in sorted(at.path.glob(f"*{suffix}")):
        stem = re.sub(r"_(jpe?g|png)\.rf\.[0-9a-f]+$", "", file.stem)  # Roboflow's
        found = re.search(r"(\d{1,19})(?:_keypoints)?$", stem)
        if found is not None:
            files = series.setdefault(stem[: found.start()], {})
            if files.setdefault(int(found.group(1)), file) is not file:
                raise at.error(f"{files[int(found.group(1))].name} has the same frame number", place=file.name)
    sizes = sorted((len(files) for files in series.values()), reverse=True)
    if len(sizes) > 1 and sizes[0] == sizes[1]:
        raise at.error(f"several series of frames: {', '.join(sorted(series))}", remedy="one folder per camera")
    return next((files for files in series.values() if len(files) == sizes[0]), None)


# -------------------------------------------------------------------------------------------------- what readers share
def unknown(at: Spot) -> DataError:
    """Returns the error for what is no detector's file."""
    return at.error(f"no known layout of keypoints; known are {_FORMATS}", remedy=PLAIN)


def collect(at: Spot, detector: str, seen: Iterable[tuple[int, list[Sighting]]], **more) -> Detections:
    """Joins (frame number, people) pairs; who has no points at all becomes a row of zeros.

    Raises:
        DataError: a frame is there twice, people have different numbers of keypoints, or far too many.
    """
    frames, ids = {}, {}
    for number, people in seen:
        if number in frames:
            raise at.error("this frame is there twice", place=f"frame {number}")
        counts = {len(points) for points, _ in people if len(points)}
        if len(counts) > 1:
            raise at.error("people have different numbers of keypoints")
        if max(counts, default=0) > _MOST_POINTS:
            raise at.error(f"{max(counts)} keypoints of one person")
        shown = [points if len(points) else np.zeros((*counts, 3)) for points, _ in people] if counts else []
        frames[number] = np.stack(shown) if shown else _NOBODY
        ids[number] = [name for _, name in people] if shown else []
    return Detections(detector, frames, ids, **more)


def collect_named(at: Spot, detector: str, seen: list[tuple[int, list[tuple[dict, int | None]]]], **more) -> Detections:
    """Joins (frame number, people) pairs whose points are (x, y, confidence) by name or number, None where not said.

    What somebody lacks is NaN. Names of COCO or MediaPipe are put in that layout's order.

    Raises:
        DataError: see ``collect``; or a number cannot be used.
    """
    keys = list(dict.fromkeys(key for _, people in seen for points, _ in people for key in points))
    at.place = "names"
    if len(keys) > _MOST_POINTS:
        raise at.error(f"{len(keys)} different keypoints")
    if all(re.fullmatch(r"\d{1,3}", key) for key in keys):
        names, places = None, {key: int(key) for key in keys}
        count = 1 + max(places.values(), default=-1)
    else:
        known = dict(zip(keys, point_names(at, keys), strict=True))
        layouts = (names for names in (COCO_17, MEDIAPIPE_33) if set(known.values()) <= set(names))
        names = next(layouts, tuple(known.values()))
        places, count = {key: names.index(name) for key, name in known.items()}, len(names)
    rows: list[tuple[int, list[Sighting]]] = []
    for number, people in seen:
        rows.append((number, []))
        for points, name in people:
            at.place = f"frame {number}, person {len(rows[-1][1])}"
            row = np.full((count, 3), np.nan)
            row[[places[key] for key in points]] = numbers(at, [*points.values()], "K 3", largest=FARTHEST, nan=True)
            rows[-1][1].append((row, name))
    if names == MEDIAPIPE_33 or (names is None and count == len(MEDIAPIPE_33)):
        detector, more["lowest"] = "MediaPipe", _MEDIAPIPE
    return collect(at, detector, rows, names=names, **more)


def whole_number(value: object) -> int | None:
    """Finds a whole number from 0 on, also as a text or alone in a list; None for anything else."""
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, str) and re.fullmatch(r"\d{1,15}(\.0+)?", value):
        value = float(value)
    good = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 2**53 and value % 1 == 0
    return int(value) if good else None


def first_of(place: dict, words: tuple[str, ...]) -> object:
    """Finds the value of the first of some keys that is there; None where none is."""
    return next((place[word] for word in words if word in place), None)


def with_scores(at: Spot, xy: np.ndarray, scores: object) -> np.ndarray:
    """Joins xy (K, 2) and K scores, or None, to points (K, 3)."""
    if scores is None:
        return np.concatenate([xy, np.full((len(xy), 1), np.nan)], 1)
    return np.concatenate([xy, numbers(at, scores, str(len(xy)), largest=FARTHEST, nan=True)[:, None]], 1)


def point_names(at: Spot, value: object) -> tuple[str, ...] | None:
    """Reads names from a list, or from an object of index and name; None where there are none."""
    if isinstance(value, dict):
        value = [value.get(str(k)) for k in range(len(value))]
    if not value:
        return None
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise at.error("expected a name for every keypoint", place="names")
    names = tuple(standard_name(name) for name in value)
    if len(set(names)) < len(names):
        raise at.error("two keypoints have one name", place="names")
    return names


def stated(at: Spot, *places: object) -> dict:
    """Reads frame rate and image size where one of some objects states them."""
    known = {key: value for place in places if isinstance(place, dict) for key, value in place.items()}
    fps = first_of(known, ("fps", "frame_rate", "framerate"))
    size = first_of(known, ("size", "image_size"))
    if size is None:
        pairs = ([known.get(f"{kind}{side}") for side in ("width", "height")] for kind in ("", "image_", "canvas_"))
        size = next((pair for pair in pairs if None not in pair), None)
    rate = fps if fps is None else frame_rate(at, fps, "fps")
    return {"fps": rate, "size": size if size is None else image_size(at, size)}


# ---------------------------------------------------------------------------------------------------------------- JSON
def from_json(at: Spot, document: object) -> Detections:
    """Converts a document, told by its keys or by those of the first thing in it; [] is a frame that shows nobody.

    Raises:
        DataError: no detector's, 3-D poses, or damaged; names the place.
    """
    if document == []:
        return NOBODY
    item = document
    while isinstance(item, list):
        item = next((value for value in item if value), None)
    keys = item.keys() if isinstance(item, dict) else set()
    inner = item.get("keypoints") if keys else None
    if "people" in keys:
        return openpose(at, document)
    if keys & {"instance_info", "instances", "keypoint_scores"}:
        return _mmpose(at, document)
    if {"image_id", "keypoints"} <= keys and item is not document:
        return _results(at, document)
    if {"skeleton", "keypoints"} <= keys and item is document:
        return _vitpose(at, document)
    if isinstance(inner, dict) and isinstance(inner.get("x"), list) and item is not document:
        return _ultralytics(at, document)
    if keys and all(isinstance(value, dict) and value.keys() & {"bodies", "people"} for value in item.values()):
        return _alphapose_images(at, item)
    return _landmarks(at, document)


def openpose(at: Spot, document: object) -> Detections:
    """Converts what OpenPose writes of one frame, or a list of such frames.

    Raises:
        DataError: no people, or people that are no keypoint lists.
    """
    several = isinstance(document, list) and bool(document)
    seen = []
    for n, frame in enumerate(document if several else [document]):
        prefix = f"frame {n}, " if several else ""
        if not isinstance(frame, dict) or not isinstance(frame.get("people"), list):
            raise at.error('expected an object with a list "people"', place=f'{prefix}"people"')
        seen.append((n, _people(at, frame["people"], prefix)))
    points = max((len(person) for _, people in seen for person, _ in people), default=0)
    detector, lowest = ("RTMPose as OpenPose", _MMPOSE) if points in (26, 133) else ("OpenPose", 0.0)  # Pose2Sim's
    return collect(at, detector, seen, lowest=lowest, **stated(at, document[0] if several else document))


def _people(at: Spot, people: list, prefix: str, key: str = "pose_keypoints_2d") -> list[Sighting]:
    found = []
    for k, entry in enumerate(people):
        at.place = f"{prefix}person {k}"
        if not isinstance(entry, dict):
            raise at.error(f'expected an object with "{key}"')
        flat = first_of(entry, (key, "pose_keypoints"))  # version 1.0 writes no _2d
        points = np.zeros((0, 3)) if flat in ([], None) else _flat(at, flat, key)
        found.append((points, whole_number(entry.get("person_id"))))
    return found


def _flat(at: Spot, values: object, key: str = "keypoints") -> np.ndarray:
    """Points (K, 3) of a flat list."""
    if not isinstance(values, list) or not values or len(values) % 3:
        raise at.error(f'"{key}": expected x, y, confidence of every keypoint')
    return numbers(at, values, str(len(values)), largest=FARTHEST, nan=True).reshape(-1, 3)


def _mmpose(at: Spot, document: dict | list) -> Detections:
    meta = document.get("meta_info") or {} if isinstance(document, dict) else {}
    frames = document["instance_info"] if "instance_info" in document else document
    if isinstance(frames, dict):
        frames = [frames]
    if not any("instances" in frame for frame in frames):
        frames = [{"instances": frames}]  # one image
    seen = []
    for n, frame in enumerate(frames):
        at.place = f"frame {n}"
        number, people = whole_number(frame.get("frame_id", n)), []
        if number is None:
            raise at.error(f"frame_id {frame['frame_id']!r} is no frame number")
        for k, one in enumerate(frame["instances"]):
            at.place = f"frame {number}, person {k}"
            xy = numbers(at, one.get("keypoints"), "K D", largest=FARTHEST, nan=True)
            if xy.shape[1] != 2:
                message = f"{xy.shape[1]} coordinates a point (data set {meta.get('dataset_name', 'not named')}): "
                raise at.error(f"{message}3-D poses, where a fit needs pixels", remedy="give the 2-D detector's file")
            people.append((with_scores(at, xy, one.get("keypoint_scores")), whole_number(one.get("track_id"))))
        seen.append((number, people))
    names = point_names(at, meta.get("keypoint_id2name"))
    return collect(at, "MMPose", seen, names=names, lowest=_MMPOSE)


def _results(at: Spot, document: list) -> Detections:
    """AlphaPose and COCO results: a list of people with the image they are in."""
    images: dict[object, list[Sighting]] = {}
    for k, entry in enumerate(document):
        at.place = f"entry {k}"
        name = whole_number(first_of(entry, ("idx", "track_id")))
        images.setdefault(entry["image_id"], []).append((_flat(at, entry.get("keypoints")), name))
    order, loose = _image_numbers(at, images)
    alphapose = any(isinstance(image, str) for image in images)
    detector, lowest = ("AlphaPose", _ALPHAPOSE) if alphapose else ("COCO results", 0.0)
    seen = [(order[image], people) for image, people in images.items()]
    return collect(at, detector, seen, lowest=lowest, **loose)


def _alphapose_images(at: Spot, document: dict) -> Detections:
    """AlphaPose's formats cmu and open: people by image."""
    order, loose = _image_numbers(at, document)
    seen = []
    for image, frame in document.items():
        key = "joints" if "bodies" in frame else "pose_keypoints_2d"
        seen.append((order[image], _people(at, first_of(frame, ("bodies", "people")), f"{image}, ", key)))
    return collect(at, "AlphaPose", seen, lowest=_ALPHAPOSE, **loose)


def _image_numbers(at: Spot, images: Iterable) -> tuple[dict, dict[str, object]]:
    """Number of every image, by the number at the end of its name, else by its place in the file; and what they are."""
    found = {}
    for image in images:
        tail = re.search(r"(\d{1,19})(?:_keypoints)?(?:\.\w{1,5})?$", image) if isinstance(image, str) else None
        found[image] = int(tail[1]) if tail else whole_number(image)
    if None in found.values():
        note = "images have no numbers: taken in the file's order"
        return {image: n for n, image in enumerate(found)}, {"notes": [note]}
    if len({*found.values()}) < len(found):
        raise at.error("two images have the same number", place="image_id", remedy="one file per camera")
    return found, {"loose": True}


def _vitpose(at: Spot, document: dict) -> Detections:
    """easy_ViTPose: frames of people by id, or in a list; each point is y, x, score."""
    seen = []
    for n, frame in enumerate(document["keypoints"]):
        people = []
        for key, points in frame.items() if isinstance(frame, dict) else ((None, points) for points in frame):
            at.place = f"frame {n}, person {len(people)}"
            points = numbers(at, points, "K 3", largest=FARTHEST, nan=True)
            people.append((points[:, [1, 0, 2]], whole_number(key)))
        seen.append((n, people))
    names = point_names(at, document["skeleton"])
    return collect(at, "ViTPose", seen, names=names, lowest=_VITPOSE)


def _ultralytics(at: Spot, document: list) -> Detections:
    """What tojson() gives: a list of people, or a list of such lists, one per frame."""
    frames = [document] if any(isinstance(entry, dict) for entry in document) else document
    seen = []
    for n, frame in enumerate(frames):
        people = []
        for k, one in enumerate(frame):
            at.place = f"frame {n}, person {k}"
            if isinstance(points := one.get("keypoints"), dict):  # another thing than a person has none
                xy = numbers(at, [points.get("x"), points.get("y")], "2 K", largest=FARTHEST, nan=True).T
                people.append((with_scores(at, xy, points.get("visible")), whole_number(one.get("track_id"))))
        seen.append((n, people))
    return collect(at, "Ultralytics", seen)


def _landmarks(at: Spot, document: object) -> Detections:
    """MediaPipe, MoveNet and others who write points by name, or BlazePose's 33 in a row, frame by frame."""
    frames = document.get("frames", [document]) if isinstance(document, dict) else document
    frames = frames if isinstance(frames, list) and not _is_body(frames) else [frames]
    given = [whole_number(first_of(frame, FRAME)) if isinstance(frame, dict) else None for frame in frames]
    seen = []
    for number, frame in zip(range(len(frames)) if None in given else given, frames, strict=True):
        at.place = f"frame {number}"
        seen.append((number, [(_by_name(at, body), name) for body, name in _bodies(at, frame)]))
    found = collect_named(at, "named points", seen, **stated(at, document, *frames[:1]))
    found.detector = "MoveNet" if found.names == COCO_17 else found.detector
    return found


def _is_body(value: object) -> bool:
    """Whether a list is one person's points, not people or frames."""
    one = value[0] if isinstance(value, list) and value else None
    if isinstance(one, dict):
        return "x" in one and not isinstance(one["x"], dict | list)
    return isinstance(one, list) and len(one) in (2, 3, 4) and all(isinstance(x, int | float) for x in one)


def _bodies(at: Spot, value: object) -> list[tuple[dict | list, int | None]]:
    """Everybody's points in what stands for a frame or for people, with their ids."""
    if isinstance(value, dict):
        inner = first_of(value, _IMAGE)
        if inner is not None:
            mine = whole_number(first_of(value, ID))
            return [(body, mine if name is None else name) for body, name in _bodies(at, inner)]
        if first_of(value, _WORLD) is not None:
            message = "world landmarks alone: 3-D, in metres about the hips, where a fit needs pixels"
            raise at.error(message, remedy="save the image landmarks (pose_landmarks)")
        return [(value, None)] if value else []
    if _is_body(value):
        return [(value, None)]
    if not isinstance(value, list | None):
        raise unknown(at)
    return [body for one in value or [] for body in _bodies(at, one)]


def _by_name(at: Spot, body: dict | list) -> dict[str, tuple]:
    """(x, y, confidence) by name or number of one person; None where it is not said."""
    named = isinstance(body, dict)
    points = {}
    for name, point in body.items() if named else enumerate(body):
        if isinstance(point, dict) and {"x", "y"} <= point.keys():
            points[str(point.get("name", name))] = (point["x"], point["y"], first_of(point, SCORES))
        elif isinstance(point, list) and 2 <= len(point) <= 4 and (named or len(body) == len(MEDIAPIPE_33)):
            last = point[-1] if len(point) == 4 or (len(point) == 3 and named) else None  # the third of a row is z
            points[str(name)] = (*point[:2], last)
        elif point is not None and (not named or isinstance(point, dict | list)):
            raise unknown(at)
    if not points:
        raise unknown(at)
    return points
