"""Things that stand in the way, as meshes: a desk, a wall; and where to put a desk. Floor z = 0, metres, world."""

import math
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from motionlab.errors import ShapeError, check_shape
from motionlab.motion import Motion
from motionlab.observation import Camera

_DEPTH = 0.7  # metres of a desk


@dataclass(frozen=True, eq=False)
class Occluder:
    """A mesh that blocks the view: what it is, vertices (1, V, 3) in metres, world, and faces (F, 3)."""

    name: str
    vertices: Tensor
    faces: Tensor

    def __post_init__(self) -> None:
        check_shape(self.vertices, "1 V 3", "vertices")
        check_shape(self.faces, "F 3", "faces")


def desk(x: float, y: float, yaw: float, *, length: float, height: float) -> Occluder:
    """A table, its long side along the direction ``yaw`` radians from +x, closed to the floor by a panel along the
    middle of that side: legs behind it cannot be seen."""
    ends = [((s * (length / 2 - 0.02), 0, height / 2), (0.04, _DEPTH, height)) for s in (-1, 1)]
    panel = ((0, 0, height / 2), (length, 0.03, height))
    return _boxes("desk", [((0, 0, height - 0.02), (length, _DEPTH, 0.04)), panel, *ends], x, y, yaw)


def wall(start: tuple[float, float], end: tuple[float, float], *, height: float = 2.5) -> Occluder:
    """A wall of 10 cm that stands on the floor from ``start`` to ``end`` (x, y)."""
    (ax, ay), (bx, by) = start, end
    length = math.hypot(bx - ax, by - ay)
    box = ((0, 0, height / 2), (length, 0.1, height))
    return _boxes("wall", [box], (ax + bx) / 2, (ay + by) / 2, math.atan2(by - ay, bx - ax))


def desk_before(motion: Motion, camera: Camera, *, hidden: float = 0.8) -> Occluder:
    """A desk 0.7 of the way from the camera to the person that hides whatever is below ``hidden`` metres.

    Its panel is as high as the sight lines to that height, at the person's nearest and farthest place, pass it.

    Raises:
        ShapeError: the person comes too near for a desk to stand between, or the camera stands right above them.
    """
    middle, across, near, far = _stage(motion, camera)
    eye = camera.centre.double()
    reach = min(0.7 * (near + far) / 2, near - 0.6)
    if reach < 0.5:
        raise ShapeError(f"the person comes within {near:.2f} m of the camera: no room for a desk")
    x, y = (eye[:2] + reach / ((near + far) / 2) * (middle - eye[:2])).tolist()
    height = max(float(eye[2] + (hidden - eye[2]) * reach / distance) for distance in (near, far))
    half = float(((motion.positions[..., :2].reshape(-1, 2).double() - middle) @ across).abs().max())
    return desk(x, y, math.atan2(across[1], across[0]), length=2 * half + 0.8, height=height)


def _boxes(name: str, boxes: list[tuple[tuple, tuple]], x: float, y: float, yaw: float) -> Occluder:
    """Boxes (centre, size) in one mesh, turned by yaw and moved to (x, y)."""
    place = trimesh.transformations.rotation_matrix(yaw, (0, 0, 1))
    place[:2, 3] = x, y
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre)) for centre, size in boxes]
    mesh = trimesh.util.concatenate(parts).apply_transform(place)
    return Occluder(name, torch.tensor(mesh.vertices)[None].float(), torch.tensor(mesh.faces).long())


def _stage(motion: Motion, camera: Camera) -> tuple[Tensor, Tensor, float, float]:
    """Middle (2,) of the way on the floor, the unit vector (2,) across the view, nearest and farthest distance."""
    ground = motion.root[..., :2].reshape(-1, 2).double()
    middle = (ground.amin(0) + ground.amax(0)) / 2
    view = middle - camera.centre.double()[:2]
    if view.norm() < 1e-6:
        raise ShapeError("the camera stands right above the person: nothing can be put between them")
    forward = view / view.norm()
    distance = (ground - camera.centre.double()[:2]) @ forward
    return middle, torch.stack((forward[1], -forward[0])), float(distance.min()), float(distance.max())
