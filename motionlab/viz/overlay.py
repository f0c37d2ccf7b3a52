"""Detected keypoints drawn over a picture; what the detector doubts is faint."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from motionlab.errors import ShapeError
from motionlab.observation import Observation2D
from motionlab.viz.palette import colour, side_of, sides

_ARMS_LEGS = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"), ("ankle", "heel"),
                 ("ankle", "big_toe"), ("big_toe", "small_toe"), ("eye", "ear"))
]  # fmt: skip
_MIDDLE = [("neck", "mid_hip"), ("nose", "neck"), ("nose", "left_eye"), ("nose", "right_eye")]
_WITH_NECK = [("neck", "left_shoulder"), ("neck", "right_shoulder"), ("mid_hip", "left_hip"), ("mid_hip", "right_hip")]
_WITHOUT = [("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"), ("left_shoulder", "left_hip"),
            ("right_shoulder", "right_hip")]  # fmt: skip
_FINE = 2  # drawn twice as large and reduced: smooth edges


def limbs(names: tuple[str, ...]) -> list[tuple[int, int]]:
    """The keypoints to join, for BODY_25, BODY_25B and COCO alike: pairs of indices whose names are all there."""
    torso = _WITH_NECK if {"neck", "mid_hip"} <= set(names) else _WITHOUT
    return [(names.index(a), names.index(b)) for a, b in _ARMS_LEGS + _MIDDLE + torso if a in names and b in names]


def overlay(
    observation: Observation2D, picture, frame: int, role: str | tuple = "stage2", width: float = 4.0
) -> np.ndarray:
    """A picture (H, W, 3) uint8 with one frame of keypoints on it: confidence is opacity, left light, right dark.

    Args:
        picture: (H, W, 3) uint8 of the observation's camera at any scale; without a camera its
            pixels are the observation's.
        width: of a limb, pixels of the picture.

    Raises:
        ShapeError: a batch of observations. IndexError: no such frame.
    """
    if observation.keypoints.ndim != 3:
        raise ShapeError(f"observation: expected one (T, K, 2), got {tuple(observation.keypoints.shape)}")
    if not -observation.frames <= frame < observation.frames:
        raise IndexError(f"frame {frame}: the observation has {observation.frames}")
    image = Image.fromarray(np.asarray(picture, np.uint8))
    scale = _FINE * (image.width / observation.camera.width if observation.camera else 1.0)
    at = observation.keypoints[frame].double().numpy(force=True) * scale
    confidence = observation.confidence[frame].double().numpy(force=True).clip(0, 1)
    tones = {side: tuple(round(255 * c) for c in tone) for side, tone in sides(colour(role)).items()}
    layer = Image.new("RGBA", (image.width * _FINE, image.height * _FINE))
    pen, wide = ImageDraw.Draw(layer), width * _FINE

    def ink(strength: float, names: list[str]) -> tuple[int, ...]:
        side = next((side_of(n) for n in names if side_of(n) != "middle"), "middle")
        return (*tones[side], round(255 * strength))

    for a, b in limbs(observation.names):
        strength = min(confidence[a], confidence[b])
        if strength > 0:
            ends = [tuple(at[a]), tuple(at[b])]
            pen.line(ends, fill=(255, 255, 255, round(210 * strength)), width=round(1.7 * wide))
            pen.line(ends, fill=ink(strength, [observation.names[a], observation.names[b]]), width=round(wide))
    for k in np.flatnonzero(confidence > 0):
        for radius, fill in ((1.15, (255, 255, 255, round(230 * confidence[k]))),
                             (0.8, ink(confidence[k], [observation.names[k]]))):  # fmt: skip
            pen.circle(tuple(at[k]), radius * wide, fill=fill)
    return np.asarray(Image.alpha_composite(image.convert("RGBA"), layer.reduce(_FINE)).convert("RGB"))
