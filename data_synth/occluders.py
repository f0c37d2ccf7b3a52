"""Things that stand in the way, as meshes: a desk, a wall; and where to put a desk. Floor z = 0, metres, world."""

import math
from typing import NamedTuple

import torch
import trimesh
from torch import Tensor

from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.observation import Camera

_DEPTH = 0.7  # metres of a desk


class Occluder(NamedTuple):
    """A mesh that blocks the view: vertices (1, V, 3) in metres, world, and faces (F, 3)."""

    vertices: Tensor
    faces: Tensor


def wall(start: tuple[float, float], end: tuple[float, float], *, height: float = 2.5) -> Occluder:
    """A wall of 10 cm that stands on the floor from ``start`` to ``end`` (x, y)."""
    (ax, ay), (bx, by) = start, end
    length = math.hypot(bx - ax, by - ay)
    box = ((0, 0, height / 2), (length, 0.1, height))
    return _boxes([box], (ax + bx) / 2, (ay + by) / 2, math.atan2(by - ay, bx - ax))


def desk_before(motion: Motion, camera: Camera, *, hidden: float = 0.8) -> Occluder:
    """A desk 0.7 of the way from the camera to the person that hides whatever is below ``hidden`` metres.

    It is closed to the floor by a panel along the middle of its long side, so that legs behind it cannot be seen. The
    panel is as high as the sight lines to that height, at the person's nearest and farthest place, pass it.

    Raises:
        ShapeError: the person comes too near for a desk to stand between, or the camera stands right above them.
    """
    ground, eye = motion.root[..., :2].reshape(-1, 2).double(), camera.centre.double()
    middle = (ground.amin(0) + ground.amax(0)) / 2
    forward = (middle - eye[:2]) / (middle - eye[:2]).norm()
    across = torch.stack((forward[1], -forward[0]))
    distances = (ground - eye[:2]) @ forward
    near, far = float(distances.min()), float(distances.max())
    reach = min(0.7 * (near + far) / 2, near - 0.6)
    if not reach >= 0.5:  # nor is NaN, of a camera right above
        raise ShapeError(f"the person comes within {near:.2f} m of the camera: no room for a desk")
    x, y = (eye[:2] + reach / ((near + far) / 2) * (middle - eye[:2])).tolist()
    height = max(float(eye[2] + (hidden - eye[2]) * reach / distance) for distance in (near, far))
    length = 2 * float(((motion.positions[..., :2].reshape(-1, 2).double() - middle) @ across).abs().max()) + 0.8
    top, panel = ((0, 0, height - 0.02), (length, _DEPTH, 0.04)), ((0, 0, height / 2), (length, 0.03, height))
    ends = [((s * (length / 2 - 0.02), 0, height / 2), (0.04, _DEPTH, height)) for s in (-1, 1)]
    return _boxes([top, panel, *ends], x, y, math.atan2(across[1], across[0]))


def _boxes(boxes: list[tuple[tuple, tuple]], x: float, y: float, yaw: float) -> Occluder:
    """Boxes (centre, size) in one mesh, turned by yaw and moved to (x, y)."""
    place = trimesh.transformations.rotation_matrix(yaw, (0, 0, 1))
    place[:2, 3] = x, y
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre)) for centre, size in boxes]
    mesh = trimesh.util.concatenate(parts).apply_transform(place)
    return Occluder(torch.tensor(mesh.vertices)[None].float(), torch.tensor(mesh.faces).long())
