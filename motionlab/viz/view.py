"""VTK's eye: matched exactly to a pinhole camera, or stood where a viewpoint says."""

from __future__ import annotations

import numpy as np
import pyvista as pv

from motionlab.observation import Camera
from motionlab.viz import viewpoint
from motionlab.viz.shapes import array

NEAR, FAR = 0.1, 100.0  # metres; 24 bits of depth still tell 1 mm apart at 20 m


def match(eye: pv.Camera, camera: Camera) -> None:
    """Make a VTK camera see what a pinhole camera sees: any focal lengths, skew and principal point.

    A pixel (u, v) of a w x h image is x = 2u/w - 1, y = 1 - 2v/h on VTK's screen, whatever its size in
    pixels, so a window of the same shape shows the same picture at any scale. VTK's own view angle knows
    neither skew nor two focal lengths; hence the explicit projection matrix.
    """
    k, r, centre = array(camera.intrinsics), array(camera.rotation), array(camera.centre)
    w, h = camera.width, camera.height
    eye.position, eye.focal_point, eye.up = centre, centre + r[2], -r[1]
    eye.view_angle = float(np.degrees(2 * np.arctan(h / 2 / k[1, 1])))
    projection = np.array(
        [  # columns: VTK's camera axes, x right, y up, z backward
            [2 * k[0, 0] / w, -2 * k[0, 1] / w, 1 - 2 * k[0, 2] / w, 0],
            [0, 2 * k[1, 1] / h, 2 * k[1, 2] / h - 1, 0],
            [0, 0, -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)],
            [0, 0, -1, 0],
        ]
    )
    eye.SetExplicitProjectionTransformMatrix(pv.vtkmatrix_from_array(projection))
    eye.UseExplicitProjectionTransformMatrixOn()
    eye.clipping_range = NEAR, FAR


def aim(eye: pv.Camera, target: np.ndarray, towards: np.ndarray, distance: float, aspect: float) -> None:
    """Stand ``distance`` metres from the target in direction ``towards`` and look at it, z up."""
    eye.position, eye.focal_point, eye.up = target + distance * towards, target, (0.0, 0.0, 1.0)
    eye.view_angle = float(np.degrees(2 * np.arctan(viewpoint.half_angle(aspect))))
    eye.clipping_range = max(NEAR, 0.1 * distance), 5 * distance + 80
