"""The figure of notebook 14: poses side by side, with the handles that they were asked to reach."""

from collections.abc import Mapping

import numpy as np
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.viz.scene import Scene

_HANDLE, _GHOST = (0.835, 0.369, 0.0), (0.35, 0.35, 0.35)  # vermillion: seen beside every role


def pose_row(
    poses: Mapping[str, Motion], targets: Tensor, which: Tensor, roles: Mapping[str, str], *, body: BodyModel,
    ghost: Motion, width: int, height: int, azimuth: float,
) -> np.ndarray:  # fmt: skip
    """Draws a panel per label: a pose (1,), a ghost in every other panel than its own, and handles (22,) as balls at
    targets (22, 3): (H, W, 3)."""
    with Scene((width * len(poses), height), panels=tuple(poses), azimuth=azimuth, elevation=8.0) as scene:
        scene.floor()
        for panel, (label, pose) in enumerate(poses.items()):
            scene.body(body, pose, roles[label], panel=panel)
            if pose is not ghost:
                scene.body(body, ghost, _GHOST, opacity=0.35, shadow=0, framed=False, panel=panel)
            if which.any():
                scene.points(targets[which].numpy(), _HANDLE, radius=0.055, panel=panel)
        return scene.image()
