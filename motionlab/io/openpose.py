"""OpenPose: folders with one JSON file of detected people per frame; tracking tells the people apart."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from motionlab.io.reading import Spot, frame_rate, numbers, read_json, reading
from motionlab.observation import BODY_25, Observation2D

_SIDES = [f"{side}_{part}" for part in ("eye", "ear", "shoulder", "elbow", "wrist") for side in ("left", "right")]
_LEGS = [f"{side}_{part}" for part in ("hip", "knee", "ankle") for side in ("left", "right")]
#: COCO's 17 points, in COCO's order.
COCO_17 = ("nose", *_SIDES, *_LEGS)
#: OpenPose's COCO model: BODY_25 without mid-hip and feet.
COCO_18 = tuple(name for name in BODY_25[:19] if name != "mid_hip")
#: OpenPose's experimental BODY_25B: COCO's points, then upper neck, head top and the feet.
BODY_25B = (*COCO_17, "upper_neck", "head_top", *BODY_25[19:])
LAYOUTS = {"BODY_25": BODY_25, "BODY_25B": BODY_25B, "COCO_18": COCO_18, "COCO_17": COCO_17}
#: Frame numbers that span more than this are taken for a mistake.
_MOST_FRAMES = 200_000
#: A person may move by this share of their own size between two sightings.
_REACH = 0.3
#: Keypoints that two sightings must share before they can be called the same person.
_SHARED = 3


def load(
    folder: str | Path, *, fps: float, layout: str | None = None, person: str | int = "longest", gap: float = 0.5
) -> Observation2D:
    """Reads one person's keypoints through time, in pixels, from a folder of OpenPose JSON files.

    Frames are ordered by the number at the end of the file's name, as a number; one that is missing becomes a
    frame in which nobody was seen. Files that are named otherwise before the number than most are left out.
    Everybody is tracked, then one track is chosen; where no frame shows more than one person, that is the one.
    Where the person or a keypoint is absent, confidence is 0 and the coordinates are 0, whatever the file says.

    Args:
        fps: frames per second. OpenPose does not store it.
        layout: one of ``LAYOUTS``; None decides by the number of keypoints, and for 25 by which points lie
            around the nose.
        person: ``"longest"`` (seen in most frames), ``"largest"`` (tallest in the image), or the place of the
            person in the people list of the first frame that shows anybody.
        gap: seconds for which a person may vanish and still be the same one.

    Raises:
        DataError: no numbered JSON, two files of one number, people that are no keypoint lists, nobody at all,
            or nobody at the place asked for.
    """
    with reading(folder, "point at a folder with one OpenPose JSON file per frame of one camera") as at:
        frames, first = _frames(at)
        if fps is None:
            raise at.error(
                "expected frames per second: OpenPose stores none", place="fps", remedy="pass fps=, or --fps"
            )
        rate = frame_rate(at, fps, "fps")
        seen = {first + n: people.shape[1] for n, people in enumerate(frames) if len(people)}
        if not any((people[..., 2] > 0).any() for people in frames if len(people)):
            raise at.error("nobody was detected in any frame" + (": every confidence is 0" if seen else ""))
        count = next(iter(seen.values()))
        if other := next((n for n in seen if seen[n] != count), None):
            raise at.error(
                f"expected {count} keypoints as in the frames before, got {seen[other]}", place=f"frame {other}"
            )
        layout = layout or _detect_layout(np.concatenate([people for people in frames if len(people)]))
        names = LAYOUTS.get(layout or "", ())
        if len(names) != count:
            message = f"layout {layout} does not fit" if layout else "the layout cannot be told from"
            raise at.error(f"{message} {count} keypoints", remedy=f"pass layout= one of {', '.join(LAYOUTS)}")
        if max(len(people) for people in frames) == 1 and person in ("longest", "largest", 0):
            chosen = [(frame, 0) for frame, people in enumerate(frames) if len(people)]
        else:
            chosen = _choose(_track(frames, gap=max(1, round(gap * rate))), person)
        if chosen is None:
            raise at.error(f"nobody fits person={person!r}", remedy='pass "longest", "largest" or a smaller number')
        table = torch.zeros(len(frames), len(names), 3)
        for frame, index in chosen:
            table[frame] = torch.from_numpy(frames[frame][index])
        return Observation2D(table[..., :2], table[..., 2], names, rate, name=f"{at.path.name} from frame {first}")


def to_body_25(observation: Observation2D, *, midpoints: bool = False) -> Observation2D:
    """Puts keypoints in BODY_25's order by name; a name that the layout lacks gets confidence 0.

    Args:
        midpoints: fill a missing neck or mid-hip with the middle of both shoulders or hips where both were seen
            (that is how OpenPose defines them), with the lower confidence of the two.
    """
    lead = observation.confidence.shape[:-1]
    keypoints = observation.keypoints.new_zeros(*lead, len(BODY_25), 2)
    confidence = observation.confidence.new_zeros(*lead, len(BODY_25))
    middles = {"neck": "shoulder", "mid_hip": "hip"} if midpoints else {}
    for k, name in enumerate(BODY_25):
        if name in observation.names:
            pair = [observation.index(name)]
        elif name in middles:
            pair = [observation.index(f"{side}_{middles[name]}") for side in ("left", "right")]
        else:
            continue
        confidence[..., k] = observation.confidence[..., pair].amin(-1)
        mean = observation.keypoints[..., pair, :].mean(-2)
        keypoints[..., k, :] = torch.where(confidence[..., k, None] > 0, mean, 0.0)
    return Observation2D(keypoints, confidence, BODY_25, observation.fps, observation.camera, observation.name)


def _frames(at: Spot) -> tuple[list[np.ndarray], int]:
    """People (P, K, 3) of every frame from the first number to the last, and the first number."""
    if not at.path.exists():
        raise at.error("no such folder", remedy="check the path")
    if not at.path.is_dir():
        raise at.error("is a file, expected a folder")
    series: dict[str, dict[int, Path]] = {}
    for file in sorted(at.path.glob("*.json")):
        found = re.search(r"(\d{1,15})(?:_keypoints)?$", file.stem)
        if found is not None:
            files = series.setdefault(file.stem[: found.start()], {})
            if files.setdefault(int(found.group(1)), file) is not file:
                raise at.error(f"{files[int(found.group(1))].name} has the same frame number", place=file.name)
    sizes = sorted((len(files) for files in series.values()), reverse=True)
    if not sizes:
        raise at.error("no numbered JSON file in it")
    if len(sizes) > 1 and sizes[0] == sizes[1]:
        raise at.error(f"several series of frames: {', '.join(sorted(series))}", remedy="one folder per camera")
    files = next(files for files in series.values() if len(files) == sizes[0])
    first, last = min(files), max(files)
    if last - first >= _MOST_FRAMES:
        raise at.error(f"frame numbers run from {first} to {last}", remedy="remove the stray file")
    empty = np.zeros((0, 0, 3), dtype=np.float32)
    return [_people(files[n]) if n in files else empty for n in range(first, last + 1)], first


def _people(file: Path) -> np.ndarray:
    with reading(file, "run OpenPose again for this frame") as at:
        document = read_json(at)
        if not isinstance(document, dict) or not isinstance(document.get("people"), list):
            raise at.error('expected an object with a list "people"', place='"people"')
        people = []
        for index, entry in enumerate(document["people"]):
            at.place = f"person {index}"
            flat = entry.get("pose_keypoints_2d") if isinstance(entry, dict) else None
            if not isinstance(flat, list) or not flat or len(flat) % 3:
                raise at.error('"pose_keypoints_2d": expected x, y, confidence of every keypoint')
            points = numbers(at, flat, str(len(flat))).reshape(-1, 3)
            points[:, 2] = points[:, 2].clip(0, 1)
            points[points[:, 2] == 0] = 0
            people.append(points)
        if len({len(points) for points in people}) > 1:
            raise at.error("people have different numbers of keypoints")
        return np.stack(people).astype(np.float32) if people else np.zeros((0, 0, 3), dtype=np.float32)


def _detect_layout(people: np.ndarray) -> str | None:
    """Layout of people (N, K, 3) by the number of keypoints; None where it cannot be told.

    BODY_25 and BODY_25B both have 25. Eyes and ears tell them apart: they are points 15 to 18 of BODY_25 and
    points 1 to 4 of BODY_25B, so the four that lie closer to the nose decide, by majority over the people.
    """
    sizes = {len(COCO_17): "COCO_17", len(COCO_18): "COCO_18"}
    if people.shape[1] != len(BODY_25):
        return sizes.get(people.shape[1])
    seen = people[..., 2] > 0
    distance = np.where(seen, np.linalg.norm(people[..., :2] - people[:, :1, :2], axis=-1), np.nan)
    votes = []
    for face, other in ((slice(1, 5), slice(15, 19)), (slice(15, 19), slice(1, 5))):
        both = seen[:, 0] & (seen[:, face].sum(-1) >= 2) & (seen[:, other].sum(-1) >= 2)
        votes.append(int((np.nanmean(distance[both, face], -1) < np.nanmean(distance[both, other], -1)).sum()))
    return None if votes[0] == votes[1] else ("BODY_25B" if votes[0] > votes[1] else "BODY_25")


@dataclass
class _Track:
    """One person: where they are in the frames' people lists, and their keypoints when last seen."""

    people: list[tuple[int, int]]  # (frame, index)
    last: np.ndarray  # (K, 3), every keypoint as last seen
    sizes: list[float] = field(default_factory=list)

    @property
    def size(self) -> float:
        """Median extent in the image, pixels."""
        return float(np.median(self.sizes))


