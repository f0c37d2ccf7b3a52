"""What pruning at a threshold does to a whole skin: where it moves, what still leaks, what planted faults are left."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from motionlab import skinning
from motionlab.body import BodyModel, lbs
from motionlab.motion import Motion
from motionlab.observation import look_at
from motionlab.skeleton import fk
from motionlab.viz.scene import Scene
from studies.nb03_skinning.partial_fit import LEGS, leak_percent


def leaked_mm(body: BodyModel, pose: Motion) -> Tensor:
    """Computes how far each vertex moves per radian of the joints that should not move it: (V,), mm per radian.

    A joint may move what it, or a joint below it, holds with a weight of ``skinning.SMALL``.
    """
    below = body.skeleton.ancestors().to(body.weights)
    allowed = (body.weights >= skinning.SMALL).to(below) @ below > 0
    return 1000 * torch.where(allowed, 0, _levers(body, pose)).norm(dim=-1)


def _levers(body: BodyModel, pose: Motion) -> Tensor:
    """How far each vertex moves per radian of each joint: (V, J), metres, without pose correctives. Turning joint j by
    a small w moves v by w x sum_k w_vk (x_vk - p_j), k being j and all below it, x_vk where joint k alone would carry
    v; the Frobenius norm is sqrt(2) times that sum's. As :func:`motionlab.skinning.influence`."""
    positions, world = (x[0] for x in fk(pose.skeleton, pose.root, pose.rot))
    turn = world @ body.bind_rot.mT
    carried = torch.einsum("jab,vjb->vja", turn, body.template[:, None] - body.joints) + positions
    below = body.skeleton.ancestors().to(body.weights)  # (k, j): j is k or above it
    arm = (body.weights[..., None] * carried).transpose(1, 2) @ below  # (V, 3, J)
    arm = arm.mT - (body.weights @ below)[..., None] * positions
    return 2**0.5 * arm.norm(dim=-1)


def skin(body: BodyModel, pose: Motion, threshold: float, size: tuple[int, int] = (960, 480)) -> np.ndarray:
    """Draws a body in one pose (1 frame), pruned at a threshold: what still leaks, millimetres per radian, and how far
    the skin moved, millimetres; (H, W, 3) uint8."""
    pruned = skinning.prune(body, threshold)
    before, after = (lbs(b, pose.skeleton, pose.root, pose.rot)[0] for b in (body, pruned))
    leaks, moved = leaked_mm(pruned, pose), 1000 * torch.linalg.vector_norm(after - before, dim=-1)
    with Scene(size, panels=("gradient that still leaks", "skin moved by pruning")) as scene:
        for panel, (field, unit) in enumerate(((leaks, "mm per rad"), (moved, "mm"))):
            look = {"title": unit, "limits": (0.0, 5.0), "cmap": "Oranges" if panel == 0 else "Blues"}
            scene.body(pruned, pose, field=field, frame=0, panel=panel, **look)
        leaky = int((leaks > 0).sum())
        scene.caption()(f"below {threshold:.1e} pruned: {leaky} vertices leak, moved {moved.max():.1f} mm at most")
        return scene.floor().image()


def moved_by_legs(bodies: Mapping[str, BodyModel], pose: Motion) -> np.ndarray:
    """Draws bodies in one pose (1 frame), painted by what the joints of the legs move, millimetres per radian, whole
    and from near the face: (2 H, W, 3) uint8."""
    levers = {name: _levers(body, pose)[:, body.skeleton.indices(LEGS)] for name, body in bodies.items()}
    fields = {name: 1000 * x.norm(dim=-1) for name, x in levers.items()}
    look, rows = {"frame": 0, "title": "mm per rad", "limits": (0.0, 2.0), "cmap": "Oranges"}, []
    head, world = (x[0, pose.skeleton.index("head")] for x in fk(pose.skeleton, pose.root, pose.rot))
    face = head + world @ torch.tensor([0.0, 0.05, 0.0])
    before = face + world @ torch.tensor([-0.5, 0.1, 1.4])
    for eye in (None, look_at(before, face, focal=3.0 * 420, width=round(960 / len(bodies)), height=420)):
        with Scene((960, 420), panels=tuple(bodies) if eye is None else ("",) * len(bodies), camera=eye) as scene:
            for panel, (name, field) in enumerate(fields.items()):
                scene.body(bodies[name], pose, field=field, panel=panel, **look)
            rows.append(scene.floor().image())
    return np.concatenate(rows)


def sweep(
    body: BodyModel, clean: BodyModel, planted: Tensor, motion: Motion, thresholds: Sequence[float]
) -> list[dict[str, float]]:
    """Computes for each pruning threshold: leak (% of the face's gradient that reaches the legs in the first frame),
    left (share of the planted entries that survive), max_mm (vertex displacement over the motion), clean_mean_mm and
    clean_max_mm (what the same threshold moves on the body without faults)."""
    rows = []
    for threshold in thresholds:
        pruned = skinning.prune(body, threshold)
        moved, harmless = (
            1000 * skinning.displacement(*both, motion)
            for both in ((body, pruned), (clean, skinning.prune(clean, threshold)))
        )
        rows.append({
            "threshold": threshold, "leak": leak_percent(pruned, motion.cut(0, 1)),
            "left": float((pruned.weights[planted] > 0).double().mean()),
            "max_mm": float(moved.max()),
            "clean_mean_mm": float(harmless.double().mean()), "clean_max_mm": float(harmless.max()),
        })  # fmt: skip
    return rows
