"""What a fit sees, as batches: 3-D joints or 2-D keypoints with a weight each, and the camera they were seen by.

Nothing that is missing carries a number: NaN, infinite and undetected entries become zeros of weight zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.observation import BODY_25, Camera, Observation2D, look_at
from motionlab.skeleton import STANDARD

_SIZES = ((640, 480), (1280, 720), (1920, 1080), (3840, 2160))  # one is assumed that holds every detection
#: Camera axes (right, down, forward) of a level camera that looks along the world's +y: rows.
LEVEL = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
ASSUMED_HEIGHT = 1.2  # metres above the floor, of a camera of which nothing is known

FEET_SEEN = 0.2  # share of the frames below which a clip does not show the feet
_FEET = [k for k, name in enumerate(BODY_25) if name.endswith(("ankle", "toe", "heel"))]
UNSEEN = 0.03  # what stage 2 makes of a hidden joint counts so much, beside a seen one, in the start of stage 3


def _shown(joint: str) -> list[int]:
    """Three keypoints of BODY_25, any of which shows a joint."""
    side, _, part = joint.rpartition("_")
    if not side:
        found = "nose left_ear right_ear" if part in ("head", "neck") else "mid_hip left_shoulder right_shoulder"
        return [BODY_25.index(name) for name in found.split()]
    near = {"hip": "knee", "foot": "big_toe", "collar": "shoulder"}
    return [BODY_25.index(f"{side}_{near.get(part, part)}")] * 3


_SHOWN = torch.tensor([_shown(name) for name in STANDARD.names])


def feet_seen(confidence: Tensor) -> Tensor:
    """Computes in which share of the frames, of those that show anything, a foot was seen: (...), from confidences
    (..., T, 25) of BODY_25 as numbers from 0 to 1."""
    there = (confidence > 0).any(-1).sum(-1)
    return confidence[..., _FEET].amax(-1).sum(-1) / there.clamp(min=1)


@dataclass(frozen=True, eq=False)
class Observation3D:
    """Joint positions through time, some of them unknown.

    points (B, T, 22, 3) or (T, 22, 3): metres, world, z up; anything (NaN too) where not visible.
    visible (B, T, 22) or (T, 22), bool. fps: frames per second.

    Raises:
        ShapeError: the arrays do not fit each other, or fps is not positive.
    """

    points: Tensor
    visible: Tensor
    fps: float = 30.0
    name: str = ""

    def __post_init__(self) -> None:
        check_shape(self.points, "... T 22 3", "points")
        check_shape(self.visible, self.points.shape[:-1], "visible")
        if not 0 < self.fps < float("inf"):
            raise ShapeError(f"fps: expected a positive number, got {self.fps}")

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return self.points.shape[-3]


@dataclass(frozen=True, eq=False)
class View:
    """Static cameras of B clips, and the frame of reference that the unknown floor is described from.

    x_cam = turn R (x_world - centre - (0, 0, rise)), where turn is the rotation by (tilt, 0, roll) about the camera's
    axes: the three unknown numbers that stand for HuMoR's floor plane. free: whether they are unknown at all.

    intrinsics (B, 3, 3): pixels. rotation (B, 3, 3): camera from world. centre (B, 3): metres, world.
    """

    intrinsics: Tensor
    rotation: Tensor
    centre: Tensor
    size: tuple[int, int]
    free: bool

    def moved(self, change: Tensor) -> tuple[Tensor, Tensor]:
        """Computes rotation (B, 3, 3) and centre (B, 3) after a change (B, 3): tilt, roll, radians, rise, m."""
        tilt, roll, rise = change.unbind(-1)
        o = torch.zeros_like(tilt)
        turned = rotation.exp(torch.stack((tilt, o, roll), -1)) @ self.rotation
        return turned, self.centre + torch.stack((o, o, rise), -1)

    def pixels(self, points: Tensor, change: Tensor) -> Tensor:
        """Computes pixels (B, T, K, 2) of world points (B, T, K, 3); those behind the camera land far outside."""
        turn, centre = self.moved(change)
        local = (points - centre[:, None, None]) @ turn[:, None].mT
        on_plane = local[..., :2] / local[..., 2:].clamp(min=0.05)
        k = self.intrinsics[:, None, None]
        return on_plane * torch.stack((k[..., 0, 0], k[..., 1, 1]), -1) + k[..., :2, 2]

    def floor(self, change: Tensor) -> Tensor:
        """Computes the floor's point (B, 3) nearest to the camera, camera axes, metres: normal times offset."""
        turn, centre = self.moved(change)
        return -turn[:, :, 2] * centre[:, 2:]

    def cameras(self, change: Tensor) -> list[Camera]:
        """Returns one camera per clip, as ``observation.project`` takes them."""
        turn, centre = self.moved(change)
        shift = -(turn @ centre[..., None])[..., 0]
        return [Camera(*each, *self.size) for each in zip(self.intrinsics, turn, shift, strict=True)]

    def rows(self, index: Tensor) -> Self:
        """Returns the cameras of some clips, in the order of ``index``."""
        return replace(self, **{name: getattr(self, name)[index] for name in ("intrinsics", "rotation", "centre")})


