"""From where to look: direction, distance and target, from the points that must be seen. Plain geometry."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from motionlab.motion import Motion
from motionlab.viz.palette import side_of

_HIGH, _WIDE = np.tan(np.radians((14.0, 17.0)))  # half the view at most: a long lens bends a body little


def half_angle(aspect: float) -> float:
    """Tangent of half the vertical angle of view."""
    return float(min(_HIGH, _WIDE / aspect))


def left_of(motion: Motion) -> np.ndarray | None:
    """From the middle of the right joints to that of the left ones at the start (3,); None without such names."""
    at = motion.positions[0].double().numpy(force=True)
    side = np.array([side_of(name) for name in motion.skeleton.names])
    if not {"left", "right"} <= set(side):
        return None
    return at[side == "left"].mean(0) - at[side == "right"].mean(0)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Unit vector from the subject to the eye; azimuth in degrees from +x towards +y, elevation above the floor."""
    a, e = np.radians((azimuth, elevation))
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def good_azimuth(path: np.ndarray, left: np.ndarray | None, aspect: float) -> float:
    """Degrees from which a motion is well seen: across its travel, from the front if the picture is narrow or it stays.

    Args:
        path: (T, 3) of the root. left: (3,) towards the subject's left at the start, or None.
    """
    travel = path[-1, :2] - path[0, :2]
    if np.linalg.norm(travel) > 1.0:
        return float(np.degrees(np.arctan2(travel[1], travel[0]))) - (62.0 if aspect > 1 else 32.0)
    if left is None or np.linalg.norm(left[:2]) < 1e-6:
        return -60.0
    return float(np.degrees(np.arctan2(left[1], left[0]))) - 90.0 - 32.0  # its front, then to its right


def fit(
    points: np.ndarray, towards: np.ndarray, aspect: float, headroom: float, footroom: float
) -> tuple[np.ndarray, float]:
    """Target (3,) and distance from which all points (N, 3) are seen, shares of the picture free above and below."""
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    axes = np.stack((right, np.cross(towards, right), towards))
    local = points @ axes.T
    middle = (local.min(0) + local.max(0)) / 2
    half = half_angle(aspect)
    up, down = half * (1 - 2 * headroom), half * (1 - 2 * footroom)
    for _ in range(4):  # the nearest points spread most: shift the middle until both rooms are what was asked
        x, y, z = (local - middle).T
        above, below = (y / up + z).max(), (-y / down + z).max()
        distance = float(max(above, below, (np.abs(x) / (half * aspect) + z).max()))
        middle[1] += (above - below) / (1 / up + 1 / down)
    return middle @ axes, distance


def around(paths: list[np.ndarray], pad: float) -> np.ndarray:
    """Points (N, 3) that bound everything seen: at most 150 frames of each path (T, M, 3), grown by ``pad`` metres."""
    sampled = [path[:: len(path) // 150 + 1].reshape(-1, 3) for path in paths]
    points = np.concatenate(sampled) if sampled else np.array([[0.0, 0, 0], [0, 0, 1.7]])
    shell = pad * np.concatenate((np.eye(3), -np.eye(3)))
    grown = (points[:, None] + shell).reshape(-1, 3)
    grown[:, 2] = np.maximum(grown[:, 2], np.minimum(points[:, 2].min(), 0.0))  # no room under the floor
    return grown


def steady(path: np.ndarray, fps: float) -> np.ndarray:
    """The track (T, 3) of an eye that follows a root path (T, 3): its slow horizontal part, 0.6 s wide."""
    track = gaussian_filter1d(path, 0.6 * fps, axis=0, mode="nearest")
    track[:, 2] = 0.0
    return track
