"""What pruning at a threshold does to a whole skin: where it moves, what still leaks, what planted faults are left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from motionlab import skinning
from motionlab.body import BodyModel, lbs
from motionlab.motion import Motion
from motionlab.observation import Camera, look_at
from motionlab.skeleton import fk
from motionlab.viz.scene import Scene
from studies.nb03_skinning.partial_fit import LEGS, leak_percent

LIMITS = (0.0, 5.0)  # of both colour bars


def moved_mm(body: BodyModel, other: BodyModel, pose: Motion) -> Tensor:
    """Computes how far each vertex of two bodies is apart in one pose (1 frame): (V,), mm."""
    places = [lbs(b, pose.skeleton, pose.root, pose.rot)[0] for b in (body, other)]
    return 1000 * torch.linalg.vector_norm(places[0] - places[1], dim=-1)


def moved_by_mm(body: BodyModel, pose: Motion, names: Sequence[str]) -> Tensor:
    """Computes how far each vertex moves per radian of some joints, in one pose (1 frame): (V,), mm per radian."""
    return 1000 * _levers(body, pose)[:, body.skeleton.indices(names)].norm(dim=-1)


def leaked_mm(body: BodyModel, pose: Motion) -> Tensor:
    """Computes how far each vertex moves per radian of the joints that should not move it: (V,), mm per radian.

    A joint may move what it, or a joint below it, holds with a weight of ``skinning.SMALL``.
    """
    below = body.skeleton.ancestors().to(body.weights)
    allowed = (body.weights >= skinning.SMALL).to(below) @ below > 0
    return 1000 * torch.where(allowed, 0, _levers(body, pose)).norm(dim=-1)


def _levers(body: BodyModel, pose: Motion) -> Tensor:
    """How far each vertex moves per radian of each joint: (V, J), metres, without pose correctives.

    Turning joint j by a small w moves v by w x sum_k w_vk (x_vk - p_j), k being j and all below it, x_vk where joint k
    alone would carry v; the Frobenius norm is sqrt(2) times that sum's. As :func:`motionlab.skinning.influence`.
    """
    positions, world = (x[0] for x in fk(pose.skeleton, pose.root, pose.rot))
    turn = world @ body.bind_rot.mT
    carried = torch.einsum("jab,vjb->vja", turn, body.template[:, None] - body.joints) + positions
    below = body.skeleton.ancestors().to(body.weights)  # (k, j): j is k or above it
    arm = (body.weights[..., None] * carried).transpose(1, 2) @ below  # (V, 3, J)
    arm = arm.mT - (body.weights @ below)[..., None] * positions
    return 2**0.5 * arm.norm(dim=-1)


def skin(body: BodyModel, pose: Motion, threshold: float, size: tuple[int, int] = (960, 480)) -> np.ndarray:
    """Draws a body in one pose (1 frame), pruned at a threshold: what still leaks, and how far the skin moved.

    Returns:
        (H, W, 3) uint8, two panels, millimetres per radian and millimetres.
    """
    pruned = skinning.prune(body, threshold)
    leaks, moved = leaked_mm(pruned, pose), moved_mm(pruned, body, pose)
    with Scene(size, panels=("gradient that still leaks", "skin moved by pruning")) as scene:
        for panel, (field, unit) in enumerate(((leaks, "mm per rad"), (moved, "mm"))):
            look = {"title": unit, "limits": LIMITS, "cmap": "Oranges" if panel == 0 else "Blues"}
            scene.body(pruned, pose, field=field, frame=0, panel=panel, **look)
        words = (
            f"below {threshold:.1e} pruned: {int((leaks > 0).sum())} vertices leak, moved {moved.max():.1f} mm at most"
        )
        scene.caption()(words)
        return scene.floor().image()


def moved_by_legs(bodies: Mapping[str, BodyModel], pose: Motion) -> np.ndarray:
    """Draws bodies in one pose (1 frame), painted by what the joints of the legs move, whole and from near the face.

    Returns:
        (2 H, W, 3) uint8, a panel per body, millimetres per radian.
    """
    fields = {name: moved_by_mm(body, pose, LEGS) for name, body in bodies.items()}
    look, rows = {"frame": 0, "title": "mm per rad", "limits": (0.0, 2.0), "cmap": "Oranges"}, []
    for eye in (None, _before_the_face(pose, round(960 / len(bodies)), 420)):
        with Scene((960, 420), panels=tuple(bodies) if eye is None else ("",) * len(bodies), camera=eye) as scene:
            for panel, (name, field) in enumerate(fields.items()):
                scene.body(bodies[name], pose, field=field, panel=panel, **look)
            rows.append(scene.floor().image())
    return np.concatenate(rows)


def _before_the_face(pose: Motion, width: int, height: int) -> Camera:
    head, world = (x[0, pose.skeleton.index("head")] for x in fk(pose.skeleton, pose.root, pose.rot))
    face = head + world @ torch.tensor([0.0, 0.05, 0.0])
    eye = face + world @ torch.tensor([-0.5, 0.1, 1.4])
    return look_at(eye, face, focal=3.0 * height, width=width, height=height)


@dataclass(frozen=True, eq=False)
class Leakage:
    """Gradient of keypoints that reaches joints which should not move them.

    influence (K, J): metres per radian. allowed (K, J): True for the joints that hold the keypoint and all above.
    """

    influence: Tensor
    allowed: Tensor

    @property
    def per_joint(self) -> Tensor:
        """Leaked influence (J,), metres per radian, root of the sum of squares over the keypoints."""
        return torch.where(self.allowed, 0, self.influence).square().sum(0).sqrt()

    @property
    def share(self) -> float:
        """Leaked gradient norm over the whole gradient norm."""
        return float(self.per_joint.norm() / self.influence.norm())


def leakage(body: BodyModel, root: Tensor, rot: Tensor, vertices: Sequence[int], holds: float = 0.05) -> Leakage:
    """Computes the gradient leakage at one pose: root (3,), rot (J, 3, 3).

    A joint *holds* a vertex if its weight there is at least ``holds``; through the kinematic chain every
    joint above it moves the vertex rightly, so only what reaches any other joint has leaked.

    Source: thesis 3.3.2.
    """
    held = (body.weights[torch.as_tensor(vertices)] >= holds).long()
    above = body.skeleton.ancestors().long()
    return Leakage(skinning.influence(body, root, rot, vertices), held @ above > 0)


def sweep(
    body: BodyModel, clean: BodyModel, planted: Tensor, motion: Motion, keypoints: Sequence[int], thresholds
) -> list[dict]:
    """Computes for each pruning threshold what is removed, what still leaks and how far vertices move: a dict each.

    Keys: threshold, removed (share of the non-zero weights), leakage (share of gradient norm at the first frame),
    mean_mm and max_mm (vertex displacement over the motion), clean_mean_mm and clean_max_mm (what the same threshold
    moves on the body without faults), left (share of the planted entries that survive).
    """
    rows = []
    for threshold in thresholds:
        pruned = skinning.prune(body, threshold)
        mean, most = skinning.displacement(body, pruned, motion)
        clean_mean, clean_most = skinning.displacement(clean, skinning.prune(clean, threshold), motion)
        rows.append(
            {
                "threshold": threshold,
                "removed": 1 - int((pruned.weights > 0).sum()) / int((body.weights > 0).sum()),
                "leakage": leakage(pruned, motion.root[0], motion.rot[0], keypoints).share,
                "mean_mm": 1000 * mean,
                "max_mm": 1000 * most,
                "clean_mean_mm": 1000 * clean_mean,
                "clean_max_mm": 1000 * clean_most,
                "left": float((pruned.weights[planted] > 0).double().mean()),
            }
        )
    return rows


def listed(body: BodyModel, distance: Tensor, mask: Tensor) -> list[dict]:
    """Lists masked weights (V, J), the farthest first: between which joints, along the skin and straight."""
    reach, strongest, rows = skinning.reach(body, distance), body.weights.argmax(1), []
    for row in skinning.long_range(body, mask, distance):
        joint, ends = body.skeleton.index(row["joint"]), f"a vertex of {row['holder']} hangs on {row['joint']}"
        region = body.template[strongest == joint]
        straight = float((region - body.template[row["vertex"]]).norm(dim=1).min()) if len(region) else float("nan")
        out = row["metres"] / float(reach[row["vertex"], joint])
        where = {"along the skin, m": row["metres"], "in reaches": out, "straight, m": straight}
        rows.append({"farthest": ends, "weight": row["weight"], **where})
    return rows


def farthest(name: str, body: BodyModel, distance: Tensor, mask: Tensor) -> dict:
    """Returns a body's row in the table of the audit: how many weights are masked (V, J), and the farthest of them."""
    small = skinning.weight_report(body).small
    return {"body": name, "small": small, "long-range": int(mask.sum())} | listed(body, distance, mask)[0]


def audited(name: str, body: BodyModel, pose: Motion) -> dict:
    """Returns a body's row in the table of weights: both readings of the thesis's 3 %, and the leak in one pose."""
    report = skinning.weight_report(body)
    leaks = {"leak to the legs, %": 0.0, "leak, pruned 1e-3": 1e-3, "leak, pruned 1e-2": 1e-2}
    return {
        "body": name, "vertices x joints": f"{len(body.weights)} x {body.weights.shape[1]}",
        "% of all entries": 100 * report.share_of_all, "% of the non-zero": 100 * report.share_of_nonzero,
        "long-range": int(skinning.spurious(body).sum()),
    } | {name: leak_percent(skinning.prune(body, least), pose) for name, least in leaks.items()}  # fmt: skip
