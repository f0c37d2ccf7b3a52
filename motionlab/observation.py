"""What a fit is given: a camera and 2-D keypoints with confidence, never the true motion."""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from kornia.geometry.camera import project_points
from torch import Tensor

from motionlab.errors import ShapeError, check_shape
from motionlab.motion import FPS


def at_rate(observation: "Observation2D", *, times: np.ndarray | None = None) -> "Observation2D":
    """Computes keypoints at 30 frames a second: linear where both frames saw the point, else the nearer frame's.

    The first frame stays; no sample lies behind the last. times (T,): seconds of uneven frames since the first.
    """
    last = (observation.frames - 1) / observation.fps if times is None else float(times[-1])
    count = int(last * FPS + 1e-6) + 1
    at = torch.arange(count, dtype=torch.float64) * (observation.fps / FPS)
    if times is not None:
        at = torch.from_numpy(np.interp(np.arange(count) / FPS, times, np.arange(len(times), dtype=float)))
    low = (at + 1e-6).floor().long().clamp(max=observation.frames - 1)
    high = (low + 1).clamp(max=observation.frames - 1)
    share = (at - low).clamp(min=0).to(observation.keypoints)[:, None]  # (T, 1) before keypoints
    a, b = (observation.keypoints[..., at, :, :] for at in (low, high))
    p, q = (observation.confidence[..., at, :] for at in (low, high))
    both, later = (p > 0) & (q > 0) & (share > 1e-5), share > 0.5
    points = torch.where(both[..., None], torch.lerp(a, b, share[..., None]), torch.where(later[..., None], b, a))
    confidence = torch.where(both, torch.lerp(p, q, share), torch.where(later, q, p))
    return replace(observation, keypoints=points, confidence=confidence, fps=FPS)


#: OpenPose's keypoints in its order.
BODY_25 = (
    "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist",
    "mid_hip", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "right_eye",
    "left_eye", "right_ear", "left_ear", "left_big_toe", "left_small_toe", "left_heel", "right_big_toe",
    "right_small_toe", "right_heel",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Camera:
    """A static pinhole camera.

    x_cam = rotation x_world + translation; pixel = K x_cam / z_cam. Camera axes: x right, y down, z forward.

    intrinsics (3, 3): pixels. rotation (3, 3): camera from world. translation (3,): metres.
    width, height: image size in pixels. distortion: of the lens that took the images, none or OpenCV's coefficients;
    a pinhole knows nothing of it: ``io.cameras`` takes it out of keypoints and pictures.
    """

    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_shape(self.intrinsics, "3 3", "intrinsics")
        check_shape(self.rotation, "3 3", "rotation")
        check_shape(self.translation, "3", "translation")

    @property
    def centre(self) -> Tensor:
        """Position (3,) of the camera, metres, world."""
        return -self.rotation.mT @ self.translation

    def to(self, *args, **kwargs) -> Self:
        """Returns the camera on another device or of another dtype."""
        moved = {k: getattr(self, k).to(*args, **kwargs) for k in ("intrinsics", "rotation", "translation")}
        return replace(self, **moved)


def look_at(eye: Tensor, target: Tensor, *, focal: float, width: int, height: int) -> Camera:
    """Computes the camera at ``eye`` (3,) that looks at ``target`` (3,), world z up in the image; focal in pixels.

    Raises:
        ShapeError: eye and target coincide, or the view is vertical and has no horizon.
    """
    forward = target - eye
    up = torch.tensor([0.0, 0.0, 1.0]).to(eye)
    right = torch.linalg.cross(forward, up)
    if forward.norm() == 0 or right.norm() < 1e-6 * forward.norm():
        raise ShapeError(f"look_at: no horizon for a view from {eye.tolist()} to {target.tolist()}")
    forward, right = forward / forward.norm(), right / right.norm()
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]).to(eye)
    return Camera(intrinsics, rotation, -rotation @ eye, width, height)


def project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Projects world points (..., 3) to pixels (..., 2) and depths (...) in metres; depths <= 0 lie behind it."""
    check_shape(points, "... 3", "points")
    camera = camera.to(points)
    local = points @ camera.rotation.mT + camera.translation
    flat = local.reshape(-1, 3)  # kornia takes no single point
    pixels = project_points(flat, camera.intrinsics.expand(len(flat), 3, 3))
    return pixels.reshape(*local.shape[:-1], 2), local[..., 2]


@dataclass(frozen=True, eq=False)
class Observation2D:
    """Detected 2-D keypoints through time.

    keypoints (..., T, K, 2): pixels, origin in the upper left corner, y down.
    confidence (..., T, K): 0 (not detected, whatever the coordinates say) to 1.
    names: the K keypoints. fps: frames per second. camera: None where it is not known.

    Raises:
        ShapeError: the arrays do not fit the names or each other, or fps is not positive.
    """

    keypoints: Tensor
    confidence: Tensor
    names: tuple[str, ...]
    fps: float
    camera: Camera | None = None
    name: str = ""

    def __post_init__(self) -> None:
        check_shape(self.keypoints, f"... T {len(self.names)} 2", "keypoints")
        check_shape(self.confidence, self.keypoints.shape[:-1], "confidence")
        if not 0 < self.fps < math.inf:
            raise ShapeError(f"fps: expected a positive number, got {self.fps}")

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return self.keypoints.shape[-3]

    @property
    def visible(self) -> Tensor:
        """Mask (..., T, K): True where the keypoint was detected."""
        return self.confidence > 0

    def index(self, name: str) -> int:
        """Returns the index of a keypoint by name; KeyError lists the names."""
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(f"no keypoint {name!r}; keypoints are {', '.join(self.names)}") from None
