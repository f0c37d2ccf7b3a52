"""What a 2-D pose detector found, people in frames, whatever it was written as; and layouts of keypoints: who is the
seventh point, and the way to BODY_25, which a fit uses.

A reader keeps what the file says: NaN where it says nothing, units and scores as they are. What these mean is for
``keypoints`` to say.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from motionlab.errors import DataError
from motionlab.io.reading import Location, checked_array, frame_rate, image_size, reading
from motionlab.observation import BODY_25, Observation2D

#: Other words for a point, once it is written in small letters with "_" between words.
_SAME = {"hip": "mid_hip", "pelvis": "mid_hip", "root": "mid_hip", "head": "head_top", "top_head": "head_top"}
_SIDE = r"^([lr])_?(?=eye|ear|shoulder|elbow|wrist|hip|knee|ankle|big|small|heel|foot)"
#: Where BODY_25 finds a point that a layout lacks: in the same place under another name, or in the middle of two.
_INSTEAD = {
    "left_big_toe": ["left_foot_index"], "right_big_toe": ["right_foot_index"],
    "neck": ["left_shoulder", "right_shoulder"], "mid_hip": ["left_hip", "right_hip"],
}  # fmt: skip
PLAIN = "save it with numpy.savez(path, keypoints=(frames, people, joints, 3), names=joints, fps=fps)"
#: Words for one thing, as keys of JSON and as columns of tables.
SCORES = ("score", "confidence", "visibility", "visible", "conf", "likelihood", "c", "v")
FRAME = ("frame", "frame_id", "frame_number", "frame_idx", "frame_index")
ID = ("id", "track_id", "person_id", "track")
MOST_FRAMES, _MOST_POINTS = 200_000, 200  # frame numbers that span more, and more names of points, are a mistake
_FORMATS = "OpenPose, MMPose, AlphaPose, COCO results, Ultralytics, MediaPipe, MoveNet, ViTPose, Sports2D and CSV"
_MEDIAPIPE = 0.5  # from this score on it draws a point
Sighting = tuple[np.ndarray, "int | None"]  # points (K, 3): x, y, confidence; the file's id


def _pairs(*parts: str) -> list[str]:
    return [f"{side}_{part}" for part in parts for side in ("left", "right")]


#: COCO's 17 points, in COCO's order.
COCO_17 = ("nose", *_pairs("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle"))
#: OpenPose's experimental BODY_25B: COCO's points, then upper neck, head top and the feet.
BODY_25B = (*COCO_17, "upper_neck", "head_top", *BODY_25[19:])
#: Halpe's body: COCO's points, then head top, neck, mid-hip and the feet.
HALPE_26 = (*COCO_17, "head_top", "neck", "mid_hip", *_pairs("big_toe", "small_toe", "heel"))
#: BlazePose's landmarks; its foot index is the tip of the big toe.
MEDIAPIPE_33 = (
    "nose", *(f"{side}_eye{part}" for side in ("left", "right") for part in ("_inner", "", "_outer")),
    "left_ear", "right_ear", "mouth_left", "mouth_right", *_pairs("shoulder", "elbow", "wrist"),
    *_pairs("pinky", "index", "thumb"), *_pairs("hip", "knee", "ankle", "heel", "foot_index"),
)  # fmt: skip
_FACE = [f"face_{n}" for n in range(70)]
_HANDS = [f"{side}_hand_{n}" for side in ("left", "right") for n in range(21)]
#: By name and number of points. Points without names are those of the first layout with as many.
LAYOUTS = {
    "BODY_25": BODY_25, "BODY_25B": BODY_25B, "COCO_17": COCO_17, "HALPE_26": HALPE_26, "MEDIAPIPE_33": MEDIAPIPE_33,
    "COCO_18": tuple(name for name in BODY_25[:19] if name != "mid_hip"),  # OpenPose's COCO model
    "WHOLEBODY_133": (*COCO_17, *BODY_25[19:], *_FACE[:68], *_HANDS),  # COCO-WholeBody
    # OpenPose's whole body, whose wrists are not of its hands; Halpe's full body
    "BODY_135": (*BODY_25B, *(name for name in _HANDS if not name.endswith("_0")), *_FACE),
    "HALPE_136": (*HALPE_26, *_FACE[:68], *_HANDS),
}  # fmt: skip


def standard_name(name: str) -> str:
    """Converts a keypoint's name to the way of the tables: "LShoulder" and "leftShoulder" to "left_shoulder"."""
    words = re.sub(r"[^0-9a-z]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.strip()).lower()).strip("_")
    words = re.sub(_SIDE, lambda side: {"l": "left_", "r": "right_"}[side[1]], words)
    return _SAME.get(words, words)


def names_of(at: Location, people: np.ndarray, layout: str | None = None) -> tuple[str, ...]:
    """Finds the names of the points of people (N, K, 3) by their number; BODY_25 and BODY_25B by the face.

    layout: of ``LAYOUTS``; then its names, if it fits.
    """
    fit = {known: names for known, names in LAYOUTS.items() if len(names) == people.shape[1]}
    if layout is None:
        layout = _by_face(people) if "BODY_25" in fit else next(iter(fit), None)
    if layout not in fit:
        message = f"layout {layout} does not fit" if layout else "the layout cannot be told from"
        remedy = f"pass layout=, or --layout: {', '.join(fit)}" if fit else f"none has so many: {PLAIN}"
        raise at.error(f"{message} {people.shape[1]} keypoints", place="", remedy=remedy)
    return fit[layout]


def _by_face(people: np.ndarray) -> str | None:
    """Layout of people (N, 25, 3); None where it cannot be told.

    Eyes and ears tell BODY_25 and BODY_25B apart: they are points 15 to 18 of BODY_25 and points 1 to 4 of BODY_25B, so
    the four that lie closer to the nose decide, by majority over the people.
    """
    seen = people[..., 2] > 0
    distance = np.where(seen, np.linalg.norm(people[..., :2] - people[:, :1, :2], axis=-1), np.nan)
    both = seen[:, 0] & (seen[:, 1:5].sum(-1) >= 2) & (seen[:, 15:19].sum(-1) >= 2)
    votes = np.sign(np.nanmean(distance[both, 15:19], -1) - np.nanmean(distance[both, 1:5], -1)).sum()
    return None if votes == 0 else ("BODY_25B" if votes > 0 else "BODY_25")


def to_body_25(observation: Observation2D) -> Observation2D:
    """Puts keypoints in BODY_25's order by name; a name that the layout lacks gets confidence 0.

    MediaPipe's foot index stands for the big toe; for a missing neck or mid-hip the middle of both shoulders or hips
    where both were seen, as OpenPose defines them, with the lower confidence of the two.
    """
    lead = observation.confidence.shape[:-1]
    keypoints = observation.keypoints.new_zeros(*lead, len(BODY_25), 2)
    confidence = observation.confidence.new_zeros(*lead, len(BODY_25))
    for k, name in enumerate(BODY_25):
        choices = ([name], _INSTEAD.get(name, [name]))
        if sources := next((each for each in choices if {*each} <= {*observation.names}), None):
            pair = [observation.index(source) for source in sources]
            confidence[..., k] = observation.confidence[..., pair].amin(-1)
            mean = observation.keypoints[..., pair, :].mean(-2)
            keypoints[..., k, :] = torch.where(confidence[..., k, None] > 0, mean, 0.0)
    return Observation2D(keypoints, confidence, BODY_25, observation.fps, observation.camera, observation.name)


@dataclass
class Detections:
    """Who was seen in which frame, as a file says it.

    detector: who wrote it. frames: frame number -> people: points (K, 3) of each, and the id, None for who has none.
    names: of the K points, None where the file has none. lowest: the confidence below which this detector itself takes
    a point for not seen. fps, size (width, height): None where it does not say. loose: the numbers are those of
    pictures, which need not be a film's.
    """

    detector: str
    frames: dict[int, list[Sighting]]
    names: tuple[str, ...] | None = None
    lowest: float = 0.0
    fps: float | None = None
    size: tuple[float, float] | None = None
    notes: list[str] = field(default_factory=list)
    loose: bool = False


#: One frame in which nobody was seen.
NOBODY = Detections("nobody", {0: []})


# ------------------------------------------------------------------------------------------------------------- folders
def from_folder(at: Location, read: Callable[[Location], Detections], *suffixes: str) -> Detections:
    """Reads a folder with one file per frame, ordered by the number at the end of its name, as a number.

    Files that are named otherwise before the number than most are left out. The first suffix of which there are
    numbered files counts.
    """
    files = next((files for suffix in suffixes if (files := _series(at, suffix))), None)
    if files is None:
        raise at.error(f"no numbered {' or '.join(suffixes)[1:].upper().replace('.', '')} file in it")
    frames, whole = {}, None
    for number, file in sorted(files.items()):
        with reading(file, "run the detector again for this frame") as one:
            # YOLO writes a blank file of labels for an image without people
            blank = file.suffix == ".txt" and file.stat().st_size < 64 and not file.read_bytes().strip()
            found = NOBODY if blank else read(one)
            if len(found.frames) != 1:
                raise one.error(f"holds {len(found.frames)} frames", place="", remedy="name this file, not its folder")
            (frames[number],) = found.frames.values()
            whole = whole or (found if frames[number] else None)
            if frames[number] and found.names != whole.names:
                raise one.error("names other points than the frames before", place="names")
    return replace(whole or found, frames=frames)


def _series(at: Location, suffix: str) -> dict[int, Path] | None:
    """The files of a folder by frame number, those named as most are; None where there is none."""
    series: dict[str, dict[int, Path]] = {}
    for file in sorted(at.path.glob(f"*{suffix}")):
        stem = re.sub(r"_(jpe?g|png)\.rf\.[0-9a-f]+$", "", file.stem)  # Roboflow's
        if found := re.fullmatch(r"(.*?)(\d{1,19})(?:_keypoints)?", stem):
            same = series.setdefault(found[1], {}).setdefault(int(found[2]), file)
            if same is not file:
                raise at.error(f"{same.name} has the same frame number", place=file.name)
    ranked = sorted(series.values(), key=len, reverse=True)
    if len(ranked) > 1 and len(ranked[0]) == len(ranked[1]):
        raise at.error(f"several series of frames: {', '.join(sorted(series))}", remedy="one folder per camera")
    return ranked[0] if ranked else None


# -------------------------------------------------------------------------------------------------- what readers share
def unknown(at: Location) -> DataError:
    """Returns the error for what is no detector's file."""
    return at.error(f"no known layout of keypoints; known are {_FORMATS}", remedy=PLAIN)


def collect(at: Location, detector: str, frames: Iterable[tuple[int, Iterable]], read: Callable, **more) -> Detections:
    """Reads (frame number, people) pairs, a person at a time; who has no points at all was not found."""
    found = Detections(detector, {}, **more)
    for number, people in frames:
        seen = []
        for k, person in enumerate(people):
            at.place = f"frame {number}, person {k}"
            seen.append(read(person))
        if number is None or number in found.frames:
            what = "its number is no frame's" if number is None else f"frame {number} is there twice"
            raise at.error(what, place=f"frame {len(found.frames)}")
        found.frames[number] = [(points, name) for points, name in seen if len(points)]
    return found


def collect_named(at: Location, detector: str, seen: list[tuple[int, list]], **more) -> Detections:
    """Joins (frame number, people) pairs whose points are (x, y, confidence) by name or number, None where not said.

    What somebody lacks is NaN. Names of COCO or MediaPipe are put in that layout's order.
    """
    keys = list(dict.fromkeys(key for _, people in seen for points, _ in people for key in points))
    at.place = "names"
    if len(keys) > _MOST_POINTS:
        raise at.error(f"{len(keys)} different keypoints")
    if all(re.fullmatch(r"\d{1,3}", key) for key in keys):
        names, order = None, [int(key) for key in keys]
    else:
        known = point_names(at, keys)
        names = next((names for names in (COCO_17, MEDIAPIPE_33) if {*known} <= {*names}), known)
        order = [names.index(name) for name in known]
    places, count = dict(zip(keys, order, strict=True)), len(names) if names else 1 + max(order, default=-1)

    def read(person: tuple[dict, int | None]) -> Sighting:
        row = np.full((count, 3), np.nan)
        row[[places[key] for key in person[0]]] = pixels(at, [*person[0].values()], "K 3")
        return row, person[1]

    if names == MEDIAPIPE_33 or (names is None and count == len(MEDIAPIPE_33)):
        detector, more["lowest"] = "MediaPipe", _MEDIAPIPE
    return collect(at, detector, seen, read, names=names, **more)


def pixels(at: Location, values: object, shape: str, place: str | None = None) -> np.ndarray:
    """Checks coordinates or scores, none beyond a million, of which any may be NaN; see ``reading.checked_array``."""
    return checked_array(at, values, shape, place, 1e6, nan=True)


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


def with_scores(at: Location, xy: np.ndarray, scores: object) -> np.ndarray:
    """Joins xy (K, 2) and K scores, or None, to points (K, 3)."""
    scores = np.full(len(xy), np.nan) if scores is None else pixels(at, scores, str(len(xy)))
    return np.column_stack([xy, scores])


def point_names(at: Location, value: object) -> tuple[str, ...] | None:
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


def stated(at: Location, *places: object) -> dict:
    """Reads frame rate and image size where one of some objects states them."""
    known = {key: value for place in places if isinstance(place, dict) for key, value in place.items()}
    fps, size = first_of(known, ("fps", "frame_rate", "framerate")), first_of(known, ("size", "image_size"))
    pairs = ([known.get(f"{kind}{side}") for side in ("width", "height")] for kind in ("", "image_", "canvas_"))
    size = next((pair for pair in pairs if None not in pair), None) if size is None else size
    rate = fps if fps is None else frame_rate(at, fps, "fps")
    return {"fps": rate, "size": size if size is None else image_size(at, size)}
