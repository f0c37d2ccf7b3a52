"""Layouts of 2-D keypoints: who is the seventh point, in tables of names; and the way to BODY_25, which a fit uses."""

from __future__ import annotations

import re

import numpy as np
import torch

from motionlab.io.reading import Location
from motionlab.observation import BODY_25, Observation2D


def _pairs(*parts: str) -> list[str]:
    return [f"{side}_{part}" for part in parts for side in ("left", "right")]


def _row(part: str, numbers: range) -> list[str]:
    return [f"{part}_{n}" for n in numbers]


#: COCO's 17 points, in COCO's order.
COCO_17 = ("nose", *_pairs("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle"))
#: OpenPose's COCO model: BODY_25 without mid-hip and feet.
COCO_18 = tuple(name for name in BODY_25[:19] if name != "mid_hip")
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
_HANDS = [name for side in ("left", "right") for name in _row(f"{side}_hand", range(21))]
#: COCO-WholeBody: COCO's points, the feet, 68 of the face, 21 of each hand.
WHOLEBODY_133 = (*COCO_17, *BODY_25[19:], *_row("face", range(68)), *_HANDS)
#: OpenPose's whole body: BODY_25B, 20 of each hand (the wrist is the body's), 70 of the face.
BODY_135 = (*BODY_25B, *(name for name in _HANDS if not name.endswith("_0")), *_row("face", range(70)))
#: Halpe's full body: its body, 68 of the face, 21 of each hand.
HALPE_136 = (*HALPE_26, *_row("face", range(68)), *_HANDS)
#: By name and number of points. Points without names are those of the first layout with as many.
LAYOUTS = {
    "BODY_25": BODY_25, "BODY_25B": BODY_25B, "COCO_18": COCO_18, "COCO_17": COCO_17, "HALPE_26": HALPE_26,
    "MEDIAPIPE_33": MEDIAPIPE_33, "WHOLEBODY_133": WHOLEBODY_133, "BODY_135": BODY_135, "HALPE_136": HALPE_136,
}  # fmt: skip
#: Other words for a point, once it is written in small letters with "_" between words.
_SAME = {"hip": "mid_hip", "pelvis": "mid_hip", "root": "mid_hip", "head": "head_top", "top_head": "head_top"}
_SIDE = r"^([lr])_?(?=eye|ear|shoulder|elbow|wrist|hip|knee|ankle|big|small|heel|foot)"
#: Where BODY_25 finds a point that a layout lacks: the same place under another name.
_INSTEAD = {"left_big_toe": "left_foot_index", "right_big_toe": "right_foot_index"}


def standard_name(name: str) -> str:
    """Converts a keypoint's name to the way of the tables: "LShoulder" and "leftShoulder" to "left_shoulder"."""
    words = re.sub(r"[^0-9a-z]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.strip()).lower()).strip("_")
    words = re.sub(_SIDE, lambda side: {"l": "left_", "r": "right_"}[side[1]], words)
    return _SAME.get(words, words)


def names_of(at: Location, people: np.ndarray, layout: str | None = None) -> tuple[str, ...]:
    """Finds the names of the points of people (N, K, 3) by their number; BODY_25 and BODY_25B by the face.

    layout: of ``LAYOUTS``; then its names, if it fits.
    """
    layout, count = layout or _detect_layout(people), people.shape[1]
    names = LAYOUTS.get(layout or "", ())
    if len(names) != count:
        message = f"layout {layout} does not fit" if layout else "the layout cannot be told from"
        fit = ", ".join(known for known, names in LAYOUTS.items() if len(names) == count)
        remedy = f"pass layout=, or --layout: {fit}" if fit else "none has so many: save keypoints, names, fps as npz"
        raise at.error(f"{message} {count} keypoints", place="", remedy=remedy)
    return names


def _detect_layout(people: np.ndarray) -> str | None:
    """Layout of people (N, K, 3) by the number of keypoints; None where it cannot be told.

    BODY_25 and BODY_25B both have 25. Eyes and ears tell them apart: they are points 15 to 18 of BODY_25 and
    points 1 to 4 of BODY_25B, so the four that lie closer to the nose decide, by majority over the people.
    """
    if people.shape[1] != len(BODY_25):
        return next((layout for layout, names in LAYOUTS.items() if len(names) == people.shape[1]), None)
    seen = people[..., 2] > 0
    distance = np.where(seen, np.linalg.norm(people[..., :2] - people[:, :1, :2], axis=-1), np.nan)
    votes = []
    for face, other in ((slice(1, 5), slice(15, 19)), (slice(15, 19), slice(1, 5))):
        both = seen[:, 0] & (seen[:, face].sum(-1) >= 2) & (seen[:, other].sum(-1) >= 2)
        votes.append(int((np.nanmean(distance[both, face], -1) < np.nanmean(distance[both, other], -1)).sum()))
    return None if votes[0] == votes[1] else ("BODY_25B" if votes[0] > votes[1] else "BODY_25")


def to_body_25(observation: Observation2D) -> Observation2D:
    """Puts keypoints in BODY_25's order by name; a name that the layout lacks gets confidence 0.

    MediaPipe's foot index stands for the big toe; for a missing neck or mid-hip the middle of both shoulders or hips
    where both were seen, as OpenPose defines them, with the lower confidence of the two.
    """
    lead = observation.confidence.shape[:-1]
    keypoints = observation.keypoints.new_zeros(*lead, len(BODY_25), 2)
    confidence = observation.confidence.new_zeros(*lead, len(BODY_25))
    middles = {"neck": "shoulder", "mid_hip": "hip"}
    for k, name in enumerate(BODY_25):
        middle = [f"{side}_{middles.get(name)}" for side in ("left", "right")]
        sources = next((s for s in ([name], [_INSTEAD.get(name)], middle) if set(s) <= set(observation.names)), [])
        if not sources:
            continue
        pair = [observation.index(source) for source in sources]
        confidence[..., k] = observation.confidence[..., pair].amin(-1)
        mean = observation.keypoints[..., pair, :].mean(-2)
        keypoints[..., k, :] = torch.where(confidence[..., k, None] > 0, mean, 0.0)
    return Observation2D(keypoints, confidence, BODY_25, observation.fps, observation.camera, observation.name)
