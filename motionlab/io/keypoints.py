"""Keypoints of any 2-D pose detector, told by their content: people in pixels, joined through time.

Read are OpenPose (BODY_25, BODY_25B, BODY_135, COCO-18; also Pose2Sim's and Sports2D's Halpe-26), MMPose, AlphaPose,
COCO results and annotations, Ultralytics (tojson, labels, predictions), MediaPipe Pose, MoveNet, ViTPose, DeepLabCut,
Sports2D's TRC in pixels; a file, or one per frame in a folder. What else you have, save in one of our plain layouts:

- npz: ``keypoints`` (frames, joints, 2 or 3) or (frames, people, joints, 2 or 3): x, y and confidence; and what you
  know of ``names`` (joints), ``fps``, ``size`` (width, height), ``ids`` (people), ``confidence`` or ``scores``.
- CSV with a line per point, ``frame, keypoint, x, y``, and if you like ``confidence`` and ``id`` (or ``person``, the
  place in the frame's list); or with a line per frame, ``nose_x, nose_y, nose_confidence, ...``, and if you like
  ``frame``, ``id`` and ``time`` (s or ms).

A point that is NaN, at (0, 0), of confidence 0 or not there was not seen.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import torch

from motionlab.errors import DataError
from motionlab.io import tracking, video
from motionlab.io.detection_files import from_json, from_lines, from_npz, from_trc
from motionlab.io.detections import MOST_FRAMES, PLAIN, Detections, from_folder, names_of
from motionlab.io.reading import LARGEST, Location, frame_rate, image_size, read_json, read_text, reading
from motionlab.io.video import Video
from motionlab.observation import Observation2D

_OVER = 1.2  # scores to this are ones that ran over; beyond they are of another scale
#: Coordinates of which half stay below this are shares of the image; of which so many are negative, no place in it.
_SHARE, _NEGATIVE = 2.0, 0.25
#: Points lie on the border of the image within so many pixels; and were put there where that many, and this share of
#: all points, lie on the same side.
_ON, _REPEATED, _PUT = 1e-3, 4, 0.005
_GAP = 0.5  # seconds for which a person may vanish and still be the same one


@dataclass(frozen=True, eq=False)
class Person:
    """One person of a film: the file's id or a number of ours, the frames (N,) in which they were seen, their points.

    frames count from the first frame of the film; points (N, K, 3): x, y in pixels, confidence, 0 where not seen.
    """

    id: int
    frames: np.ndarray
    points: np.ndarray

    @property
    def height(self) -> float:
        """Median height of the box around the seen points, pixels."""
        seen, y = self.points[..., 2] > 0, self.points[..., 1]
        return float(np.median(np.where(seen, y, -np.inf).max(1) - np.where(seen, y, np.inf).min(1)))


@dataclass(frozen=True, eq=False)
class Footage:
    """Everybody whom a detector saw in one film, told apart.

    path: what was read. detector: who wrote it. names: of the K points. fps: frames per second. size: width and
    height in pixels, None where nobody said. first: number of the first frame, as the file counts. frames: T.
    notes: what was assumed. tracks: the people, whoever was seen in most frames first.
    """

    path: Path
    detector: str
    names: tuple[str, ...]
    fps: float
    size: tuple[float, float] | None
    first: int
    frames: int
    notes: tuple[str, ...]
    tracks: tuple[Person, ...]

    def table(self) -> list[dict[str, object]]:
        """Lists the people: a row each, with frames seen, their share, mean confidence of what was seen, height."""
        return [
            {"person": track.id, "frames": len(track.frames), "share %": 100 * len(track.frames) / self.frames,
             "confidence": float(track.points[..., 2][track.points[..., 2] > 0].mean()), "height px": track.height}
            for track in self.tracks
        ]  # fmt: skip

    def chosen(self, which: str | int | Sequence[str | int]) -> list[Person]:
        """Returns who is meant: "longest" seen, "largest" in the image, "all" who are there for a second, or ids.

        Raises:
            DataError: nobody has one of the ids.
        """
        words = [str(word) for word in ([which] if isinstance(which, str | int) else which)]
        if words == ["all"]:
            least = min(self.fps, self.frames / 2)  # a second, or half of a shorter clip
            return [track for track in self.tracks if len(track.frames) >= least] or [self.tracks[0]]
        known = {str(track.id): track for track in self.tracks}
        remedy = f"use longest, largest, all or some of {', '.join([*known][:20])}"
        known |= {"longest": self.tracks[0], "largest": max(self.tracks, key=lambda track: track.height)}
        if wrong := [word for word in words if word not in known] or [""] * (not words):
            raise self._error(f"nobody has the id {', '.join(wrong)}", remedy)
        return list(dict.fromkeys(known[word] for word in words))

    def person(self, which: str | int = "longest") -> Observation2D:
        """Returns one person's keypoints (T, K, 2), see ``chosen``."""
        found = self.people([which])
        return replace(found, keypoints=found.keypoints[0], confidence=found.confidence[0])

    def people(self, which: str | int | Sequence[str | int]) -> Observation2D:
        """Returns several people's keypoints as one batch (B, T, K, 2), in the order of their ids; see ``chosen``.

        Raises:
            DataError: nobody has one of the ids, or all of it is too much to hold.
        """
        tracks = self.chosen(which)
        shape = (len(tracks), self.frames, len(self.names), 3)
        if 4 * np.prod(shape, dtype=float) > LARGEST:
            raise self._error(f"{shape[:3]} people, frames and points are too many", "take fewer people")
        table = torch.zeros(shape)
        for row, track in zip(table, tracks, strict=True):
            row[torch.from_numpy(track.frames)] = torch.from_numpy(track.points)
        name = f"{self.path.name} from frame {self.first}"
        return Observation2D(table[..., :2], table[..., 2], self.names, self.fps, name=name)

    def of(self, points: Iterable[np.ndarray]) -> Self:
        """Returns the footage with other points of its people, but for frames and people of whom nothing was seen.

        Raises:
            DataError: nothing was seen of anybody.
        """
        there = [(track, new, (new[..., 2] > 0).any(-1)) for track, new in zip(self.tracks, points, strict=True)]
        kept = [replace(track, frames=track.frames[on], points=new[on]) for track, new, on in there if on.any()]
        if not kept:
            raise self._error("nothing is left of anybody", "give the footage that the keypoints are of")
        return replace(self, tracks=tuple(sorted(kept, key=_longest)))

    def within(self, size: tuple[float, float]) -> tuple[Self, list[str]]:
        """Returns the footage without points that were put onto the border of its image, and what is to be said of it.

        Some detectors put there what they take to be outside: then many lie on the same border to the digit.
        """
        points = np.concatenate([track.points.reshape(-1, 3) for track in self.tracks])
        points = points[points[:, 2] > 0]
        borders = [(axis, place) for axis in (0, 1) for place in (0.0, size[axis] - 1.0, float(size[axis]))
                   if (np.abs(points[:, axis] - place) < _ON).sum() >= max(_REPEATED, _PUT * len(points))]  # fmt: skip
        if not borders:
            return self, []

        def outside(points: np.ndarray) -> np.ndarray:
            return np.any([np.abs(points[..., axis] - place) < _ON for axis, place in borders], 0)

        inside = (np.where(outside(each.points)[..., None], np.float32(0), each.points) for each in self.tracks)
        said = "of the points lie on the very border of the image: they were outside, left out"
        return self.of(inside), [f"{outside(points).mean():.1%} {said}"]

    def _error(self, message: str, remedy: str) -> DataError:
        return DataError(message, path=self.path, place="people", remedy=remedy)


