"""Skeletons as arrays: names, parents, offsets; forward kinematics in one pass.

The standard skeleton has the 22 body joints of SMPL. Frames: in the rest pose (all rotations identity)
a body stands in a T with x to its left, y up and z forward, as SMPL's does; the world is z up. The root
rotation carries the difference: ``UPRIGHT`` stands a body up facing world +y.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from torch import Tensor

from motionlab.errors import ShapeError, check_shape

#: World from rest frame of a body that stands upright and faces +y (its left is -x): columns are the
#: world directions of the body's left, up and forward.
UPRIGHT = torch.tensor([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A tree of joints.

    names: J joint names. parents: index of each joint's parent, -1 for the root, which comes first; every parent stands
    before its children. offsets (J, 3) or (..., J, 3): metres from the parent, rest frame; offsets[0] is not used.
    contact_names: the joints that may touch the floor. sole: metres from the lowest rest-pose joint down to the floor.
    roles: standard name -> own name, where a user said what is what.

    Raises:
        ShapeError: parents or offsets do not fit the names, or a parent comes after its child.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Tensor
    contact_names: tuple[str, ...] = ()
    sole: float = 0.0
    roles: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self.offsets, f"... {len(self.names)} 3", "offsets")
        if len(self.parents) != len(self.names):
            raise ShapeError(f"parents: expected {len(self.names)} entries, got {len(self.parents)}")
        for joint, parent in enumerate(self.parents):
            if not (-1 <= parent < joint) or (parent == -1) != (joint == 0):
                raise ShapeError(f"parents[{joint}] = {parent}: one root first, then parents before children")
        self.indices(self.contact_names)

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Returns the index of a joint by name; KeyError lists the names."""
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(f"no joint {name!r}; joints are {', '.join(self.names)}") from None

    def indices(self, names: tuple[str, ...] | list[str]) -> list[int]:
        """Returns the indices of several joints by name."""
        return [self.index(name) for name in names]

    @cached_property
    def contact_indices(self) -> list[int]:
        """Indices of ``contact_names``."""
        return self.indices(self.contact_names)

    @cached_property
    def level_order(self) -> tuple[Tensor, Tensor, list[int], list[Tensor | None]]:
        """What :func:`fk` walks along: joints sorted by level, the way back, how many joints each level has, and for
        each below the root's the rows of its parents inside the level before (None: all of them, in order)."""
        levels, rows = [[0]], []
        while below := [joint for joint, parent in enumerate(self.parents) if parent in levels[-1]]:
            parents = [levels[-1].index(self.parents[joint]) for joint in below]
            same = parents == [*range(len(levels[-1]))]
            rows.append(None if same else torch.tensor(parents, device=self.offsets.device))
            levels.append(below)
        order = torch.tensor([joint for level in levels for joint in level], device=self.offsets.device)
        return order, order.argsort(), [len(level) for level in levels], rows

    @cached_property
    def mirror_indices(self) -> list[int]:
        """For each joint the index of its left-right partner (itself in the middle), by name."""
        swap = {"left_": "right_", "right_": "left_"}
        partner = [next((swap[s] + n[len(s) :] for s in swap if n.startswith(s)), n) for n in self.names]
        return self.indices(partner)

    def ancestors(self) -> Tensor:
        """Returns a boolean (J, J): entry (j, a) is True where joint a is j itself or above it."""
        above = torch.eye(len(self), dtype=torch.bool)
        for joint, parent in enumerate(self.parents[1:], start=1):
            above[joint] |= above[parent]
        return above

    def rest_positions(self, turned: Tensor | None = None) -> Tensor:
        """Computes joint positions (..., J, 3) of the rest pose, metres, rest frame, root at the origin.

        turned: rotations (J, 3, 3) of the joints against that frame, for offsets (J, 3).
        """
        positions = [torch.zeros_like(self.offsets[..., 0, :])]
        for joint, parent in enumerate(self.parents[1:], start=1):
            bone = self.offsets[..., joint, :]
            positions.append(positions[parent] + (bone if turned is None else turned[parent] @ bone))
        return torch.stack(positions, dim=-2)

    def standing_height(self) -> Tensor:
        """Computes the height (...) of the root above the floor when standing in the rest pose, metres."""
        return self.sole - self.rest_positions()[..., 1].amin(-1)

    def local(self, world: Tensor) -> Tensor:
        """Computes rotations against the parent (..., J, 3, 3) from those against the world, as :func:`fk` has them."""
        above = world[..., list(self.parents[1:]), :, :]
        return torch.cat((world[..., :1, :, :], above.mT @ world[..., 1:, :, :]), dim=-3)

    def scaled(self, factor: float) -> Self:
        """Returns the same skeleton, every length times ``factor``."""
        return replace(self, offsets=self.offsets * factor, sole=self.sole * factor)

    def to(self, *args, **kwargs) -> Self:
        """Returns the skeleton with offsets on another device or of another dtype."""
        return replace(self, offsets=self.offsets.to(*args, **kwargs))