@dataclass(frozen=True, eq=False)
class Evidence:
    """An observation ready for the energies: values (B, T, K, D), zero where the weight (B, T, K) is zero.

    K, D = 22, 3 (joints in the world) without a view; 25, 2 (pixels of BODY_25, the weight a confidence) with one.
    """

    values: Tensor
    weight: Tensor
    fps: float
    view: View | None = None
    notes: tuple[str, ...] = ()

    def rows(self, index: Tensor) -> Self:
        """Returns the evidence of some clips, in the order of ``index``."""
        view = self.view and self.view.rows(index)
        return replace(self, values=self.values[index], weight=self.weight[index], view=view)

    @property
    def confidence_per_joint(self) -> Tensor:
        """Computes how far each joint (B, T, 22) was observed: 1 seen, ``UNSEEN`` hidden, 0 in empty frames."""
        seen = self.weight > 0 if self.view is None else (self.weight > 0)[..., _SHOWN].any(-1)
        return torch.where(seen, 1.0, UNSEEN) * (self.weight > 0).any(-1, keepdim=True)

    @property
    def hides_feet(self) -> Tensor:
        """Computes whether a clip (B,) does not show its feet: keypoints alone, and of feet next to none."""
        if self.view is None:
            return torch.zeros(len(self.weight), dtype=torch.bool, device=self.weight.device)
        return feet_seen(self.weight) < FEET_SEEN

    def first_frames(self, frames: int) -> Self:
        """Returns the first frames."""
        return replace(self, values=self.values[:, :frames], weight=self.weight[:, :frames])


