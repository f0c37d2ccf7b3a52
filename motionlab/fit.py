"""``python -m motionlab fit``: a motion from the keypoints of one camera, by HuMoR's test-time optimisation."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from motionlab.errors import DataError
from motionlab.humor import priors, report_fit, testops
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.humor.real_input import at_rate
from motionlab.io import amass, bvh, gltf, openpose
from motionlab.io.camera import load_camera
from motionlab.io.reading import reading
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D
from motionlab.skeleton import STANDARD
from motionlab.viz import gif
from motionlab.viz.overlay import overlay

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
FILM = 12.0  # frames per second of the overlay, at most
MODES = {"shooting": "lean", "rollout": "official"}  # of a fit by each solver: with rollout all of it is the original
OUTSIDE = 0.2  # share of detections outside the image from which a camera does not fit


def run(options: argparse.Namespace) -> int:
    """The command, with the options that ``__main__`` reads."""
    for path, suffix in ((options.out, ".npz"), (options.bvh, ".bvh"), (options.glb, ".glb")):
        _check_target(path, suffix)
    seen, first, floor = observation(options)
    known = priors.load(
        motion=options.prior,
        pose=options.pose_prior,
        initial=options.initial,
        pelvis=None if options.pelvis is None else tuple(options.pelvis),
    )
    pictures = None if options.video is None else _pictures(options.video, first, seen, options.fps)
    schedule = testops.Schedule.quick() if options.quick else None  # the mode's own
    print(f"{seen.name}: {seen.frames} frames at 30 fps; Ctrl-C keeps the best so far")
    size = pictures[0].size if pictures else None
    how = {"mode": MODES[options.solver], "solver": options.solver, "schedule": schedule, "floor": floor, "size": size}
    fitted = testops.fit(seen, known, progress=True, **how)
    motion = fitted.motion.clip(0)
    for line in report_fit.report(fitted, seen).lines():
        print(line)
    _write(options, motion)
    if pictures is not None:
        _film(options.out.with_suffix(".gif"), fitted, pictures)
    return 0


def observation(options: argparse.Namespace) -> tuple[Observation2D, int, str | None]:
    """The keypoints in BODY_25's order at 30 fps with their camera, the number of the first frame, and what is known
    of the floor ("guess": nothing, though there is a camera; see ``testops.fit``).

    Raises:
        DataError: nobody, one frame, nothing that a fit uses, or a camera of another image.
    """
    person = int(options.person) if options.person.isdigit() else options.person
    seen = openpose.load(options.keypoints, fps=options.fps, layout=options.layout, person=person)
    first = int(seen.name.rsplit(" ", 1)[-1])
    seen = at_rate(openpose.to_body_25(seen, midpoints=True))
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
    if share > OUTSIDE:
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
        paths = sorted(path for path in at.path.iterdir() if path.suffix.lower() in PICTURES)
        last = first + round((seen.frames - 1) * fps / 30)
        if len(paths) <= last:
            raise at.error(f"{len(paths)} images, but the keypoints reach frame {last}")
        return _Frames([paths[first + round(frame * fps / 30)] for frame in range(seen.frames)])


def _film(path: Path, fitted: testops.Fitted, pictures: _Frames | tuple[()], width: int = 480) -> None:
    """The fitted landmarks over the pictures, or on grey, as a GIF."""
    motion, camera = fitted.motion, fitted.cameras[0]
    pixels = report_fit.pixels_of(motion, fitted.cameras)[0]
    drawn = Observation2D(pixels, torch.ones(pixels.shape[:2]), BODY_25, motion.fps, camera)
    step = max(1, round(motion.fps / FILM))
    height = round(width * camera.height / camera.width)
    blank = np.full((height, width, 3), 235, np.uint8)
    frames = range(0, motion.frames, step)
    below = {f: np.asarray(pictures[f].resize((width, height))) if pictures else blank for f in frames}
    gif.write(path, [overlay(drawn, below[f], f, width=3.0) for f in frames], motion.fps / step)
    print(path)