def fk(skeleton: Skeleton, root: Tensor, rot: Tensor) -> tuple[Tensor, Tensor]:
    """Computes every joint's world position and orientation by forward kinematics.

    R_j = R_parent(j) rot_j,  p_j = p_parent(j) + R_parent(j) offset_j

    One step per level of the tree, with joint and matrix axes before batch and time axes: on a CPU twice as fast as
    batches of tiny matrix products. The results are views of that layout, not contiguous.

    Args:
        root: (..., 3) position of joint 0, metres, world.
        rot: (..., J, 3, 3) each joint relative to its parent, joint 0 relative to the world.

    Returns:
        positions (..., J, 3) in metres and orientations (..., J, 3, 3), world, both with the leading axes that
        root, rot and offsets broadcast to. Offsets with batch axes (one body per clip) broadcast against the
        axes before T: give them as (..., 1, J, 3).
    """
    check_shape(rot, f"... {len(skeleton)} 3 3", "rot")
    check_shape(root, "... 3", "root")
    offsets = skeleton.offsets
    batch = np.broadcast_shapes(root.shape[:-1], rot.shape[:-3], offsets.shape[:-2])  # torch's own imports sympy
    order, back, sizes, parents = skeleton.level_order
    offsets = offsets.index_select(-2, order).to(rot).expand(*batch, -1, 3).movedim((-2, -1), (0, 1))
    order, back = order.to(rot.device), back.to(rot.device)
    rot = rot.expand(*batch, -1, 3, 3).movedim((-3, -2, -1), (0, 1, 2)).index_select(0, order)
    positions, orientations = [root.expand(*batch, 3).movedim(-1, 0)[None]], [rot[:1]]
    for offset, turn, rows in zip(offsets.split(sizes)[1:], rot.split(sizes)[1:], parents, strict=True):
        up_pos, up_rot = positions[-1], orientations[-1]
        if rows is not None:
            up_pos, up_rot = (up.index_select(0, rows.to(up.device)) for up in (up_pos, up_rot))
        positions.append(up_pos + (up_rot * offset[:, None]).sum(2))
        orientations.append((up_rot[:, :, :, None] * turn[:, None]).sum(2))
    return (
        torch.cat(positions).index_select(0, back).movedim((0, 1), (-2, -1)),
        torch.cat(orientations).index_select(0, back).movedim((0, 1, 2), (-3, -2, -1)),
    )


_NAMES, _PARENTS, _OFFSETS = zip(
    # name, parent, offset in metres; the proportions of anny's average adult, straightened to a T
    ("pelvis", -1, (0.0, 0.0, 0.0)),
    ("left_hip", 0, (0.1146, -0.0092, -0.0081)), ("right_hip", 0, (-0.1146, -0.0092, -0.0081)),
    ("spine1", 0, (0.0, 0.0854, -0.0397)),
    ("left_knee", 1, (0.0, -0.4475, 0.0)), ("right_knee", 2, (0.0, -0.4475, 0.0)),
    ("spine2", 3, (0.0, 0.0753, 0.0157)),
    ("left_ankle", 4, (0.0, -0.4546, 0.0)), ("right_ankle", 5, (0.0, -0.4546, 0.0)),
    ("spine3", 6, (0.0, 0.0865, 0.0013)),
    ("left_foot", 7, (0.0054, -0.0710, 0.1380)), ("right_foot", 8, (-0.0054, -0.0710, 0.1380)),
    ("neck", 9, (0.0, 0.3387, 0.0177)),
    ("left_collar", 9, (0.0247, 0.2606, 0.0358)), ("right_collar", 9, (-0.0247, 0.2606, 0.0358)),
    ("head", 12, (0.0, 0.1089, 0.0381)),
    ("left_shoulder", 13, (0.1622, -0.0236, -0.0041)), ("right_shoulder", 14, (-0.1622, -0.0236, -0.0041)),
    ("left_elbow", 16, (0.2872, 0.0, 0.0)), ("right_elbow", 17, (-0.2872, 0.0, 0.0)),
    ("left_wrist", 18, (0.2580, 0.0, 0.0)), ("right_wrist", 19, (-0.2580, 0.0, 0.0)),
    strict=True,
)  # fmt: skip
ANKLES, BALLS = ("left_ankle", "right_ankle"), ("left_foot", "right_foot")  # a "foot" joint is its ball
#: The contact joints of the feet, in the order of ``STANDARD.contact_names``.
FEET = (*ANKLES, *BALLS)
#: HuMoR's nine, in HuMoR's order.
_CONTACTS = ("pelvis", "left_knee", "right_knee", *FEET, "left_wrist", "right_wrist")
#: The 22-joint standard: SMPL's body joints in SMPL's order.
STANDARD = Skeleton(_NAMES, _PARENTS, torch.tensor(_OFFSETS), _CONTACTS, sole=0.0097)