def _track(frames: list[np.ndarray], *, gap: int) -> list[_Track]:
    """Everybody's track through frames of people (P, K, 3), by optimal assignment from frame to frame.

    A sighting joins the track whose keypoints, as last seen, lie nearest, within ``_REACH`` of its size; the
    assignment minimises the summed distance over all pairs (Hungarian method). A track that nobody joined for
    more than ``gap`` frames ends; a sighting that joins none begins one. Uses no randomness.
    """
    from scipy.optimize import linear_sum_assignment  # half a second, and only videos of several people need it

    tracks: list[_Track] = []
    for frame, people in enumerate(frames):
        alive = [t for t in tracks if frame - t.people[-1][0] <= gap]
        if not alive or not len(people):
            cost = np.full((len(alive), len(people)), np.inf)
        else:
            cost = _distances(np.stack([t.last for t in alive]), people)
        blocked = cost > _REACH
        joined = set()
        for row, column in zip(*linear_sum_assignment(np.where(blocked, 1e3, cost)), strict=True):
            if not blocked[row, column]:
                person, joined = people[column], joined | {column}
                alive[row].people.append((frame, int(column)))
                alive[row].last = np.where(person[:, 2:] > 0, person, alive[row].last)
                alive[row].sizes.append(float(_extent(person)))
        for column, person in enumerate(people):
            if column not in joined and (person[:, 2] > 0).any():
                tracks.append(_Track([(frame, column)], person.copy(), [float(_extent(person))]))
    return tracks