def _longest(track: Person) -> tuple[float, float]:
    return -len(track.frames), -track.height


def load(
    path: str | Path, *, fps: float | None = None, size: tuple[float, float] | None = None,
    layout: str | None = None, lowest: float | None = None, film: Video | None = None,
) -> Footage:  # fmt: skip
    """Reads what a 2-D pose detector wrote, whichever it was, and joins its people through time, in pixels.

    Frames are ordered by their number, or by the time that it is; one that is missing is a frame in which nobody was
    seen. Who is who is told by the file's ids, if each frame's people have different ones, and where one id ends and
    another begins by place; else by place alone, see ``join``. Who is there twice is taken once.
    Confidences are brought to 0..1; what had to be assumed is in ``notes``.

    Args:
        fps: frames per second; needed where the file does not say it.
        size: width and height of the image in pixels; needed where coordinates are shares of the image.
        layout: one of ``detections.LAYOUTS``; None takes the file's names, or decides by the number of keypoints.
        lowest: confidence below which a point was not seen; None is what the detector itself draws by.
        film: the video of the keypoints. Numbers up to its length are its frames, or those of its images; it says
            rate and size where the file does not.

    Raises:
        DataError: nothing that is known, 3-D poses, damaged, nobody at all; or fps or size is needed.
    """
    with reading(path, "give what a 2-D pose detector wrote: a file, or a folder with one file per frame") as at:
        found = from_folder(at, _read_file, ".json", ".txt") if at.path.is_dir() else _read_file(at)
        if not any(found.frames.values()):
            raise at.error("nobody was detected in any frame", place="")
        fps, given = found.fps if fps is None else frame_rate(at, fps, "fps"), sorted(found.frames)
        known = None if film is None else film.numbers or film.frames
        order, told, more = video.frames_of(given, fps=fps, film=known, loose=found.loose)
        rate = fps or told or (film and film.fps)
        if rate is None:
            raise at.error("the file holds no frames per second", place="fps", remedy="pass fps=, or --fps")
        if order[-1] - order[0] >= MOST_FRAMES:
            message = f"frame numbers run from {order[0]} to {order[-1]}"
            raise at.error(message, place="", remedy="remove the stray file")
        people = {n: found.frames[k] for n, k in zip(order, given, strict=True)}
        count, *others = [(len(points), n) for n in order for points, _ in people[n]]
        if other := next((each for each in others if each[0] != count[0]), None):
            raise at.error(f"expected {count[0]} keypoints, got {other[0]}", place=f"frame {other[1]}")
        frames = [people.get(n, []) for n in range(order[0], order[-1] + 1)]
        size = image_size(at, size) if size is not None else found.size or (film and film.size)
        everybody = np.stack([points for people in frames for points, _ in people]).astype(np.float32)
        notes = [*found.notes, *more, *_calibrate(at, everybody, size, found.lowest if lowest is None else lowest)]
        if not (everybody[..., 2] > 0).any():
            raise at.error("nobody was detected in any frame: no point is sure enough", place="")
        names = found.names if layout is None and found.names else names_of(at, everybody, layout)
        if len(names) != everybody.shape[1]:
            raise at.error(f"{len(names)} names for {everybody.shape[1]} keypoints", place="names")
        ids = [[name for _, name in people] for people in frames]
        frames = np.split(everybody, np.cumsum([len(people) for people in frames])[:-1])
        steps = np.diff(order)
        gap = round(max(1, _GAP * rate, np.median(steps) if len(steps) else 1))
        tracks, more = _told_apart(frames, ids, gap=gap)
        everything = (found.detector, names, rate, size, order[0], len(frames), (*notes, *more))
        return Footage(at.path, *everything, tuple(sorted(tracks, key=_longest)))