def evidence(
    observation: Observation2D | Observation3D, *, cameras: Sequence[Camera] | None = None, floor: str | None = None,
    size: tuple[int, int] | None = None,
) -> Evidence:  # fmt: skip
    """Computes a batch of evidence from either kind of observation; a clip without a batch axis gets one.

    Args:
        cameras: one per clip, instead of the observation's own.
        floor: 2-D only. "camera" (where there is one): the camera's pose in the world is known and with it the floor;
            "refine": it is a first guess; "guess": only the intrinsics are known, the camera is taken as level.
        size: width and height of the image in pixels, where no camera says.

    Raises:
        DataError: no known keypoint name, no frames, or a camera was asked for that is not there.
        ShapeError: as many cameras as clips were expected.
    """
    if isinstance(observation, Observation3D):
        points, visible = _batched(observation.points, 4), _batched(observation.visible, 3)
        weight = (visible.bool() & points.isfinite().all(-1)).to(points)
        return Evidence(torch.where(weight[..., None] > 0, points, 0.0), weight, observation.fps)
    keypoints, confidence = _batched(observation.keypoints, 4), _batched(observation.confidence, 3)
    values, weight, notes = _as_body_25(keypoints, confidence, observation.names)
    given = list(cameras) if cameras is not None else [observation.camera] * len(values)
    if len(given) != len(values):
        raise ShapeError(f"cameras: expected one for each of {len(values)} clips, got {len(given)}")
    floor = floor or ("guess" if given[0] is None else "camera")
    if floor not in ("camera", "refine", "guess"):
        raise ValueError(f'floor: expected "camera", "refine" or "guess", got {floor!r}')
    if given[0] is None:
        if floor != "guess":
            raise DataError(f'floor="{floor}" needs a camera', remedy='give a camera, or floor="guess"')
        camera, note = _assumed_camera(values, weight, size)
        given, notes = [camera] * len(values), (*notes, note)
    k, turn, shift = (
        torch.stack([getattr(c, n) for c in given]).to(values) for n in ("intrinsics", "rotation", "translation")
    )
    centre = -(turn.mT @ shift[..., None])[..., 0]
    if floor == "guess":
        turn = LEVEL.to(values).expand(len(values), 3, 3)
        centre = values.new_tensor([0.0, 0.0, ASSUMED_HEIGHT]).expand(len(values), 3)
    view = View(k, turn, centre, (given[0].width, given[0].height), floor != "camera")
    return Evidence(values, weight, observation.fps, view, notes)


def _assumed_camera(values: Tensor, weight: Tensor, size: tuple[int, int] | None) -> tuple[Camera, str]:
    """A level camera whose focal length is the image's diagonal (53 degrees across it), and a sentence that says so."""
    extent = torch.where(weight[..., None] > 0, values, 0.0).amax((0, 1, 2)).tolist()
    fits = [s for s in _SIZES if s[0] >= extent[0] and s[1] >= extent[1]]
    width, height = size or (fits[0] if fits else tuple(int(e) + 1 for e in extent))
    focal = (width**2 + height**2) ** 0.5
    eye, ahead = torch.tensor([[0.0, 0.0, ASSUMED_HEIGHT], [0.0, 1.0, ASSUMED_HEIGHT]])
    guessed = "" if size else ", the size guessed from the detections"
    note = f"camera assumed: focal length {focal:.0f} px for an image of {width} x {height}{guessed}"
    return look_at(eye, ahead, focal=focal, width=width, height=height), note


def _batched(x: Tensor, axes: int) -> Tensor:
    if x.ndim not in (axes - 1, axes):
        raise ShapeError(f"expected {axes - 1} or {axes} axes (one batch axis of clips), got {tuple(x.shape)}")
    x = x if x.ndim == axes else x[None]
    if 0 in x.shape[:2]:
        raise DataError("no clip or no frame to fit", remedy="give at least one frame")
    return x


def _as_body_25(keypoints: Tensor, confidence: Tensor, names: Sequence[str]) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """Values (B, T, 25, 2), weights (B, T, 25) in BODY_25's order, and which keypoints went unused."""
    known = [name for name in names if name in BODY_25]
    if not known:
        what = f"no keypoint of BODY_25 among {', '.join(names)}"
        raise DataError(what, remedy="rename them; see observation.BODY_25")
    ours, theirs = [BODY_25.index(n) for n in known], [names.index(n) for n in known]
    values, weight = keypoints.new_zeros(*keypoints.shape[:2], 25, 2), keypoints.new_zeros(*keypoints.shape[:2], 25)
    values[..., ours, :], weight[..., ours] = keypoints[..., theirs, :], confidence[..., theirs].to(keypoints)
    weight[..., list(UNUSED_BODY_25)] = 0.0
    good = values.isfinite().all(-1) & weight.isfinite() & (weight > 0)
    unused = [name for name in names if name not in BODY_25]
    notes = (f"keypoints that the body has none of: {', '.join(unused)}",) if unused else ()
    return torch.where(good[..., None], values, 0.0), torch.where(good, weight, 0.0), notes
