"""How much a fit must know of its camera: the same clips with less and less of it.

Errors are measured in the axes of the camera, where the true and the found world agree whatever is known of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from motionlab import rotation
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, fit
from motionlab.metrics import pose
from motionlab.motion import Motion
from motionlab.observation import Camera
from studies.nb05_testops.recordings import in_camera, start_cameras
from studies.shared.contenders import CM, Seen

TILT, RISE = 3.0, 0.05  # standard deviations, degrees and metres, of a camera that was placed by eye


def placed_by_eye(camera: Camera, generator: torch.Generator) -> Camera:
    """The camera turned about its centre by a random rotation of ``TILT`` an axis and lifted by ``RISE``."""
    turn = rotation.exp(torch.deg2rad(TILT * torch.randn(3, generator=generator))).to(camera.rotation) @ camera.rotation
    centre = camera.centre + camera.centre.new_tensor([0, 0, 1]) * RISE * torch.randn(1, generator=generator).item()
    return replace(camera, rotation=turn, translation=-turn @ centre)


def knowledge(cameras: Sequence[Camera], generator: torch.Generator) -> dict[str, dict[str, object]]:
    """Arguments of ``testops.fit`` by what is known, from everything to nothing."""
    size = (cameras[0].width, cameras[0].height)
    return {
        "camera and floor": {"cameras": cameras, "floor": "camera"},
        "placed by eye": {"cameras": [placed_by_eye(c, generator) for c in cameras], "floor": "refine"},
        "the lens only": {"cameras": cameras, "floor": "guess"},
        "image size only": {"cameras": [None] * len(cameras), "size": size},
    }


def errors(
    seen: Seen, truth: Motion, priors: Priors, generator: torch.Generator, **how
) -> dict[str, dict[int, dict[str, torch.Tensor]]]:
    """By what is known and by stage: cm (B,), the pelvis on the true one ("root"), with the best turn, shift and scale
    of every frame ("similarity") and as it stands before the camera ("none").

    truth: (B, T) of the clips seen. how: goes to ``testops.fit``.
    """
    there = in_camera(seen.cameras, truth.positions)
    found = {}
    for name, given in knowledge(seen.cameras, generator).items():
        fitted: Fitted = fit(seen.observation, priors, **given, **how)
        cameras = {2: start_cameras(seen.observation, **given), 3: fitted.cameras}
        found[name] = {
            stage: {
                align: CM * pose.mpjpe(in_camera(cameras[stage], motion.positions), there, align=align)
                for align in ("root", "similarity", "none")
            }
            for stage, motion in fitted.stages.items() if stage in cameras
        }  # fmt: skip
    return found
