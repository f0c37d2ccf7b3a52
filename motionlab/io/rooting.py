"""A file may move every joint against its parent, a motion only its root: which joint that is, and what becomes of the
others."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from motionlab.io.judging import longest_chain
from motionlab.io.reading import Location
from motionlab.skeleton import Skeleton

#: Shares of the longest chain: below SAME a joint sits at its OFFSET, above RIGID its bone changes length.
SAME, RIGID = 0.002, 0.02
#: The figure goes on in the child that holds so much of all that is below.
_TRUNK = 0.8


def rerooted(
    at: Location, skeleton: Skeleton, place: np.ndarray, rot: Tensor, translations: str, lines: list[str]
) -> tuple[list[int], Skeleton, Tensor, Tensor]:
    """Computes which joints are kept, their skeleton, root positions (T, 3) and rotations (T, K, 3, 3) of a tree that
    stands at ``place`` (T, J, 3) and is turned by ``rot`` (T, J, 3, 3), each joint against its parent; float64.

    The root is the deepest joint of the trunk at the top that moves; the joints above it are composed into it, and what
    else hangs on them (handles of inverse kinematics) is left out. Both are noted.

    Args:
        translations: a joint below that moves is kept at its mean place and noted; "strict" refuses if it moves more
            than ``RIGID``, "mean" never. lines: where each joint stands in the file, for messages.
    """
    names, parents, offset = skeleton.names, skeleton.parents, skeleton.offsets.double().numpy()
    reach = longest_chain(skeleton) or 1e-12
    strays = np.abs(place - offset).max((0, 2)) > SAME * reach
    chain = _trunk(parents)
    top = [0, *(joint for joint in chain if strays[joint])][-1]
    above = chain[: chain.index(top)]
    root, first = torch.from_numpy(place[:, top]), rot[:, top]
    for joint in reversed(above):
        root = torch.from_numpy(place[:, joint]) + (rot[:, joint] @ root[..., None])[..., 0]
        first = rot[:, joint] @ first
    if above:
        said = ", ".join(names[j] for j in above)
        at.notes.append(f"root is {names[top]}, whose position changes; it takes on the motion of {said} above")
    order = {top: 0}
    for j in range(len(names)):
        if parents[j] in order:
            order[j] = len(order)
    kept = list(order)
    beside = [names[j] for j in range(len(names)) if j not in order and j not in above]
    if beside:
        at.notes.append(f"joints beside the root are left out: {', '.join(beside)}")
    mean = place.mean(0)
    for j in kept[1:]:
        moves = np.abs(place[:, j] - mean[j]).max()
        if moves > SAME * reach:
            what = f"{names[j]} moves {moves / reach:.1%} of the figure against its parent"
            if translations == "strict" and moves > RIGID * reach:
                remedy = 'translations="mean", or --translations mean, keeps its mean place'
                raise at.error(f"{what}: bones of changing length", place=lines[j], remedy=remedy)
            at.notes.append(f"{what}: its mean place is kept")
        elif strays[j]:
            off = np.abs(mean[j] - offset[j]).max() / reach
            at.notes.append(f"{names[j]} is always {off:.1%} of the figure off its OFFSET: believed as it moves")
    rot = rot[:, kept].clone()
    rot[:, 0] = first
    offsets = torch.from_numpy(np.where(strays[:, None], mean, offset)[kept])
    offsets[0] = 0
    tree = tuple(order.get(parents[j], -1) for j in kept)
    return kept, Skeleton(tuple(names[j] for j in kept), tree, offsets), root, rot


def _trunk(parents: tuple[int, ...]) -> list[int]:
    """From the root down, as long as one child holds nearly all that is below."""
    size = [1] * len(parents)
    for j in range(len(parents) - 1, 0, -1):
        size[parents[j]] += size[j]
    chain = [0]
    while True:
        below = [j for j in range(len(parents)) if parents[j] == chain[-1]]
        trunk = max(below, key=lambda j: size[j], default=None)
        if trunk is None or (len(below) > 1 and size[trunk] < _TRUNK * (size[chain[-1]] - 1)):
            return chain
        chain.append(trunk)
