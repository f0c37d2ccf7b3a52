"""What 2-D pose detectors write as JSON: one small reader a format, from a document to people in frames."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from motionlab.io.detections import (
    FARTHEST,
    FRAME,
    ID,
    NOBODY,
    SCORES,
    Detections,
    Sighting,
    collect,
    collect_named,
    first_of,
    point_names,
    stated,
    unknown,
    whole_number,
    with_scores,
)
from motionlab.io.layouts import COCO_17, MEDIAPIPE_33
from motionlab.io.reading import Spot, numbers

_IMAGE = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark", "keypoints", "people", "persons", "poses")
_WORLD = ("pose_world_landmarks", "poseWorldLandmarks", "world_landmarks", "worldLandmarks", "keypoints3D")
#: Detectors that leave no point out draw those from this score on; AlphaPose from here or from 0.4 on, by the model.
_MMPOSE, _VITPOSE, _ALPHAPOSE = 0.3, 0.5, 0.05


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
