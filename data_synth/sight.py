"""Lines of sight: how far before a point a mesh is in the way, for many frames in one ray-casting scene."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor
from trimesh.ray.ray_pyembree import RayMeshIntersector

from motionlab.body import BodyModel

FACES_AT_ONCE = 1_000_000  # per scene: bounds memory on long clips


class Shell(NamedTuple):
    """A coarser skin of a body whose vertices are some of the body's own.

    vertices (N,): indices into the body's. faces (F, 3): indices into ``vertices``. carrier (F,): the
    joint that carries most of each face.
    """

    vertices: Tensor
    faces: Tensor
    carrier: Tensor


@lru_cache(maxsize=4)
def shell(body: BodyModel) -> Shell:
    """A skin of about 4000 triangles by decimation that keeps original vertices (Schroeder et al. 1992)."""
    import pyvista as pv  # takes a second or more to load

    mesh = pv.PolyData.from_regular_faces(body.template.numpy(), body.faces.numpy())
    if mesh.n_cells > 4000:
        mesh = mesh.decimate_pro(1 - 4000 / mesh.n_cells, preserve_topology=True)
    _, index = cKDTree(body.template.numpy()).query(np.asarray(mesh.points))
    index, triangles = torch.from_numpy(index), torch.from_numpy(np.array(mesh.regular_faces)).long()
    carrier = body.weights[index][triangles].sum(1).argmax(-1)
    return Shell(index, triangles, carrier)


def gap_to(vertices: Tensor, faces: Tensor, eye: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """How far before each target the sight line from the eye first meets the mesh of that frame.

    All frames share one scene: frame t is moved, eye and all, to a cell of its own on a grid, so far from
    the others that what a line meets on its way to the target can only be of its own frame.

    vertices (T, V, 3), eye (3,), targets (T, N, 3): metres. Returns the gap (T, N) in metres, positive where something
    is in the way and -1 where nothing is, and the face met (T, N), 0 where none.
    """
    chunk = max(1, FACES_AT_ONCE // len(faces))
    parts = [
        _gap(v.double().numpy(), faces.numpy(), eye.double().numpy(), p.double().numpy())
        for v, p in zip(vertices.split(chunk), targets.split(chunk), strict=True)
    ]
    gap, face = (torch.from_numpy(np.concatenate(x)) for x in zip(*parts, strict=True))
    return gap.to(targets), face


def _gap(vertices: np.ndarray, faces: np.ndarray, eye: np.ndarray, targets: np.ndarray) -> tuple:
    frames, count = targets.shape[:2]
    everything = np.concatenate((vertices.reshape(-1, 3), targets.reshape(-1, 3), eye[None]))
    cell = np.ptp(everything, axis=0).max() + 1.0
    side = int(np.ceil(frames ** (1 / 3)))
    shift = cell * np.stack(np.unravel_index(np.arange(frames), (side,) * 3), -1)  # (T, 3)
    places = (vertices + shift[:, None]).reshape(-1, 3)
    triangles = (faces + vertices.shape[1] * np.arange(frames)[:, None, None]).reshape(-1, 3)
    mesh = trimesh.Trimesh(places, triangles, process=False)
    origins = np.broadcast_to((eye + shift)[:, None], targets.shape).reshape(-1, 3)
    rays = (targets - eye).reshape(-1, 3)
    reach = np.linalg.norm(rays, axis=1)
    rays = rays / np.maximum(reach, 1e-9)[:, None]
    face = RayMeshIntersector(mesh).intersects_first(origins, rays)
    met = face >= 0
    a, b, c = mesh.vertices[mesh.faces[face[met]]].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    along = ((a - origins[met]) * normal).sum(1) / (rays[met] * normal).sum(1)
    gap = np.full(len(rays), -1.0)
    gap[met] = np.maximum(reach[met] - along, -1.0)
    return gap.reshape(frames, count), np.where(met, face % len(faces), 0).reshape(frames, count)