def _read_file(at: Location) -> Detections:
    """By its first bytes."""
    with at.path.open("rb") as file:
        head = file.read(4096).removeprefix(b"\xef\xbb\xbf").lstrip()
    if head[:2] == b"PK":
        return from_npz(at)
    if head[:1] == b"\x80" or head[:6] == b"\x93NUMPY":
        raise at.error("a pickle, which is never opened, or an array without names", remedy=PLAIN)
    if head[:1] in (b"{", b"["):
        return from_json(at, read_json(at, nan=True))
    text = read_text(at)
    return from_trc(at, text) if text.startswith("PathFileType") else from_lines(at, text)


def _calibrate(at: Location, people: np.ndarray, size: tuple[float, float] | None, lowest: float) -> list[str]:
    """Brings people (N, K, 3) to pixels and confidences of 0..1, in place, 0 where not seen; says what it assumed."""
    notes, xy, score = [], people[..., :2], people[..., 2]
    if np.isnan(score).all():
        score[:] = 1
        notes.append("the file has no confidences: every point in it counts 1")
    people[np.isnan(people).any(-1) | (xy == 0).all(-1) | (score == 0)] = 0
    seen, low, high = score != 0, score.min(), score.max()
    if low < -1:
        score[seen] = 1 / (1 + np.exp(-np.clip(score[seen], -500, 500)))
        notes.append(f"scores from {low:.3g} to {high:.3g} are logits: taken through the logistic function")
    elif high == 2 and np.isin(score, (0, 1, 2)).all():
        notes.append("0, 1 and 2 are flags, not confidences: every labelled point counts 1")
    elif high > 1:
        scale = np.percentile(score[score > 0], 99) if high > _OVER else 1.0
        score /= scale
        said = f"divided by {scale:.3g}, which 99 % of them do not pass" if high > _OVER else "those above 1 count 1"
        notes.append(f"scores go up to {high:.3g}: {said}")
    np.clip(score, 0, 1, out=score)
    unsure = (score > 0) & (score < lowest)
    if unsure.any():
        notes.append(f"{unsure.sum() / seen.sum():.1%} of the points have a confidence below {lowest:g}: left out")
    people[(score == 0) | unsure] = 0
    there = xy[score > 0]
    if len(there) and (there < 0).mean() > _NEGATIVE:
        message = "coordinates around zero are no place in an image, but 3-D (world landmarks in metres) or centred"
        raise at.error(message, place="coordinates", remedy="save the image's landmarks, in pixels or from 0 to 1")
    if len(there) and np.median(np.abs(there)) < _SHARE:
        if size is None:
            message = "coordinates are shares of an image whose size the file does not hold"
            raise at.error(message, place="size", remedy="pass size=(width, height), or --size")
        xy *= size
        notes.append(f"coordinates are shares of the image: multiplied by its size, {size[0]:g} x {size[1]:g}")
    return notes


