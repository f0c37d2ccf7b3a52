"""Things that stand in the way, as meshes: table, desk, wall, another person; and where to put them.

Floor z = 0, metres, world. Every maker returns an :class:`Occluder`; the functions that end in ``_before``
place one between a camera and a motion so that it hides a stated part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from data_synth.sight import shell
from motionlab.body import BodyModel, lbs
from motionlab.errors import ShapeError, check_shape
from motionlab.motion import Motion
from motionlab.observation import Camera


@dataclass(frozen=True, eq=False)
class Occluder:
    """A mesh that blocks the view.

    vertices (T, V, 3): metres, world; T = 1 for a thing that stands still. faces (F, 3). name: what it is.
    """

    name: str
    vertices: Tensor
    faces: Tensor

    def __post_init__(self) -> None:
        check_shape(self.vertices, "T V 3", "vertices")
        check_shape(self.faces, "F 3", "faces")

    @property
    def moves(self) -> bool:
        """Whether it has a place per frame."""
        return len(self.vertices) > 1

    def mesh(self, frame: int = 0) -> trimesh.Trimesh:
        """The mesh at one frame, for drawing."""
        vertices = self.vertices[frame if self.moves else 0]
        return trimesh.Trimesh(vertices.numpy(), self.faces.numpy(), process=False)


def table(
    x: float, y: float, yaw: float = 0.0, *, length: float = 1.6, depth: float = 0.8, height: float = 0.75
) -> Occluder:
    """A table with four legs, its long side along the direction ``yaw`` radians from +x; what stands behind shows."""
    reach = (length / 2 - 0.05, depth / 2 - 0.05)
    legs = [((sx * reach[0], sy * reach[1], height / 2 - 0.02), (0.06, 0.06, height - 0.04)) for sx, sy in _CORNERS]
    return _boxes("table", [((0, 0, height - 0.02), (length, depth, 0.04)), *legs], x, y, yaw)


def desk(
    x: float, y: float, yaw: float = 0.0, *, length: float = 1.6, depth: float = 0.7, height: float = 0.75
) -> Occluder:
    """A table closed to the floor by a panel along the middle of its long side: legs behind it cannot be seen."""
    ends = [((s * (length / 2 - 0.02), 0, height / 2), (0.04, depth, height)) for s in (-1, 1)]
    panel = ((0, 0, height / 2), (length, 0.03, height))
    return _boxes("desk", [((0, 0, height - 0.02), (length, depth, 0.04)), panel, *ends], x, y, yaw)


def wall(start: tuple[float, float], end: tuple[float, float], *, height: float = 2.5) -> Occluder:
    """A wall of 10 cm that stands on the floor from ``start`` to ``end`` (x, y)."""
    (ax, ay), (bx, by) = start, end
    length = math.hypot(bx - ax, by - ay)
    box = ((0, 0, height / 2), (length, 0.1, height))
    return _boxes("wall", [box], (ax + bx) / 2, (ay + by) / 2, math.atan2(by - ay, bx - ax))


def person(motion: Motion, body: BodyModel) -> Occluder:
    """Somebody else, one mesh of about 8,000 faces per frame of their own motion.

    Raises:
        ShapeError: the motion is a batch of clips.
    """
    if motion.root.ndim != 2:
        raise ShapeError(f"one clip expected, got root {tuple(motion.root.shape)}: choose one with motion.clip(i)")
    skin = shell(body, 8000)
    vertices = lbs(body, motion.skeleton, motion.root, motion.rot, vertices=skin.vertices)
    return Occluder(motion.name or "person", vertices, skin.faces)


def desk_before(motion: Motion, camera: Camera, *, share: float = 0.7, hidden: float = 0.8) -> Occluder:
    """A desk ``share`` of the way from the camera to the person that hides whatever is below ``hidden`` metres.

    Its panel is as high as the sight lines to that height, at the person's nearest and farthest place, pass it.

    Raises:
        ShapeError: the person comes too near for a desk to stand between, or the camera stands right above them.
    """
    middle, across, near, far = _stage(motion, camera)
    eye = camera.centre.double()
    reach = min(share * (near + far) / 2, near - 0.6)
    if reach < 0.5:
        raise ShapeError(f"the person comes within {near:.2f} m of the camera: no room for a desk")
    x, y = (eye[:2] + reach / ((near + far) / 2) * (middle - eye[:2])).tolist()
    height = max(float(eye[2] + (hidden - eye[2]) * reach / distance) for distance in (near, far))
    yaw, length = math.atan2(across[1], across[0]), 2 * _half_width(motion, camera, middle, across) + 0.8
    return desk(x, y, yaw, length=length, height=height)


_CORNERS = [(sx, sy) for sx in (-1, 1) for sy in (-1, 1)]


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


def _half_width(motion: Motion, camera: Camera, middle: Tensor, across: Tensor) -> float:
    joints = motion.positions[..., :2].reshape(-1, 2).double()
    return float(((joints - middle) @ across).abs().max())
