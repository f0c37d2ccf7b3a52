"""What a fit is given: keypoints, the footage that they are of, and the camera that took it, put together."""

import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from motionlab.errors import DataError, MissingData
from motionlab.files import writing
from motionlab.footage import detect
from motionlab.footage.scene_fit import MIN_KEYPOINTS, USED
from motionlab.io import cameras, keypoints
from motionlab.io.cameras import for_images, load_camera
from motionlab.io.detections import to_body_25
from motionlab.io.keypoints import Footage
from motionlab.io.video import Video, background_drift, open_video
from motionlab.observation import Camera, Observation2D, at_rate
from motionlab.optimise import begins

_OUTSIDE = 0.2  # share of detections outside the image from which they are not of this image
_SAMPLES = 60  # pictures in which the background is compared, half a second or more apart
_SLACK = 2  # frames that detectors and players count more or less


@dataclass(frozen=True, eq=False)
class Clip:
    """Keypoints with their footage. video: None where there is none. first: the video's frame of the first keypoints.
    size: of the image, None where nobody says. notes: what was assumed. times: seconds of the keypoints' frames, where
    they do not come at even times. camera: None for an assumed one. placed: whether its place is known."""

    footage: Footage
    video: Video | None
    first: int
    size: tuple[int, int] | None
    notes: tuple[str, ...]
    times: np.ndarray | None = None
    camera: Camera | None = None
    placed: bool = False

    @property
    def rate(self) -> float:
        """Frames per second of the film."""
        return self.footage.fps if self.video is None or self.video.fps is None else self.video.fps

    @property
    def count(self) -> int:
        """Frames of the film."""
        seconds = self.footage.frames / self.footage.fps if self.times is None else self.times[-1] + 1 / self.rate
        there = math.inf if self.video is None or self.video.times is not None else self.video.frames - self.first
        return max(1, min(round(seconds * self.rate), there))

    def pictures(self, frames: Sequence[int]) -> Iterator[np.ndarray]:
        """Returns the pictures of frames of the film, as a camera without distortion would have taken them."""
        wanted, times = [self.first + frame for frame in frames], self.video.times
        if times is not None:
            wanted = _frames_at(times, times[self.first] + np.array(frames) / self.rate).tolist()
        found = self.video.pictures(wanted)
        return cameras.straight(found, self.camera) if self.camera is not None and self.camera.distortion else found

    @property
    def samples(self) -> range:
        """Frames of the film in which the background is compared."""
        return range(0, self.count, max(1, round(self.rate / 2), self.count // _SAMPLES))

    def drift(self) -> np.ndarray:
        """Computes how far the background moved (N,) in ``samples``, shares of the image's width; see
        ``background_drift``."""
        scale = self.video.size[0] / self.size[0] if self.size else 1.0
        seconds, even = np.array(self.samples) / self.rate, self.times is None
        rows = np.rint(seconds * self.footage.fps) if even else _frames_at(self.times, seconds)
        boxes: list[list[tuple[float, ...]]] = [[] for _ in rows]
        for at, here in zip(rows, boxes, strict=True):
            for track in self.footage.tracks:
                near = np.abs(track.frames - at)
                points = track.points[near.argmin()]
                points = points[points[:, 2] > 0, :2] * scale
                if near.min() <= self.footage.fps / 2 and len(points):
                    here.append((*points.min(0), *points.max(0)))
        return background_drift(self.pictures(self.samples), boxes)


def _frames_at(times: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """The frame that is there at each moment."""
    return np.searchsorted(times, seconds + 1e-6, "right") - 1


def output_folder(out: str | Path) -> Path:
    """Makes a folder for what a fit writes, if it is not there; returns its whole path.

    Raises:
        DataError: ``out`` is or looks like a file, or the folder cannot be made or written.
    """
    out = Path(out)
    if out.suffix.lower() in (".npz", ".bvh", ".glb", ".json", ".mp4") or out.is_file():
        remedy = f"give a folder, such as --out {out.with_suffix('')}/: motion.npz, motion.bvh, scene.glb, ... go there"
        raise DataError("fit writes a folder, not one file", path=out, remedy=remedy)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out) as probe:
            probe.write(b"whether there is room is better known before than after")
    return out.absolute()  # FFmpeg takes what is before a colon for a protocol


def read_clip(
    keypoints_path: str | Path | None, video_path: str | Path | None = None, *,
    person: str | int | Sequence[str | int] = "longest", camera: str | Path | None = None,
    camera_name: str | None = None, **how,
) -> tuple[Clip, list[int], Observation2D]:  # fmt: skip
    """Returns a clip with the camera of a file, its lens taken out; the ids of who is meant; their keypoints for a fit.

    person: see ``Footage.chosen``. how: see ``open_clip``.

    Raises:
        DataError: see ``open_clip``, ``with_camera`` and ``observation``; nobody has the id, or people outside the
            image. MissingData: see ``detect.find``.
    """
    clip = open_clip(keypoints_path, video_path, **how)
    if camera is not None:
        clip = with_camera(clip, camera, camera_name)
    ids = [track.id for track in clip.footage.chosen(person)]
    clip = straightened(in_image(clip, ids, camera, guessed=not how.get("size")))
    return clip, ids, observation(clip, ids)


def open_clip(
    keypoints_path: str | Path | None, video_path: str | Path | None = None, *, out: str | Path | None = None,
    fps: float | None = None, size: tuple[int, int] | None = None, layout: str | None = None,
    progress: bool | str = False,
) -> Clip:  # fmt: skip
    """Reads keypoints and opens their video, which says rate and size where the keypoints do not.

    out: folder for the keypoints, where they have to be found (``VIDEO_keypoints.npz``).

    Raises:
        DataError: either cannot be read, or the video is shorter than the keypoints. MissingData: see ``detect.find``.
    """
    shown, notes = None if video_path is None else open_video(video_path), []
    if keypoints_path is None:
        if shown is None:
            raise MissingData("the keypoints", "Give a video, or --keypoints FILE_OR_FOLDER.")
        if out is None:
            raise DataError("nowhere to keep the keypoints that are found", remedy="name a folder: --out OUT/")
        keypoints_path = output_folder(out) / f"{shown.path.stem}_keypoints.npz"
        if keypoints_path.exists():
            notes = [f"keypoints of an earlier run: {keypoints_path}; delete it to find them again"]
        else:
            detect.find(shown, keypoints_path, fps=fps, progress=bool(begins("keypoints", progress)))
    how = {"size": size, "layout": layout, "film": shown}
    read = keypoints.load(keypoints_path, fps=fps, **how)
    first = None if shown is None else _first(read, shown)
    if shown is not None and first is None and read.first + read.frames <= shown.frames + _SLACK and shown.fps:
        rates = f"taken at its {shown.fps:g} a second, not {read.fps:g}"
        notes.append(f"keypoints numbered as the footage's frames: {rates}")
        read = keypoints.load(keypoints_path, fps=shown.fps, **how)
        first = _first(read, shown)
    notes += read.notes
    size = read.size and tuple(map(round, read.size))
    if size is not None:
        read, more = read.within(size)
        notes += more
    if shown is None:
        return Clip(read, None, 0, size, tuple(notes))
    if first is None:
        message = f"{shown.frames} frames, but the keypoints reach frame {read.first + read.frames - 1}"
        raise DataError(message, path=shown.path, remedy="give the footage that the keypoints are of, and its --fps")
    times = _times(read, shown, first)
    notes += [*shown.notes, *_said(read, shown, first, times, guessed=fps is None)]
    return Clip(read, shown, first, size, tuple(notes), times)


def _pace(read: Footage, shown: Video) -> float:
    """Frames of the video for one of the keypoints."""
    if shown.fps is None:
        return 1.0
    by_time = abs(read.frames / read.fps * shown.fps - shown.frames) <= _SLACK < abs(read.frames - shown.frames)
    if shown.times is not None and not by_time:
        return 1.0  # a frame each, whenever it comes
    return shown.fps / read.fps


def _first(read: Footage, shown: Video) -> int | None:
    """The video's frame of the first keypoints, whose numbers count from 0 or 1; None where they are not of it."""
    pace = _pace(read, shown)
    need, slack = round(read.frames * pace), max(_SLACK, math.ceil(pace))
    if shown.frames in (need, need + 1):
        return 0
    starts = (round(read.first * pace), round((read.first - 1) * pace))
    fits = ((at, more) for more, some in ((0, starts), (slack, starts[::-1]), (0, (0,)), (slack, (0,))) for at in some)
    return next((at for at, more in fits if 0 <= at < shown.frames and at + need <= shown.frames + more), None)


def _times(read: Footage, shown: Video, first: int) -> np.ndarray | None:
    """Seconds of the keypoints' frames, where the video's do not come at even times and they are one for one."""
    if shown.times is None or _pace(read, shown) != 1.0:
        return None
    times = shown.times[first:][: read.frames] - shown.times[first]
    return np.append(times, times[-1] + np.arange(1, read.frames - len(times) + 1) / shown.fps)


def _said(read: Footage, shown: Video, first: int, times: np.ndarray | None, *, guessed: bool) -> list[str]:
    """What was assumed of keypoints and footage; guessed: nobody said the keypoints' rate."""
    rate, notes = shown.fps or read.fps, []
    last = 1 + round((read.frames - 1) * _pace(read, shown))
    if times is not None:
        notes.append("keypoints put at the footage's time stamps")
    elif abs(rate / read.fps - 1) > 0.02:
        notes.append(f"keypoints at {read.fps:g} frames per second, footage at {rate:g}: put together by time")
    if (short := first + last - shown.frames) > 0:
        notes.append(f"the footage ends before the keypoints, whose frames are {short} more")
    if first:
        notes.append(f"the keypoints begin at frame {first} of the footage")
    every = round(shown.frames / read.frames)
    rest = shown.frames - (read.frames - 1) * every
    if guessed and read.fps == shown.fps and first == 0 and every > 1 and 0 <= rest <= every:
        taken = f"the keypoints are taken for the first {read.frames} of {shown.frames} frames"
        notes.append(f"{taken}: if they are of one in {every}, say --fps {rate / every:g}")
    return notes


def with_camera(clip: Clip, path: str | Path, name: str | None = None) -> Clip:
    """Returns the clip with the camera of a file: for images of this size, and its lens still in the keypoints.

    Raises:
        DataError: no such camera, or one for images of another shape.
    """
    camera, placed = load_camera(path, name, clip.footage.path, clip.size)
    footage, notes = clip.footage, []
    if clip.size is not None:
        camera, notes = for_images(camera, clip.size, Path(path))
    else:
        footage, notes = footage.within((camera.width, camera.height))
    return replace(clip, footage=footage, notes=(*clip.notes, *notes), camera=camera, placed=placed)


def straightened(clip: Clip) -> Clip:
    """Returns the clip with keypoints as the camera would see them without its lens."""
    if clip.camera is None or not clip.camera.distortion:
        return clip
    found, lost, count = [], 0, 0
    for track in clip.footage.tracks:
        points, seen = track.points.copy(), track.points[..., 2] > 0
        points[..., :2] = cameras.undistorted(points[..., :2], clip.camera)
        gone = ~np.isfinite(points[..., :2]).all(-1)
        points[gone | ~seen] = 0
        lost, count = lost + int((gone & seen).sum()), count + int(seen.sum())
        found.append(points)
    notes = [f"the lens is taken out of keypoints and pictures: {', '.join(f'{x:g}' for x in clip.camera.distortion)}"]
    if lost > _OUTSIDE * count:
        message = f"no point of the image is where {lost / count:.0%} of the keypoints are"
        raise DataError(message, place="distortion", remedy="give k1, k2, p1, p2, k3 in OpenCV's order")
    if lost:
        notes.append(f"{lost / count:.1%} of the keypoints are where this lens puts nothing: left out")
    return replace(clip, footage=clip.footage.of(found), notes=(*clip.notes, *notes))


def observation(clip: Clip, ids: Sequence[int]) -> Observation2D:
    """Computes keypoints (P, T, 25, 2) at 30 fps, in the layout that a fit uses.

    Raises:
        DataError: one frame, or of somebody too few keypoints.
    """
    read = clip.footage
    seen = at_rate(to_body_25(read.people(ids)), times=clip.times)
    if seen.frames < 2:
        raise DataError("one frame is no motion", path=read.path, remedy="give two frames or more")
    for each, confidence in zip(ids, seen.confidence, strict=True):
        if (confidence[:, USED] > 0).sum(-1).max() < MIN_KEYPOINTS:
            message = f"no frame shows {MIN_KEYPOINTS} keypoints that a fit uses (it leaves out neck and hips)"
            remedy = "use another recording, or another --person"
            raise DataError(message, path=read.path, place=f"person {each}", remedy=remedy)
    return seen


def in_image(clip: Clip, ids: Sequence[int], camera: str | Path | None = None, *, guessed: bool = False) -> Clip:
    """Checks that people lie in the image, as its camera or its footage says it is.

    guessed: nobody said its size; then a note tells where it may be larger than the one in which people were detected:
    all of them lie in its left upper quarter.

    Raises:
        DataError: a fifth of the detections, or more, do not.
    """
    size = clip.size if clip.camera is None else (clip.camera.width, clip.camera.height)
    if size is None:
        return clip
    tracks = [track for track in clip.footage.tracks if track.id in ids]
    points = np.concatenate([track.points[track.points[..., 2] > 0, :2] for track in tracks])
    share = ((points < 0) | (points > size)).any(-1).mean()
    if share > _OUTSIDE:
        remedy = "of another size, or not turned upright? Give the size (--size WxH), or the camera (--camera-name)"
        message = f"{share:.0%} of the detections lie outside its image of {size[0]} x {size[1]}"
        raise DataError(message, path=camera or (clip.video and clip.video.path) or clip.footage.path, remedy=remedy)
    if not guessed or not (np.quantile(points, 0.99, axis=0) < np.divide(size, 2)).all():
        return clip
    copy = f"if they are of a smaller copy, give its size, as --size {round(size[0] / 2)}x{round(size[1] / 2)}"
    note = f"all detections lie in the left upper quarter of the image of {size[0]} x {size[1]}: {copy}"
    return replace(clip, notes=(*clip.notes, note))
