"""Keypoints drawn over what a camera filmed."""

import numpy as np
from PIL import Image, ImageDraw

from motionlab.observation import Observation2D
from motionlab.viz.palette import ROLE, side_of, sides

_ARMS_LEGS = [(f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in (
    ("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"), ("ankle", "heel"),
    ("ankle", "big_toe"), ("big_toe", "small_toe"), ("eye", "ear"))]  # fmt: skip
_MIDDLE = [("neck", "mid_hip"), ("nose", "neck"), ("nose", "left_eye"), ("nose", "right_eye"),
           ("neck", "left_shoulder"), ("neck", "right_shoulder"), ("mid_hip", "left_hip"),
           ("mid_hip", "right_hip")]  # fmt: skip
_FINE = 2  # drawn twice as large and reduced: smooth edges


def overlay(observation: Observation2D, picture: np.ndarray, frame: int, width: float) -> np.ndarray:
    """Draws one frame of BODY_25 (T, 25, 2) over a picture (H, W, 3) uint8: confidence is opacity, left light.

    picture: of the observation's camera at any scale; without a camera its pixels are the observation's. width: of a
    limb, pixels of the picture.
    """
    image, names = Image.fromarray(picture), observation.names
    scale = _FINE * (image.width / observation.camera.width if observation.camera else 1.0)
    at = [tuple(x) for x in observation.keypoints[frame].double().numpy(force=True) * scale]
    confidence = observation.confidence[frame].double().numpy(force=True).clip(0, 1)
    tones = {side: tuple(round(255 * c) for c in tone) for side, tone in sides(ROLE["observation"]).items()}
    layer = Image.new("RGBA", (image.width * _FINE, image.height * _FINE))
    pen, wide = ImageDraw.Draw(layer), width * _FINE

    def ink(strength: float, *names: str) -> tuple[int, ...]:
        side = next((side_of(n) for n in names if side_of(n) != "middle"), "middle")
        return (*tones[side], round(255 * strength))

    for ends in [ends for ends in _ARMS_LEGS + _MIDDLE if set(ends) <= set(names)]:
        a, b = map(names.index, ends)
        strength = min(confidence[a], confidence[b])
        if strength > 0:
            pen.line([at[a], at[b]], fill=(255, 255, 255, round(210 * strength)), width=round(1.7 * wide))
            pen.line([at[a], at[b]], fill=ink(strength, *ends), width=round(wide))
    for k in np.flatnonzero(confidence > 0):
        pen.circle(at[k], 1.15 * wide, fill=(255, 255, 255, round(230 * confidence[k])))
        pen.circle(at[k], 0.8 * wide, fill=ink(confidence[k], names[k]))
    return np.asarray(Image.alpha_composite(image.convert("RGBA"), layer.reduce(_FINE)).convert("RGB"))
