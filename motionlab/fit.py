"""``python -m motionlab fit``: a motion from the keypoints of one camera, by HuMoR's test-time optimisation."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import body_shape, pretrained, testops
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.humor.testops import Fitted
from motionlab.io import amass, bvh, gltf, openpose
from motionlab.io.cameras import load_camera
from motionlab.io.layouts import to_body_25
from motionlab.io.reading import reading
from motionlab.metrics import pose
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D, at_rate, project
from motionlab.skeleton import STANDARD
from motionlab.viz.movie import overlay, write_film

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
_FILM = 12.0  # frames per second of the overlay, at most
_MODES = {"shooting": "lean", "rollout": "official"}  # of a fit by each solver: with rollout all of it is the original
_OUTSIDE = 0.2  # share of detections outside the image from which a camera does not fit


def run(options: argparse.Namespace) -> int:
    """Runs the command, with the options that ``__main__`` reads."""
    for path, suffix in ((options.out, ".npz"), (options.bvh, ".bvh"), (options.glb, ".glb")):
        _check_target(path, suffix)
    seen, first, floor = _observation(options)
    known = pretrained.load_priors(
        motion=options.prior,
        pose=options.pose_prior,
        initial=options.initial,
        pelvis=None if options.pelvis is None else tuple(options.pelvis),
    )
    pictures = None if options.video is None else _pictures(options.video, first, seen, options.fps)
    schedule = testops.Schedule.quick() if options.quick else None  # the mode's own
    print(f"{seen.name}: {seen.frames} frames at 30 fps; Ctrl-C keeps the best so far")
    size = pictures[0].size if pictures else None
    how = {"mode": _MODES[options.solver], "solver": options.solver, "schedule": schedule, "floor": floor, "size": size}
    fitted = testops.fit(seen, known, progress=True, **how)
    motion = fitted.motion.clip(0)
    for line in _report(fitted, seen).lines():
        print(line)
    _write(options, motion)
    if pictures is not None:
        _film(options.out.with_suffix(".gif"), fitted, pictures)
    return 0


def _observation(options: argparse.Namespace) -> tuple[Observation2D, int, str | None]:
    """The keypoints in BODY_25's order at 30 fps with their camera, the number of the first frame, and what is known
    of the floor ("guess": nothing, though there is a camera; see ``testops.fit``).

    Raises:
        DataError: nobody, one frame, nothing that a fit uses, or a camera of another image.
    """
    person = int(options.person) if options.person.isdigit() else options.person
    seen = openpose.load(options.keypoints, fps=options.fps, layout=options.layout, person=person)
    first = int(seen.name.rsplit(" ", 1)[-1])
    seen = at_rate(to_body_25(seen, midpoints=True))
    used = [k for k in range(len(BODY_25)) if k not in UNUSED_BODY_25]
    if seen.frames < 2:
        raise DataError("one frame is no motion", path=options.keypoints, remedy="give two frames or more")
    if not (seen.confidence[:, used] > 0).any():
        message = "no keypoint that a fit uses was detected (it leaves out neck and hips)"
        raise DataError(message, path=options.keypoints, remedy="use another recording, or another --person")
    if options.camera is None:
        return seen, first, None
    camera, placed = load_camera(options.camera, options.camera_name, options.keypoints)
    _check_image(camera, seen, options.camera)
    return replace(seen, camera=camera), first, None if placed else "guess"


def _check_target(path: Path | None, suffix: str) -> None:
    if path is not None and path.suffix.lower() != suffix:
        raise DataError(f"expected a name that ends in {suffix}", path=path, remedy="rename it")
    if path is not None and not path.resolve().parent.is_dir():
        raise DataError("its folder is not there", path=path, remedy="make the folder first")


def _check_image(camera: Camera, seen: Observation2D, path: Path) -> None:
    size = seen.keypoints.new_tensor([camera.width, camera.height])
    outside = ((seen.keypoints < 0) | (seen.keypoints > size)).any(-1) & (seen.confidence > 0)
    share = float(outside.sum() / (seen.confidence > 0).sum())
    if share > _OUTSIDE:
        raise DataError(
            f"{100 * share:.0f} % of the detections lie outside its image of {camera.width} x {camera.height}",
            path=path,
            remedy="give the camera that took these images, at the same resolution (see --camera-name)",
        )


def _write(options: argparse.Namespace, motion: Motion) -> None:
    amass.save(options.out, motion)
    lift = float(motion.skeleton.standing_height() - STANDARD.standing_height())
    print(
        f"{options.out}: {motion.frames} frames; AMASS holds no bone lengths: on the standard body the feet are "
        f"{100 * lift:+.1f} cm off the floor"
    )
    for path, save in ((options.bvh, bvh.save), (options.glb, gltf.save)):
        if path is not None:
            save(path, motion)
            print(path)


class _Frames:
    """Pictures of the frames at 30 fps, opened when they are looked at."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths

    def __getitem__(self, frame: int) -> Image.Image:
        path = self.paths[frame]
        try:
            return Image.open(path).convert("RGB")
        except (OSError, UnidentifiedImageError) as error:
            raise DataError(f"cannot be read: {error}", path=path, remedy="extract the video's frames again") from error


