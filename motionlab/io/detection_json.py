"""What 2-D pose detectors write as JSON: one small reader a format, from a document to people in frames."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial

import numpy as np

from motionlab.io import detections
from motionlab.io.detections import Detections, Sighting, first_of, pixels, stated, whole_number
from motionlab.io.layouts import COCO_17, MEDIAPIPE_33
from motionlab.io.reading import Location

_IMAGE = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark", "keypoints", "people", "persons", "poses")
_WORLD = ("pose_world_landmarks", "poseWorldLandmarks", "world_landmarks", "worldLandmarks", "keypoints3D")
#: Keys of a person's points: OpenPose's (version 1.0 writes no _2d), AlphaPose's, everybody else's.
_POINTS = ("pose_keypoints_2d", "pose_keypoints", "joints", "keypoints")
#: Detectors that leave no point out draw those from this score on; AlphaPose from here or from 0.4 on, by the model.
_MMPOSE, _VITPOSE, _ALPHAPOSE = 0.3, 0.5, 0.05


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
        found.names, found.size = detections.point_names(at, points), stated(at, document["images"][0])["size"]
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


def _person(at: Location, one: object, about: str = "", *, needed: bool = False) -> Sighting:
    """A flat list x, y, confidence, x, ...; or rows of coordinates, or x and y apart, with the scores beside them.

    No points, or an empty list, is somebody who was not found. needed: the key of the points has to be there.
    """
    key = next((key for key in _POINTS if key in one), _POINTS[0]) if isinstance(one, dict) else _POINTS[0]
    if not isinstance(one, dict):
        raise at.error(f'expected an object with "{key}"')
    if needed and key not in one:
        raise at.error('expected "keypoints" of every person')
    values, points = one.get(key), np.zeros((0, 3))
    if isinstance(values, dict):  # Ultralytics
        xy = pixels(at, [values.get("x"), values.get("y")], "2 K").T
        points = detections.with_scores(at, xy, first_of(values, detections.SCORES))
    elif isinstance(values, list) and values and isinstance(values[0], list):  # MMPose
        xy = pixels(at, values, "K D")
        if xy.shape[1] != 2:
            message = f"{xy.shape[1]} coordinates a point{about}: 3-D poses, where a fit needs pixels"
            raise at.error(message, remedy="give the 2-D detector's file")
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
    if any(seen.shape[1] in (26, 133) for seen in found.frames.values()):
        found.detector, found.lowest = "RTMPose as OpenPose", _MMPOSE  # Pose2Sim's
    return found


def _mmpose(at: Location, document: dict | list) -> Detections:
    meta = document.get("meta_info") or {} if isinstance(document, dict) else {}
    frames = document["instance_info"] if "instance_info" in document else document
    if isinstance(frames, dict):
        frames = [frames]
    if not any("instances" in frame for frame in frames):
        frames = [{"instances": frames}]  # one image
    numbers = [whole_number(frame.get("frame_id", n)) for n, frame in enumerate(frames)]
    if None in numbers:
        n = numbers.index(None)
        raise at.error(f"frame_id {frames[n]['frame_id']!r} is no frame number", place=f"frame {n}")
    people = zip(numbers, (frame["instances"] for frame in frames), strict=True)
    read = partial(_person, at, about=f" (data set {meta.get('dataset_name', 'not named')})", needed=True)
    return detections.collect(
        at, "MMPose", people, read, names=detections.point_names(at, meta.get("keypoint_id2name")), lowest=_MMPOSE
    )


def _of_images(at: Location, images: dict[object, Iterable], *, alphapose: bool) -> Detections:
    """AlphaPose and COCO results: people by image, whose order is the number at the end of its name, or the file's."""
    order = {}
    for image in images:
        tail = re.search(r"(\d{1,19})(?:_keypoints)?(?:\.\w{1,5})?$", image) if isinstance(image, str) else None
        order[image] = int(tail[1]) if tail else whole_number(image)
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

    def read(one: tuple[object, object]) -> Sighting:
        return pixels(at, one[1], "K 3")[:, [1, 0, 2]], whole_number(one[0])

    frames = document["keypoints"]
    people = (frame.items() if isinstance(frame, dict) else [(None, one) for one in frame] for frame in frames)
    names = detections.point_names(at, document["skeleton"])
    return detections.collect(at, "ViTPose", enumerate(people), read, names=names, lowest=_VITPOSE)


def _landmarks(at: Location, document: object) -> Detections:
    """MediaPipe, MoveNet and others who write points by name, or BlazePose's 33 in a row, frame by frame."""
    frames = document.get("frames", [document]) if isinstance(document, dict) else document
    frames = frames if isinstance(frames, list) and not _is_body(frames) else [frames]
    given = [whole_number(first_of(frame, detections.FRAME)) if isinstance(frame, dict) else None for frame in frames]
    seen = []
    for number, frame in zip(range(len(frames)) if None in given else given, frames, strict=True):
        at.place = f"frame {number}"
        seen.append((number, [(_by_name(at, body), name) for body, name in _bodies(at, frame)]))
    found = detections.collect_named(at, "named points", seen, **stated(at, document, *frames[:1]))
    found.detector = "MoveNet" if found.names == COCO_17 else found.detector
    return found


def _is_body(value: object) -> bool:
    """Whether a list is one person's points, not people or frames."""
    one = value[0] if isinstance(value, list) and value else None
    if isinstance(one, dict):
        return "x" in one and not isinstance(one["x"], dict | list)
    return isinstance(one, list) and len(one) in (2, 3, 4) and all(isinstance(x, int | float) for x in one)


def _bodies(at: Location, value: object) -> list[tuple[dict | list, int | None]]:
    """Everybody's points in what stands for a frame or for people, with their ids."""
    if isinstance(value, dict):
        inner = first_of(value, _IMAGE)
        if inner is not None:
            mine = whole_number(first_of(value, detections.ID))
            return [(body, mine if name is None else name) for body, name in _bodies(at, inner)]
        if first_of(value, _WORLD) is not None:
            message = "world landmarks alone: 3-D, in metres about the hips, where a fit needs pixels"
            raise at.error(message, remedy="save the image landmarks (pose_landmarks)")
        return [(value, None)] if value else []
    if _is_body(value):
        return [(value, None)]
    if not isinstance(value, list | None):
        raise detections.unknown(at)
    return [body for one in value or [] for body in _bodies(at, one)]


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
