"""Keypoints found in a video by rtmlib, an optional extra: RTMPose's 26 points of body and feet on onnxruntime.

rtmlib downloads its weights at first use. Anything that finds people can stand in its place, see ``find``.
"""

import contextlib
import io
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from motionlab.errors import DataError, MissingData, ShapeError
from motionlab.files import write_whole
from motionlab.io.detections import HALPE_26
from motionlab.io.video import Video

_LOWEST = 0.3  # score from which RTMPose draws a point
_OTHERWISE = (
    "Run a 2-D pose detector yourself and give what it wrote with --keypoints; docs/own_footage.md says how to run "
    "OpenPose, MMPose, AlphaPose and Ultralytics, and motionlab.io.keypoints what else is read."
)


def _rtmpose() -> Callable:
    """Loads RTMPose with its detector of people."""
    try:
        from rtmlib import BodyWithFeet

        with contextlib.redirect_stdout(sys.stderr):  # it says what it loads
            network = BodyWithFeet(mode="balanced", backend="onnxruntime", device="cpu")
    except ImportError as error:  # of rtmlib, or of the onnxruntime that it imports when a network is made
        what = f"a package of the optional extra that finds keypoints ({error})"
        how = "In the checkout: pip install -c constraints.txt -e '.[detect]'."
        raise MissingData(what, f"{how} {_OTHERWISE}") from error
    except Exception as error:
        how = f"{type(error).__name__}: {error}. Connect once to the network; or delete what is there and damaged."
        raise MissingData("RTMPose's file of weights", f"{how} {_OTHERWISE}") from error

    def finder(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        boxes = network.det_model(picture)
        if not len(boxes):  # it would take the whole picture for a person
            return np.zeros((0, len(HALPE_26), 2)), np.zeros((0, len(HALPE_26)))
        return network.pose_model(picture, bboxes=boxes)

    return finder


def find(
    video: Video, path: str | Path, *, finder: Callable | None = None, fps: float | None = None, progress: bool = False
) -> None:
    """Finds the keypoints of everybody in a video and writes them as npz, as ``io.keypoints`` reads it.

    finder: a picture (H, W, 3) uint8, blue first, to points (P, 26, 2) in pixels and scores (P, 26) of the people in
    it; default RTMPose's. fps: of a folder of images.

    Raises:
        MissingData: rtmlib is not installed, or its weights are not here and cannot be fetched.
        DataError: no frame rate, or nobody in any frame. ShapeError: another layout.
    """
    fps = fps or video.fps
    if fps is None:
        raise DataError("images hold no frames per second", path=video.path, remedy="pass fps=, or --fps")
    finder, frames, pictures = finder or _rtmpose(), [], video.pictures(range(video.frames))
    for picture in tqdm(pictures, total=video.frames, unit="frame", disable=not progress):
        points, scores = (np.asarray(x, float) for x in finder(np.ascontiguousarray(picture[..., ::-1])))
        if points.shape[1:] != (len(HALPE_26), 2) or scores.shape != points.shape[:-1]:
            raise ShapeError(f"finder: expected (P, 26, 2) and (P, 26), got {points.shape} and {scores.shape}")
        sure = np.where(scores < _LOWEST, 0.0, scores)
        frames.append(np.concatenate((points, sure[..., None]), -1))
    most = max([1, *map(len, frames)])
    table = np.stack([np.pad(people, ((0, most - len(people)), (0, 0), (0, 0))) for people in frames])
    if not (table[..., 2] > 0).any():
        raise DataError("nobody was found in any frame", path=video.path, remedy="use another video")
    archive = io.BytesIO()
    about = {"names": np.array(HALPE_26), "fps": fps, "size": np.array(video.size)}
    np.savez_compressed(archive, keypoints=table.astype(np.float32), **about)
    write_whole(path, archive.getvalue())