def _choose(tracks: list[_Track], person: str | int) -> list[tuple[int, int]] | None:
    """The (frame, index) pairs of the longest track, the largest one, or person number n of the first frame.

    Ties go to the larger, then to the earlier. None where nobody fits.
    """
    if isinstance(person, int):
        start = min((t.people[0] for t in tracks), default=(0, 0))[0]
        return next((t.people for t in tracks if t.people[0] == (start, person)), None)
    keys = {"longest": lambda t: (len(t.people), t.size), "largest": lambda t: (t.size, len(t.people))}
    return max(tracks, key=keys[person]).people if tracks and person in keys else None


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance (A, B) between people (A, K, 3) and (B, K, 3): median over the keypoints that both have.

    A share of the larger extent of the two; infinite where they share fewer than ``_SHARED`` keypoints.
    """
    both = (a[:, None, :, 2] > 0) & (b[None, :, :, 2] > 0)
    apart = np.linalg.norm(a[:, None, :, :2] - b[None, :, :, :2], axis=-1)
    shared = both.sum(-1)
    ordered = np.sort(np.where(both, apart, np.inf), axis=-1)
    median = np.take_along_axis(ordered, np.maximum(shared - 1, 0)[..., None] // 2, -1)[..., 0]
    size = np.maximum(_extent(a)[:, None], _extent(b)[None])
    return np.where((shared >= _SHARED) & (size > 0), median / np.maximum(size, 1e-9), np.inf)


def _extent(people: np.ndarray) -> np.ndarray:
    """Diagonal (...) of the box around the seen keypoints of people (..., K, 3), pixels; 0 where none is seen."""
    seen = people[..., 2:] > 0
    top = np.where(seen, people[..., :2], -np.inf).max(-2)
    bottom = np.where(seen, people[..., :2], np.inf).min(-2)
    return np.where(seen.any((-1, -2)), np.linalg.norm(np.maximum(top - bottom, 0), axis=-1), 0.0)
