"""Chooses where the eye of a scene stands: one direction and distance for all panels, or exactly a pinhole camera's."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyvista as pv
from scipy.ndimage import gaussian_filter1d

from motionlab.motion import Motion
from motionlab.observation import Camera
from motionlab.viz.mannequin import array
from motionlab.viz.palette import side_of

# metres that somebody may be off: in height, of an eye that follows, of one that stands
_UP, _BESIDE, _AROUND = 0.7, 1.2, 2.5
_CLOSEST, _FARTHEST, _ASIDE = 0.3, 2.5, 0.25  # of the distance that was chosen: what a hand may make of it
_NEAR, _FAR = 0.1, 100.0  # metres; 24 bits of depth still tell 1 mm apart at 20 m
_HIGH, _WIDE = np.tan(np.radians((14.0, 17.0)))  # half the view at most: a long lens bends a body little


@dataclass(frozen=True, eq=False)
class Framing:
    """Where the eye of each panel stands; ``tracks`` (T, 3) with their rates where it follows, else (1, 3) of zeros.

    floors: centre (2,) and radius of the piece of floor under each panel.
    """

    towards: np.ndarray
    distance: float
    aspect: float
    targets: Sequence[np.ndarray]
    tracks: list[tuple[np.ndarray, float]]
    floors: list[tuple[np.ndarray, float]]

    def target(self, panel: int, seconds: float) -> np.ndarray:
        """Returns what the eye of a panel looks at (3,) at a time, if no hand has turned it."""
        track, fps = self.tracks[panel]
        return self.targets[panel] + track[int(np.clip(round(seconds * fps), 0, len(track) - 1))]

    def aim(self, eye: pv.Camera, panel: int, seconds: float, hand: tuple[np.ndarray, np.ndarray] | None) -> None:
        """Moves the eye of a panel to where it belongs at a time, or where a hand has put it: as from ``reached``."""
        offset, shift = hand or (self.distance * self.towards, np.zeros(3))
        focal = self.target(panel, seconds) + shift
        eye.position, eye.focal_point, eye.up = focal + offset, focal, (0.0, 0.0, 1.0)
        eye.view_angle = float(np.degrees(2 * np.arctan(_half_angle(self.aspect))))
        eye.clipping_range = max(_NEAR, 0.1 * np.linalg.norm(offset)), 5 * self.distance + 80

    def reached(self, eye: pv.Camera, panel: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Computes where a hand has put an eye: from what it looks at, and that from where it looked, both (3,).

        Not below the floor, and neither nearer, farther nor more to the side than that the subject is seen.
        """
        shift = eye.focal_point - self.target(panel, seconds)
        shift *= min(1.0, _ASIDE * self.distance / max(np.linalg.norm(shift), 1e-9))
        offset = np.subtract(eye.position, eye.focal_point)
        far = np.linalg.norm(offset)
        offset *= np.clip(far / self.distance, _CLOSEST, _FARTHEST) * self.distance / max(far, 1e-9)
        offset[2] = max(offset[2], _NEAR - self.target(panel, seconds)[2] - shift[2])
        return offset, shift


