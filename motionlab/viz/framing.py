"""Framing: one direction and distance for all panels of a scene, from everything that will be seen in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyvista as pv

from motionlab.viz import view, viewpoint


@dataclass(frozen=True, eq=False)
class Frame:
    """Where the eye of each panel stands; ``tracks`` (T, 3) with their rates where it follows, else empty.

    centres and radii: the piece of floor under each panel.
    """

    towards: np.ndarray
    distance: float
    aspect: float
    targets: list[np.ndarray]
    tracks: list[tuple[np.ndarray, float]]
    centres: list[np.ndarray]
    radii: list[float]

    def aim(self, eye: pv.Camera, panel: int, seconds: float) -> None:
        """Stand the eye of a panel where it belongs at a time."""
        target = self.targets[panel]
        if self.tracks:
            track, fps = self.tracks[panel]
            target = target + track[int(np.clip(round(seconds * fps), 0, len(track) - 1))]
        view.aim(eye, target, self.towards, self.distance, self.aspect)


def frame(
    seen: list[list[tuple[np.ndarray, float]]],
    *,
    aspect: float,
    azimuth: float | None,
    elevation: float,
    left: np.ndarray | None,
    follow: bool,
    headroom: float,
    footroom: float,
) -> Frame:
    """Choose the view of all panels.

    Panels share one target while that costs little distance, so that drift between them shows; motions in
    different places get their own.

    Args:
        seen: per panel the paths (T, M, 3) with their frames per second.
        aspect: width over height of a panel. left: (3,) towards the first subject's left, or None.
    """
    paths = [[path for path, _ in panel] for panel in seen]
    moving = [max(panel, key=lambda entry: len(entry[0]), default=(np.zeros((1, 1, 3)), 1.0)) for panel in seen]
    azimuth = viewpoint.good_azimuth(moving[0][0][:, 0], left, aspect) if azimuth is None else azimuth
    towards = viewpoint.direction(azimuth, elevation)
    tracks = []
    if follow:
        tracks = [(viewpoint.steady(path[:, 0], fps), fps) for path, fps in moving]
        local = [[path[: len(t)] - t[: len(path), None]] for (path, _), (t, _) in zip(moving, tracks, strict=True)]
    else:
        local = paths
    fits = [viewpoint.fit(viewpoint.around(panel, 0.16), towards, aspect, headroom, footroom) for panel in local]
    distance = max(d for _, d in fits)
    targets = [target for target, _ in fits]
    together, far = viewpoint.fit(
        viewpoint.around([p for panel in local for p in panel], 0.16), towards, aspect, headroom, footroom
    )
    if follow or far < 1.4 * distance:
        distance, targets = far, [together] * len(seen)
    floors = [viewpoint.around(panel, 0.0)[:, :2] for panel in paths]
    centres = [(floor.min(0) + floor.max(0)) / 2 for floor in floors]
    reach = [np.ptp(floor, axis=0).max() / 2 for floor in floors]
    radii = [min(float(r + max(4.0, 0.9 * distance)), 40.0) for r in reach]
    return Frame(towards, distance, aspect, targets, tracks, centres, radii)