def _pictures(folder: str, first: int, seen: Observation2D, fps: float) -> _Frames | tuple[()]:
    """The images of a folder that show the fitted frames; () for none."""
    if not folder:
        return ()
    with reading(folder, "extract the video's frames into it") as at:
        if not at.path.is_dir():
            raise at.error("no such folder")
        paths = sorted(path for path in at.path.iterdir() if path.suffix.lower() in _PICTURES)
        last = first + round((seen.frames - 1) * fps / 30)
        if len(paths) <= last:
            raise at.error(f"{len(paths)} images, but the keypoints reach frame {last}")
        return _Frames([paths[first + round(frame * fps / 30)] for frame in range(seen.frames)])


def _film(path: Path, fitted: testops.Fitted, pictures: _Frames | tuple[()], width: int = 480) -> None:
    """The fitted landmarks over the pictures, or on grey, as a GIF."""
    motion, camera = fitted.motion, fitted.cameras[0]
    pixels = pixels_of(motion, fitted.cameras)[0]
    drawn = Observation2D(pixels, torch.ones(pixels.shape[:2]), BODY_25, motion.fps, camera)
    step = max(1, round(motion.fps / _FILM))
    height = round(width * camera.height / camera.width)
    blank = np.full((height, width, 3), 235, np.uint8)
    frames = range(0, motion.frames, step)
    below = {f: np.asarray(pictures[f].resize((width, height))) if pictures else blank for f in frames}
    pictures = [overlay(drawn, below[f], f, width=3.0) for f in frames]
    write_film(pictures, path, motion.fps / step, budget=10_000_000)
    print(path)


# ---------------------------------------------------------------------------------------------------------- the report
@dataclass(frozen=True)
class FitReport:
    """What is said of one fitted recording: distance from the detections, smoothness, contacts, what was assumed.

    pixels: mean distance of the landmarks from the detections, weighted by confidence, neck and hips (which a fit
    ignores) left out; median_pixels: the median, each detection counted once. acceleration: mean over joints and
    frames, m/s^2. contacts: share of the frames in which each of the contact joints touches the floor. seen: share of
    the 22 used keypoints that were detected. energy: after each stage, by term. reasons: why each search ended.
    """

    frames: int
    fps: float
    pixels: float
    median_pixels: float
    acceleration: float
    contacts: dict[str, float]
    seen: float
    energy: dict[int, dict[str, float]]
    reasons: tuple[str, ...]
    notes: tuple[str, ...]

    def lines(self) -> list[str]:
        """Returns the report as lines for a terminal."""
        touch = ", ".join(f"{name.replace('_', ' ')} {100 * share:.0f} %" for name, share in self.contacts.items())
        return [
            *(f"note: {note}" for note in self.notes),
            *(f"energy after stage {n}: {sum(e.values()):.1f} ({_terms(e)})" for n, e in self.energy.items()),
            f"search ended: {_runs(self.reasons)}",
            f"detections: {100 * self.seen:.0f} % of the keypoints",
            f"reprojection: {self.pixels:.1f} px mean, {self.median_pixels:.1f} px median",
            f"acceleration: {self.acceleration:.2f} m/s^2 mean",
            f"contacts: {touch}",
        ]


def _runs(words: tuple[str, ...]) -> str:
    """Words in a row, each run of the same once with its length: "steps, closures (9)"."""
    counts = [(word, len(list(same))) for word, same in groupby(words)]
    return ", ".join(f"{word} ({n})" if n > 1 else word for word, n in counts)


def _terms(energy: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.1f}" for name, value in sorted(energy.items(), key=lambda item: -item[1])[:4])


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


def _report(fitted: Fitted, observation: Observation2D, clip: int = 0) -> FitReport:
    """The report of one recording of a fit to keypoints of BODY_25."""
    motion = fitted.motion.clip(clip)
    away, weight = pixel_distances(pixels_of(fitted.motion, fitted.cameras), observation)
    away, weight = away[clip], weight[clip]
    seen = weight > 0
    contacts = (fitted.contacts[clip] > 0.5).float().mean(0).tolist()
    fits = [each for results in fitted.results.values() for each in results]
    return FitReport(
        frames=motion.frames,
        fps=motion.fps,
        pixels=float((weight * away).sum() / weight.sum()),
        median_pixels=float(away[seen].median()) if seen.any() else float("nan"),
        acceleration=float(pose.mean_acceleration(motion.positions, motion.fps)),
        contacts=dict(zip(motion.skeleton.contact_names, contacts, strict=True)),
        seen=float(seen.sum() / (seen.numel() * (1 - len(UNUSED_BODY_25) / seen.shape[-1]))),
        energy={n: {name: float(e[clip]) for name, e in terms.items()} for n, terms in fitted.energies.items()},
        reasons=tuple(each.reasons[min(clip, len(each.reasons) - 1)] for each in fits),
        notes=fitted.notes,
    )
