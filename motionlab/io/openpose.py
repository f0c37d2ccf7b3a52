"""OpenPose: folders with one JSON file of detected people per frame; tracking tells the people apart."""

from __future__ import annotations

from pathlib import Path

from motionlab.io import keypoints
from motionlab.observation import Observation2D


def load(
    folder: str | Path, *, fps: float, layout: str | None = None, person: str | int = "longest", gap: float = 0.5
) -> Observation2D:
    """Reads one person's keypoints through time, in pixels, as :func:`motionlab.io.keypoints.load`; but every point
    counts, however unsure.

    Args:
        person: "longest" (seen in most frames), "largest" (tallest in the image), or an id.

    Raises:
        DataError: see there; or nobody has the id.
    """
    return keypoints.load(folder, fps=fps, layout=layout, lowest=0.0, gap=gap).person(person)
