"""Lens distortion, OpenCV's model: from what a lens drew to what a pinhole would have, keypoints and pictures.

Of its coefficients k1 k2 p1 p2 k3 k4 k5 k6 those that a camera leaves out are 0; see ``kornia``'s ``distort_points``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import torch
from kornia.geometry.calibration import distort_points

from motionlab.observation import Camera

_ROUNDS = 100
_EXACT = 0.05  # pixels by which a point may be missed


def distorted(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Computes where the camera's lens puts what a pinhole would put at pixels (..., 2)."""
    lens = torch.zeros(8, dtype=torch.float64)
    lens[: len(camera.distortion)] = torch.tensor(camera.distortion, dtype=torch.float64)
    points = torch.from_numpy(pixels).double()
    return distort_points(points.reshape(-1, 2), camera.intrinsics.double(), lens).reshape(points.shape).numpy()


def undistorted(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Computes where a pinhole would put what the camera's lens put at pixels (..., 2); NaN where nothing comes there.

    By fixed-point steps, from the point itself, each as far as it brings the point nearer.
    """
    found, step = pixels.astype(float), np.ones(pixels.shape[:-1])
    with np.errstate(over="ignore", invalid="ignore"):
        miss = pixels - distorted(found, camera)
        for _ in range(_ROUNDS):
            tried = found + step[..., None] * miss
            now = pixels - distorted(tried, camera)
            nearer = np.linalg.norm(now, axis=-1) < np.linalg.norm(miss, axis=-1)
            found, miss = (np.where(nearer[..., None], new, old) for new, old in ((tried, found), (now, miss)))
            step = np.where(nearer, np.minimum(2 * step, 1), step / 2)
    return np.where(np.linalg.norm(miss, axis=-1, keepdims=True) < _EXACT, found, np.nan)


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