def _told_apart(frames: list[np.ndarray], ids: list[list], *, gap: int) -> tuple[list[Person], list[str]]:
    """Tracks of frames of people (P, K, 3), and what is to be said of the file's ids (P)."""
    shown = [(n, k) for n, people in enumerate(frames) for k, seen in enumerate(people[..., 2] > 0) if seen.any()]
    notes: list[str] = []
    named: dict[int, list[tuple[int, int]]] = {}
    for n, k in shown:
        named.setdefault(ids[n][k], []).append((n, k))
    if None not in named and all(len(dict(people)) == len(people) for people in named.values()):
        for name, same in tracking.continued(named, frames, gap=gap).items():
            if len(same) > 1:
                notes.append(f"ids {_some(same)} are taken for one person, {name}: each begins where another ends")
                named[name] = [pair for one in same for pair in named.pop(one)]
    else:
        if any(name is not None for here in ids for name in here):
            notes = ["the file's ids do not tell people apart: people are followed by where they are"]
        named = dict(enumerate([shown] if len(dict(shown)) == len(shown) else tracking.join(frames, gap=gap)))
    for name, others in tracking.twins(named, frames).items():
        notes.append(f"people {_some([name, *others])} lie on each other: taken for one, {name}")
        for other in others:
            named[name] = sorted({**dict(named.pop(other)), **dict(named[name])}.items())
    points = {name: np.stack([frames[n][k] for n, k in people]) for name, people in named.items()}
    return [Person(name, np.array([n for n, _ in people]), points[name]) for name, people in named.items()], notes


def _some(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids[:9])) + (" and more" if len(ids) > 9 else "")


def load_person(
    folder: str | Path, *, fps: float, layout: str | None = None, person: str | int = "longest"
) -> Observation2D:
    """Reads one person's keypoints through time, in pixels, as :func:`load`; but every point counts, however unsure.

    person: "longest" (seen in most frames), "largest" (tallest in the image), or an id.

    Raises:
        DataError: see there; or nobody has the id.
    """
    return load(folder, fps=fps, layout=layout, lowest=0.0).person(person)
