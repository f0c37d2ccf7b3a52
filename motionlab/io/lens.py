"""Lens distortion, OpenCV's model: from what a lens drew to what a pinhole would have, keypoints and pictures.

With x, y on the plane at depth one and r^2 = x^2 + y^2,

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Source: OpenCV's calib3d, whose order of the coefficients is k1 k2 p1 p2 k3 k4 k5 k6.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from motionlab.observation import Camera

_ROUNDS = 100
_EXACT = 0.05  # pixels by which a point may be missed


def distorted(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Computes where the camera's lens puts what a pinhole would put at pixels (..., 2)."""
    k, plane = _plane(pixels, camera)
    return _bent(plane, camera.distortion) * k[0] + k[1]


def undistorted(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Computes where a pinhole would put what the camera's lens put at pixels (..., 2); NaN where nothing comes there.

    By fixed-point steps, from the point itself, each as far as it brings the point nearer.
    """
    k, goal = _plane(pixels, camera)
    found, step = goal.copy(), np.ones(goal.shape[:-1])
    miss = goal - _bent(found, camera.distortion)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(_ROUNDS):
            tried = found + step[..., None] * miss
            now = goal - _bent(tried, camera.distortion)
            nearer = np.linalg.norm(now, axis=-1) < np.linalg.norm(miss, axis=-1)
            found, miss = (np.where(nearer[..., None], new, old) for new, old in ((tried, found), (now, miss)))
            step = np.where(nearer, np.minimum(2 * step, 1), step / 2)
    exact = np.linalg.norm(miss * k[0], axis=-1) < _EXACT
    return np.where(exact[..., None], found * k[0] + k[1], np.nan)


def straight(pictures: Iterable[np.ndarray], camera: Camera) -> Iterator[np.ndarray]:
    """Yields pictures (H, W, 3) as a pinhole would have taken them, by the nearest pixel; black where there is none."""
    at = None
    for picture in pictures:
        high, wide = picture.shape[:2]
        if at is None or at[0].shape != (high, wide):
            scale = np.array([camera.width / wide, camera.height / high])
            there = np.stack(np.meshgrid(np.arange(wide), np.arange(high)), -1)
            from_ = np.nan_to_num(distorted(there * scale, camera) / scale, nan=-1.0, posinf=-1.0, neginf=-1.0)
            x, y = from_.round().clip(-1, max(high, wide)).astype(int).transpose(2, 0, 1)
            inside = (x >= 0) & (x < wide) & (y >= 0) & (y < high)
            at = inside, y.clip(0, high - 1), x.clip(0, wide - 1)
        yield np.where(at[0][..., None], picture[at[1], at[2]], np.uint8(0))


def _plane(pixels: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Focal lengths and centre (2, 2), and points (..., 2) on the plane at depth one."""
    m = camera.intrinsics.double().numpy()
    k = np.array([[m[0, 0], m[1, 1]], [m[0, 2], m[1, 2]]])
    return k, (np.asarray(pixels, float) - k[1]) / k[0]


def _bent(plane: np.ndarray, coefficients: Sequence[float]) -> np.ndarray:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *(0.0,) * (8 - len(coefficients)))
    x, y = plane[..., 0], plane[..., 1]
    r = x * x + y * y
    share = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
    return np.stack(
        (x * share + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * share + p1 * (r + 2 * y * y) + 2 * p2 * x * y), -1
    )
