"""What goes wrong between a person and a detection: each failure returns the corrupted value and a mask.

The mask is True exactly where the value differs from the original, which is never changed. A keypoint
that becomes undetected gets confidence 0 and, as OpenPose writes it, pixel (0, 0). Failures come in runs:
``share`` is the expected share of frames (or of keypoints) that are touched, ``length`` the frames that
one run lasts. Failures compose: feed the value of one to the next.

Source: thesis 1 and 3.2.3 (two legs for one, joints flipping, confident but false predictions, a frame
without predictions); HuMoR (Rempe et al. 2021, 5.2: keypoints below 0.9 m hidden).
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab.observation import Observation2D

#: The keypoints of a leg below the hip, without their side.
LEG = ("knee", "ankle", "big_toe", "small_toe", "heel")
Spoilt = tuple[Observation2D, Tensor]  # and the mask of what changed


def occlude_below(observation: Observation2D, points: Tensor, height: float = 0.9) -> Spoilt:
    """Hide every keypoint whose true place, ``points`` (..., T, K, 3) in metres, lies below ``height`` metres."""
    return _hide(observation, points[..., 2] < height)


def drop_frames(observation: Observation2D, frames: Iterable[int]) -> Spoilt:
    """Nothing detected at all in the given frames; negative ones count from the end."""
    mask = torch.zeros_like(observation.visible)
    mask[..., list(frames), :] = True
    return _hide(observation, mask)


def flip_limbs(observation: Observation2D, generator: torch.Generator, share: float, length: int) -> Spoilt:
    """Left and right leg change places, confidence and all, in runs of frames."""
    left, right = _legs(observation)
    swapped = torch.arange(len(observation.names))
    swapped[left], swapped[right] = torch.tensor(right), torch.tensor(left)
    frames = _runs(observation.confidence.shape[:-1], share, length, generator)
    mask = frames[..., None] & (swapped != torch.arange(len(swapped)))
    return _put(observation, observation.keypoints[..., swapped, :], observation.confidence[..., swapped], mask)


def two_legs_from_one(observation: Observation2D, generator: torch.Generator, lead: int = 10) -> Spoilt:
    """A hidden leg is predicted on the visible one, with its confidence: the failure of Fig. 3.3.

    It strikes wherever one leg is seen (knee and ankle) and the other is not, and in the ``lead`` frames
    before a leg vanishes. Where both legs vanish together a coin per clip chooses which becomes the copy.
    The copy keeps a steady offset of about a tenth of a shank's length and trembles by a third of that;
    its confidence is the visible leg's times a number from 0.8 to 1.

    Source: thesis 3.2.3, Fig. 3.3.
    """
    legs, shin = _legs(observation), [LEG.index("knee"), LEG.index("ankle")]
    seen = [observation.visible[..., [leg[i] for i in shin]].all(-1) for leg in legs]
    copied = [seen[1 - s] & (~seen[s] | _before_it_vanishes(seen[s], lead)) for s in (0, 1)]
    coin = torch.rand(*seen[0].shape[:-1], 1, generator=generator) < 0.5
    copied = [copied[0] & ~(copied[1] & coin), copied[1] & ~(copied[0] & ~coin)]

    keypoints, confidence = observation.keypoints.clone(), observation.confidence.clone()
    mask = torch.zeros_like(observation.visible)
    for s in (0, 1):
        source = observation.keypoints[..., legs[1 - s], :]
        shank = (source[..., shin[0], :] - source[..., shin[1], :]).norm(dim=-1)[..., None, None]
        steady = torch.randn(*source.shape[:-3], 1, 1, 2, generator=generator)
        tremble = torch.randn(source.shape, generator=generator) / 3
        keypoints[..., legs[s], :] = source + 0.1 * shank * (steady + tremble)
        trust = 0.8 + 0.2 * torch.rand(source.shape[:-1], generator=generator)
        confidence[..., legs[s]] = observation.confidence[..., legs[1 - s]] * trust
        mask[..., legs[s]] = copied[s][..., None] & observation.visible[..., legs[1 - s]]
    return _put(observation, keypoints, confidence, mask)


def false_detections(observation: Observation2D, generator: torch.Generator, share: float, length: int) -> Spoilt:
    """Confident but wrong: keypoints sit on the background, for runs of frames.

    Each keypoint draws one place in the image per clip, trembles there by a pixel, and has confidence 0.6 to 0.95.
    """
    mask = _runs(observation.confidence.transpose(-1, -2).shape, share, length, generator).transpose(-1, -2)
    size = torch.tensor([observation.camera.width, observation.camera.height])
    shape = observation.keypoints.shape
    place = size * torch.rand(*shape[:-3], 1, *shape[-2:], generator=generator)
    keypoints = place + torch.randn(shape, generator=generator)
    confidence = 0.6 + 0.35 * torch.rand(shape[:-1], generator=generator)
    return _put(observation, keypoints, confidence, mask)


def _legs(observation: Observation2D) -> list[list[int]]:
    return [[observation.index(f"{side}_{part}") for part in LEG] for side in ("left", "right")]


def _put(observation: Observation2D, keypoints: Tensor, confidence: Tensor, mask: Tensor) -> Spoilt:
    """New values under the mask, and the part of the mask where they are new indeed."""
    changed = (keypoints != observation.keypoints).any(-1) | (confidence != observation.confidence)
    mask = mask & changed
    keypoints = torch.where(mask[..., None], keypoints, observation.keypoints)
    confidence = torch.where(mask, confidence, observation.confidence)
    return replace(observation, keypoints=keypoints, confidence=confidence), mask


def _hide(observation: Observation2D, mask: Tensor) -> Spoilt:
    zeros = torch.zeros_like(observation.keypoints)
    return _put(observation, zeros, zeros[..., 0], mask & observation.visible)


def _runs(shape: Sequence[int], share: float, length: int, generator: torch.Generator) -> Tensor:
    """Mask of runs along the last axis; each frame is covered with probability ``share``. A frame is free when none of
    ``length`` possible starts fires: (1 - p)^length = 1 - share."""
    p = 1 - (1 - share) ** (1 / length)
    starts = torch.rand(*shape[:-1], shape[-1] + length - 1, generator=generator) < p
    return starts.unfold(-1, length, 1).any(-1)


def _before_it_vanishes(seen: Tensor, lead: int) -> Tensor:
    """The ``lead`` frames (..., T) that end with one in which something is seen that is not seen in the next one."""
    event = torch.cat((seen[..., :-1] & ~seen[..., 1:], torch.zeros_like(seen[..., :1])), dim=-1)
    return F.pad(event, (0, lead - 1)).unfold(-1, lead, 1).any(-1) if lead else torch.zeros_like(event)