def choose_framing(
    seen: list[list[tuple[np.ndarray, float]]], *, aspect: float, azimuth: float | None, elevation: float,
    left: np.ndarray | None, follow: bool, headroom: float, footroom: float,
) -> Framing:  # fmt: skip
    """Chooses the view of all panels.

    Panels share one target while that costs little distance, so that drift between them shows; motions in
    different places get their own. Who flies off does not make the others small: what is far from where a panel mostly
    is, by metres and by half as much again as in the calmer half of the panels, does not count.

    seen: per panel the paths (T, M, 3) with their frames per second. aspect: width over height of a panel. left: (3,)
    towards the first subject's left, or None.
    """
    paths = [[path for path, _ in panel] for panel in seen]
    moving = [max(panel, key=lambda entry: len(entry[0]), default=(np.zeros((1, 1, 3)), 1.0)) for panel in seen]
    azimuth = good_azimuth(moving[0][0][:, 0], left, aspect) if azimuth is None else azimuth
    a, e = np.radians((azimuth, elevation))  # from +x towards +y; above the floor
    towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    tracks, local = [(np.zeros((1, 3)), 1.0)] * len(seen), paths
    if follow:
        tracks = [(_steady_track(path[:, 0], fps), fps) for path, fps in moving]
        along = zip(paths, tracks, strict=True)
        local = [[path[: len(t)] - t[: len(path), None] for path in some] for some, (t, _) in along]
    off = [_from_home(panel) for panel in local]
    calm = sorted(max(map(np.max, far), default=0.0) for far in off)[(len(off) - 1) // 2]
    room = max(1.5 * calm, _BESIDE if follow else _AROUND)
    near = [[path[far <= room] for path, far in zip(*both, strict=True)] for both in zip(local, off, strict=True)]
    fits = [_fit_view(_around(panel, 0.16), towards, aspect, headroom, footroom) for panel in near]
    targets, distances = zip(*fits, strict=True)
    distance = min(max(distances), 1.2 * sorted(distances)[(len(fits) - 1) // 2] if follow else np.inf)
    together, far = _fit_view(_around([p for panel in near for p in panel], 0.16), towards, aspect, headroom, footroom)
    if far < 1.4 * distance:
        distance, targets = far, (together,) * len(seen)
    under, more = [_around(panel, 0.0)[:, :2] for panel in paths], max(4.0, 0.9 * distance)
    floors = [((at.min(0) + at.max(0)) / 2, min(float(np.ptp(at, axis=0).max() / 2 + more), 40.0)) for at in under]
    return Framing(towards, distance, aspect, targets, tracks, floors)


def left_of(motion: Motion) -> np.ndarray | None:
    """Computes where a motion's left is at the start (3,) from its right and left joints; None without such names."""
    at = motion.positions[0].double().numpy(force=True)
    side = np.array([side_of(name) for name in motion.skeleton.names])
    return None if not {"left", "right"} <= set(side) else at[side == "left"].mean(0) - at[side == "right"].mean(0)


def good_azimuth(path: np.ndarray, left: np.ndarray | None, aspect: float) -> float:
    """Chooses the azimuth in degrees for a motion: across its travel, from the front where the picture is narrow.

    path: (T, 3) of the root. left: (3,) towards the subject's left at the start, or None.
    """
    travel = path[-1, :2] - path[0, :2]
    if np.linalg.norm(travel) > 1.0:
        return float(np.degrees(np.arctan2(travel[1], travel[0]))) - (62.0 if aspect > 1 else 32.0)
    if left is None or np.linalg.norm(left[:2]) < 1e-6:
        return -60.0
    return float(np.degrees(np.arctan2(left[1], left[0]))) - 90.0 - 32.0  # its front, then to its right


def _fit_view(points: np.ndarray, towards: np.ndarray, aspect: float, headroom: float, footroom: float):
    """Target (3,) and distance from which all points (N, 3) are seen, shares of the picture free above and below."""
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    axes = np.stack((right, np.cross(towards, right), towards))
    local = points @ axes.T
    middle = (local.min(0) + local.max(0)) / 2
    half = _half_angle(aspect)
    up, down = half * (1 - 2 * headroom), half * (1 - 2 * footroom)
    for _ in range(4):  # the nearest points spread most: shift the middle until both rooms are what was asked
        x, y, z = (local - middle).T
        above, below = (y / up + z).max(), (-y / down + z).max()
        distance = float(max(above, below, (np.abs(x) / (half * aspect) + z).max()))
        middle[1] += (above - below) / (1 / up + 1 / down)
    return middle @ axes, distance


def _around(paths: list[np.ndarray], pad: float) -> np.ndarray:
    """Points (N, 3) that bound everything seen: at most 150 frames of each path (T, M, 3), grown by ``pad`` metres."""
    sampled = [path[:: len(path) // 150 + 1].reshape(-1, 3) for path in paths]
    points = np.concatenate(sampled) if sampled else np.array([[0.0, 0, 0], [0, 0, 1.7]])
    shell = pad * np.concatenate((np.eye(3), -np.eye(3)))
    grown = (points[:, None] + shell).reshape(-1, 3)
    grown[:, 2] = np.maximum(grown[:, 2], np.minimum(points[:, 2].min(), 0.0))  # no room under the floor
    return grown


def _from_home(paths: list[np.ndarray]) -> list[np.ndarray]:
    """How far what a panel shows is in each frame (T,) from where its longest path mostly is; 0 of what is still."""
    middle = [path.mean(1) for path in paths]
    home = np.median(max(middle, key=len), axis=0) if paths else 0.0
    return [np.linalg.norm(m - home, axis=-1) if len(m) > 1 else np.zeros(1) for m in middle]


def _steady_track(path: np.ndarray, fps: float) -> np.ndarray:
    """The track (T, 3) of an eye that follows a root path (T, 3): its slow part, 0.6 s wide, level while the root is
    within ``_UP`` of its usual height."""
    usual = np.quantile(path[:, 2], 0.1)
    height = path[:, 2] - path[:, 2].clip(usual - _UP, usual + _UP)
    beyond = int(2.4 * fps)  # mirrored through its ends, so that the eye does not lag behind there
    track = np.pad(np.column_stack((path[:, :2], height)), ((beyond, beyond), (0, 0)), "reflect", reflect_type="odd")
    return gaussian_filter1d(track, 0.6 * fps, axis=0)[beyond : beyond + len(path)]


def _half_angle(aspect: float) -> float:
    """Tangent of half the vertical angle of view."""
    return float(min(_HIGH, _WIDE / aspect))


def match_camera(eye: pv.Camera, camera: Camera) -> None:
    """Makes a VTK camera see what a pinhole camera sees: any focal lengths, skew and principal point.

    A pixel (u, v) of a w x h image is x = 2u/w - 1, y = 1 - 2v/h on VTK's screen, whatever its size in pixels, so a
    window of the same shape shows the same picture at any scale. VTK's own view angle knows neither skew nor two focal
    lengths; hence the explicit projection matrix.
    """
    k, r, centre = array(camera.intrinsics), array(camera.rotation), array(camera.centre)
    w, h = camera.width, camera.height
    eye.position, eye.focal_point, eye.up = centre, centre + r[2], -r[1]
    projection = [  # columns: VTK's camera axes, x right, y up, z backward
        [2 * k[0, 0] / w, -2 * k[0, 1] / w, 1 - 2 * k[0, 2] / w, 0],
        [0, 2 * k[1, 1] / h, 2 * k[1, 2] / h - 1, 0],
        [0, 0, -(_FAR + _NEAR) / (_FAR - _NEAR), -2 * _FAR * _NEAR / (_FAR - _NEAR)],
        [0, 0, -1, 0],
    ]
    eye.SetExplicitProjectionTransformMatrix(pv.vtkmatrix_from_array(np.array(projection)))
    eye.UseExplicitProjectionTransformMatrixOn()
    eye.clipping_range = _NEAR, _FAR
