"""OpenPose: folders with one JSON file of detected people per frame; tracking tells the people apart."""

from __future__ import annotations

from pathlib import Path

from motionlab.io import keypoints
from motionlab.observation import Observation2D


def load(
    folder: str | Path, *, fps: float, layout: str | None = None, person: str | int = "longest", gap: float = 0.5
) -> Observation2D:
    """Reads one person's keypoints through time, in pixels, from a folder of OpenPose JSON files.

    See :func:`motionlab.io.keypoints.load`, but every point counts, however unsure.

    Args:
        fps: frames per second. OpenPose does not store it.
        person: ``"longest"`` (seen in most frames), ``"largest"`` (tallest in the image), or an id.

    Raises:
        DataError: no numbered JSON, two files of one number, people that are no keypoint lists, nobody at all,
            or nobody with the id.
    """
    return keypoints.load(folder, fps=fps, layout=layout, lowest=0.0, gap=gap).person(person)
