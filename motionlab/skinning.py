"""Audits skinning weights: which joints move a vertex and which should; what is spurious; what pruning moves."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from motionlab import rotation
from motionlab.body import BodyModel, lbs
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.skeleton import Skeleton

SMALL = 1e-2  # the thesis prunes weights below this
#: Ordinary weights, from which the fall-off is measured: none of them is suspect, none is the joint's own flesh.
ORDINARY = (1e-2, 1e-1)


class WeightReport(NamedTuple):
    """Weights of a body above 0 and below a threshold."""

    small: int  #: how many they are
    share_of_nonzero: float  #: of the weights above 0
    share_of_all: float  #: of all V times J: the other reading of the thesis's 3 %


def weight_report(body: BodyModel, threshold: float = SMALL) -> WeightReport:
    """Counts a body's weights above 0 and below ``threshold``: how many, and which shares.

    Source: thesis 3.3.2 (3 % of SMPL's weights are non-zero but below 1e-2).
    """
    present = body.weights > 0
    small = present & (body.weights < threshold)
    count = int(small.sum())
    return WeightReport(count, count / int(present.sum()), count / small.numel())


def surface_distance(body: BodyModel) -> Tensor:
    """Computes distances (V, J) in metres from each vertex to each joint's region along the bind-pose mesh's edges.

    A joint's region: the vertices on which it has the largest weight of all joints; a joint that is nowhere the
    largest has the vertex on which it weighs most; one without any weight is infinitely far. Separate parts
    (eyes, teeth) are tied to the largest one by the shortest straight line.
    """
    graph = _edges(body)
    strongest = body.weights.argmax(1)
    columns = []
    for joint, weights in enumerate(body.weights.T):
        region = (strongest == joint).nonzero()[:, 0] if (strongest == joint).any() else weights.argmax()[None]
        reached = dijkstra(graph, directed=False, indices=region.numpy(), min_only=True)
        columns.append(torch.from_numpy(reached if (weights > 0).any() else np.full_like(reached, np.inf)))
    return torch.stack(columns, dim=1)


def tree_distance(skeleton: Skeleton) -> Tensor:
    """Counts the bones (J, J) between every two joints."""
    above = skeleton.ancestors().long()
    depth = above.sum(1)
    return depth[:, None] + depth - 2 * (above @ above.T)


def fall_off(body: BodyModel, distance: Tensor | None = None, quantile: float = 0.99, least: int = 20) -> Tensor:
    """Computes how fast a body's ordinary weights fall off with distance: (J,), metres per decade of weight.

    A weight w at distance d from its joint's region has fallen at d / log10(0.5 / w) metres per decade, since at the
    region's edge it is about 0.5. Of each joint's weights in ``ORDINARY``, the ``quantile`` of that rate; a joint with
    fewer than ``least`` of them has that of all joints together.

    distance: :func:`surface_distance` of the body if it is at hand.

    Raises:
        ShapeError: the body has no ordinary weight outside the joints' own regions.
    """
    distance = surface_distance(body) if distance is None else distance
    known = (body.weights >= ORDINARY[0]) & (body.weights < ORDINARY[1]) & distance.isfinite() & (distance > 0)
    if not known.any():
        raise ShapeError(f"no weight between {ORDINARY[0]:g} and {ORDINARY[1]:g} to measure a fall-off from")
    rate = distance / _decades(body)
    slowest = torch.where(known, rate, torch.nan).nanquantile(quantile, dim=0)
    return torch.where(known.sum(0) >= least, slowest, rate[known].quantile(quantile))


def reach(body: BodyModel, distance: Tensor | None = None, quantile: float = 0.99) -> Tensor:
    """Computes how far from its joint's region each weight may lie by ordinary fall-off: (V, J), metres.

    reach = fall_off_j log10(0.5 / w): what :func:`fall_off` measures above 1e-2, continued to smaller weights.
    """
    return fall_off(body, distance, quantile) * _decades(body)


def spurious(
    body: BodyModel, threshold: float = SMALL, far: Tensor | float | None = None, distance: Tensor | None = None
) -> Tensor:
    """Finds long-range weights, a mask (V, J): above zero, below ``threshold``, and further than ``far`` metres.

    The rule needs both: a small weight next to its joint's region is how smooth skinning fades out.

    far: one distance or one per weight (V, J); by default the body's own :func:`reach`. distance:
    :func:`surface_distance` of the body if it is at hand.
    """
    distance = surface_distance(body) if distance is None else distance
    far = reach(body, distance) if far is None else far
    return (body.weights > 0) & (body.weights < threshold) & (distance > far)


def long_range(body: BodyModel, mask: Tensor, distance: Tensor | None = None) -> list[dict]:
    """Lists masked weights (V, J), the furthest first, with the keys vertex, holder, joint, weight, metres, bones.

    holder: the joint with the largest weight on that vertex. bones: from it to the spurious joint, along the tree.
    """
    distance = surface_distance(body) if distance is None else distance
    names, bones, found = body.skeleton.names, tree_distance(body.skeleton), []
    for vertex, joint in mask.nonzero()[distance[mask].argsort(descending=True)].tolist():
        holder, weight = int(body.weights[vertex].argmax()), float(body.weights[vertex, joint])
        row = {"vertex": vertex, "holder": names[holder], "joint": names[joint], "weight": weight}
        found.append(row | {"metres": float(distance[vertex, joint]), "bones": int(bones[holder, joint])})
    return found


def detection_scores(found: Tensor, truth: Tensor) -> tuple[float, float]:
    """Computes precision and recall of a found mask against the true one; NaN of nothing."""
    hits = float((found & truth).sum())
    return tuple(hits / float(x.sum()) if x.any() else float("nan") for x in (found, truth))


def prune(body: BodyModel, threshold: float = SMALL) -> BodyModel:
    """Removes a body's weights below ``threshold``; rows sum to 1 again.

    Source: thesis 3.3.2.
    Raises:
        ShapeError: some vertex would lose all its weights.
    """
    kept = torch.where(body.weights < threshold, 0, body.weights)
    total = kept.sum(1, keepdim=True)
    if not (total > 0).all():
        raise ShapeError(f"threshold {threshold}: vertex {int(total.argmin())} would have no weight left")
    return replace(body, weights=kept / total)


def displaced_mm(body: BodyModel, other: BodyModel, motion: Motion) -> Tensor:
    """Computes the distance of two bodies' vertices in one motion: (T,) 95th percentile over them, mm."""
    return 1000 * displacement(body, other, motion).quantile(0.95, dim=-1)


def displacement(body: BodyModel, other: BodyModel, motion: Motion) -> Tensor:
    """Computes the distances (T, V) in metres of two bodies' vertices in one motion, a few frames at a time."""
    parts = zip(motion.root.split(32), motion.rot.split(32), strict=True)
    poses = [(motion.skeleton, root, rot) for root, rot in parts]
    return torch.cat([torch.linalg.vector_norm(lbs(body, *pose) - lbs(other, *pose), dim=-1) for pose in poses])


def influence(body: BodyModel, root: Tensor, rot: Tensor, vertices: Sequence[int]) -> Tensor:
    """Computes how far each vertex moves per radian that each joint turns, at one pose: (K, J), metres per radian.

    The Frobenius norm of d v_k / d w_j at w = 0, where joint j has rotation rot_j exp(w_j).

    root: (3,). rot: (J, 3, 3). vertices: K indices into the mesh.
    """

    def place(turn: Tensor) -> Tensor:  # (J, 3) -> (K, 3)
        return lbs(body, body.skeleton, root[None], rot @ rotation.exp(turn)[None], vertices=vertices)[0]

    jacobian = torch.func.jacrev(place)(torch.zeros_like(rot[..., 0]))  # (K, 3, J, 3)
    return jacobian.square().sum((1, 3)).sqrt()


def _decades(body: BodyModel) -> Tensor:
    """How many decades each weight lies below a half, (V, J); infinite where it is zero."""
    return -(2 * body.weights.double()).log10()


def _edges(body: BodyModel) -> coo_array:
    """Edge lengths (V, V) of the mesh, its separate parts tied together."""
    points, count = body.template.double().numpy(), len(body.template)
    pairs = body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).numpy()
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    joined = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    _, part = connected_components(joined, directed=False)
    main = np.flatnonzero(part == np.bincount(part).argmax())
    tree = cKDTree(points[main])
    for label in np.unique(part[part != part[main[0]]]):
        rest = np.flatnonzero(part == label)
        away, nearest = tree.query(points[rest])
        pairs = np.vstack((pairs, (rest[away.argmin()], main[nearest[away.argmin()]])))
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    lengths = np.maximum(lengths, 1e-9)  # the sparse graph reads an exact zero as no edge
    return coo_array((lengths, pairs.T), shape=(count, count)).tocsr()
