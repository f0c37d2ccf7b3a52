"""How the joints of a figure are turned when it stands in a T, seen in body axes: x to its left, y up, z forward.

Many files hold such a pose: where nothing is turned, in a skin, or in the first frame. Others turn the axes of each
joint as they like. Then the pose is worked out from the movement: a bone lies where its child is, a knee or an elbow
bends about one axis, and what has neither is turned, on the whole, as what it hangs on.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from motionlab import rotation
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, Skeleton

ZERO, FIRST = "zero pose", "first frame, a T-pose"
SQUARE, MOVED = "movement, by right angles", "movement"

_BODY = torch.eye(3, dtype=torch.float64)  # left, up, front
_SKY = _BODY[2]  # the world is z up
_PAIRS = [(a, b) for a, b in permutations([*_BODY, *-_BODY], 2) if a @ b == 0]
_RIGHT_ANGLES = torch.stack([torch.stack((a, b, torch.linalg.cross(a, b))) for a, b in _PAIRS])
_SQUARE = 0.15  # radians: bones and hinges as near to an axis of their joint, on the whole, are meant to lie on it
_LIKE = 1.3  # radians: joints of such a rig whose means differ by less are turned alike; hands and heads hang
_STRAIGHT = 0.02  # a limb that bends less on the whole says little of its hinge
_LOW = 0.04  # metres: an ankle so near to its lowest may stand
_FRAMES = 2000  # are enough

#: A figure stands if these bones point so, within 60 degrees, and toes ahead.
_STANDING = (
    *((-_BODY[1], f"{s}_{a}", f"{s}_{b}") for s in ("left", "right") for a, b in (("hip", "knee"), ("knee", "ankle"))),
    (_BODY[0], "right_hip", "left_hip"),
    (_BODY[1], "pelvis", "neck"),
    (_BODY[0], "right_shoulder", "left_shoulder"),
)
_TOES = tuple((_BODY[2], f"{side}_ankle", f"{side}_foot") for side in ("left", "right"))
#: And so in a T, within 20.
_IN_A_T = tuple(
    (sign * _BODY[0], f"{s}_{a}", f"{s}_{b}")
    for s, sign in (("left", 1), ("right", -1))
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"))
)


def rest_poses(motion: Motion, joints: dict[str, int]) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yields where a rest pose is taken from, how the joints are turned in it (J, 3, 3), and where they are (J, 3),
    metres, for every one in which the figure stands; the surest first.

    Args:
        motion: one clip (T frames), float64, z up.
        joints: standard name -> joint.
    """
    arms = {name for _, *ends in _IN_A_T for name in ends} <= joints.keys()
    for source, pose in _candidates(motion, joints):
        if pose is not None:
            rest = motion.skeleton.rest_positions(pose)
            in_a_t = source != FIRST or (arms and _points(rest, joints, _IN_A_T, 0.94))
            if in_a_t and _points(rest, joints, _STANDING, 0.5) and _points(rest, joints, _TOES, 0.0):
                yield source, pose, rest


def _candidates(motion: Motion, joints: dict[str, int]) -> Iterator[tuple[str, Tensor | None]]:
    skeleton = motion.skeleton
    yield ZERO, _to_body(skeleton, _BODY.expand(len(skeleton), 3, 3), joints)
    if not looks_ahead(motion, joints):
        return
    means = _means(motion, joints, _BODY[2])
    if _is_square(means, joints):
        yield SQUARE, _squared(skeleton, means, joints)
    yield FIRST, _to_body(skeleton, motion.cut(0, 1).world[1][0], joints, 2.0)  # people face anywhere
    yield MOVED, _means(motion, joints, None)


def looks_ahead(motion: Motion, joints: dict[str, int]) -> bool:
    """Whether knees and toes are on the whole where the front is if left is left: sides may be swapped."""
    parts = ("hip", "knee", "ankle", "foot")
    pairs = ([joints.get(f"left_{part}", 0), joints.get(f"right_{part}", 0)] for part in parts)
    hip, knee, ankle, ball = (motion.positions[:, pair] for pair in pairs)
    front = torch.linalg.cross(hip[:, 0] - hip[:, 1], (hip - ankle).mean(1), dim=-1)
    toes = ball - ankle if "left_foot" in joints and "right_foot" in joints else torch.zeros_like(knee)
    return bool(((knee - (hip + ankle) / 2 + toes).mean(1) * front).sum(-1).mean() > 0)


def reframed(skeleton: Skeleton, rot: Tensor, frames: Tensor) -> tuple[Skeleton, Tensor]:
    """Computes offsets and rotations (T, J, 3, 3) of the same movement where ``frames`` (J, 3, 3) is the zero pose."""
    above = torch.cat((_BODY[None], frames[list(skeleton.parents[1:])]))
    if (frames - torch.eye(3)).abs().max() < 1e-6:
        return skeleton, rot
    return replace(skeleton, offsets=(above @ skeleton.offsets[..., None])[..., 0]), above @ rot @ frames.mT


def _to_body(skeleton: Skeleton, pose: Tensor, joints: dict[str, int], near: float = 0.9) -> Tensor | None:
    """A pose (J, 3, 3) in any axes, seen in the body's own, which are read off it: up and left are axes of the file
    where they nearly are, left by a cosine of ``near``."""
    rest = skeleton.rest_positions(pose)
    hips, ankles = ([rest[joints[f"{side}_{part}"]] for side in ("left", "right")] for part in ("hip", "ankle"))
    left, up = hips[0] - hips[1], sum(hips) / 2 - sum(ankles) / 2
    if torch.linalg.cross(left, up).norm() < 1e-3 * left.norm() * up.norm() or not left.norm() > 0:
        return None
    axes = []
    for vector, enough in ((up, 0.9), (left, near)):
        unit = vector / vector.norm()
        axis = torch.zeros(3, dtype=torch.float64)
        axis[unit.abs().argmax()] = unit[unit.abs().argmax()].sign()
        axes.append(axis if unit @ axis > enough else unit)
    up = axes[0]
    left = normalize(axes[1] - (axes[1] @ up) * up, dim=0)
    return torch.stack((left, up, torch.linalg.cross(left, up))) @ pose


def _points(rest: Tensor, joints: dict[str, int], bones: tuple, cosine: float) -> bool:
    """Whether those of the bones that are there point as they should."""
    there = [(way, rest[joints[b]] - rest[joints[a]]) for way, a, b in bones if a in joints and b in joints]
    return all(bone @ way >= cosine * bone.norm() for way, bone in there)


def _means(motion: Motion, joints: dict[str, int], foot: Tensor | None) -> Tensor:
    """How the joints are turned in a T (J, 3, 3), by what their bones and hinges do on the whole.

    A bone lies as in the standard's T-pose; about it a leg is turned so that the knee bends about the body's left, and
    an arm so that the elbow bends about the vertical. A limb that hardly bends is turned as the trunk. foot: where the
    ball of the foot lies from the ankle instead; axes that are drawn with a ruler are level there.
    """
    motion = motion.cut(None, None, -(-motion.frames // _FRAMES))
    where, world = motion.world
    at = {name: where[:, j] for name, j in joints.items()}
    left, up, _ = _BODY
    found: dict[int, Tensor] = {}

    def unit(a: str, b: str) -> Tensor:
        return normalize(at[b] - at[a], dim=-1)

    def put(name: str, first: Tensor, to_first: Tensor, second: Tensor, to_second: Tensor) -> None:
        if name in joints:
            own = _axes(*((world[:, joints[name]].mT @ x[..., None])[..., 0].mean(0) for x in (first, second)))
            if torch.linalg.det(own) > 0.5:  # else there is no bone, or nothing bends
                found[joints[name]] = _axes(to_first, to_second) @ own.T

    across = unit("right_hip", "left_hip")
    arms = "left_shoulder" in at and "right_shoulder" in at
    chest = unit("right_shoulder", "left_shoulder") if arms else across
    middle = {p: (at[f"left_{p}"] + at[f"right_{p}"]) / 2 for p in ("hip", "knee", "shoulder")[: 2 + arms]}
    top = middle["shoulder"] if arms else at.get("neck", at.get("head"))
    top = middle["hip"] if top is None else top
    whole = normalize(top - middle["knee"], dim=-1)
    trunk = normalize(top - middle["hip"], dim=-1) if top is not middle["hip"] else whole
    put("pelvis", across, left, whole, up)
    for name, side in (("spine1", across), ("spine2", across + chest), ("spine3", chest)):
        put(name, trunk, up, side, left)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        hip, knee, ankle, ball = (f"{side}_{part}" for part in ("hip", "knee", "ankle", "foot"))
        hinge = torch.linalg.cross(unit(hip, knee), unit(knee, ankle)) + _STRAIGHT * across
        for joint, child in ((hip, knee), (knee, ankle), (ankle, ball)):
            if child in at:
                put(joint, unit(joint, child), _bone(child) if foot is None or child != ball else foot, hinge, left)
        if ball not in at:  # its sole is flat where it stands
            low = at[ankle][:, 2] < at[ankle][:, 2].quantile(0.02) + _LOW
            stands = (low & (unit(ankle, knee)[:, 2] > 0.7))[:, None]
            put(ankle, torch.where(stands, _SKY, _STRAIGHT * unit(ankle, knee)), up, hinge, left)
        collar, shoulder, elbow, wrist = (f"{side}_{part}" for part in ("collar", "shoulder", "elbow", "wrist"))
        if collar in at and shoulder in at:
            put(collar, unit(collar, shoulder), _bone(shoulder), trunk, up)
        if shoulder in at and elbow in at and wrist in at:
            upper = unit(shoulder, elbow)
            body = torch.stack((chest, trunk, torch.linalg.cross(chest, trunk)), dim=-1)
            raised = rotation.rotation_between(_bone(elbow).expand_as(upper), (body.mT @ upper[..., None])[..., 0])
            hinge = torch.linalg.cross(upper, unit(elbow, wrist)) - _STRAIGHT * (body @ raised @ (sign * up))
            for joint, child in ((shoulder, elbow), (elbow, wrist)):
                put(joint, unit(joint, child), _bone(child), hinge, -sign * up)
    pose: list[Tensor] = []
    for j, parent in enumerate(motion.skeleton.parents):
        own = rotation.mean(motion.rot[:, j]) if parent >= 0 else _BODY
        pose.append(found[j] if j in found else (pose[parent] if parent >= 0 else _BODY) @ own)
    return torch.stack(pose)


def _bone(child: str) -> Tensor:
    """The direction of a bone in the standard's T-pose."""
    return normalize(STANDARD.offsets[STANDARD.index(child)].double(), dim=0)


def _axes(first: Tensor, second: Tensor) -> Tensor:
    """A right-handed frame: the first axis along ``first``, the second as near to ``second`` as can be."""
    a = normalize(first, dim=0)
    b = normalize(second - (second @ a) * a, dim=0)
    return torch.stack((a, b, torch.linalg.cross(a, b)), dim=1)


def _square(turn: Tensor) -> Tensor:
    """The nearest turn by right angles."""
    return _RIGHT_ANGLES[(_RIGHT_ANGLES * turn).sum((1, 2)).argmax()]


def _is_square(means: Tensor, joints: dict[str, int]) -> bool:
    """Whether thighs, shins and upper arms lie along an axis of their joint, and bend about one, on the whole."""
    limbs = [joints.get(f"{side}_{part}") for side in ("left", "right") for part in ("hip", "knee", "shoulder")]
    off = torch.stack([rotation.geodesic(_square(means[j]), means[j]) for j in limbs if j is not None])
    return bool(off.mean() < _SQUARE and off.max() < 3 * _SQUARE)


def _squared(skeleton: Skeleton, means: Tensor, joints: dict[str, int]) -> Tensor:
    """The means by right angles: a joint is turned as its parent, or else by the nearest.

    A forearm or hand whose bone lies as its parent's is turned alike: how it twists on the whole says nothing.
    """
    along = torch.zeros_like(skeleton.offsets)
    along.index_add_(0, torch.tensor(skeleton.parents[1:]), skeleton.offsets[1:])
    twists = {joints.get(f"{side}_{part}") for side in ("left", "right") for part in ("elbow", "wrist")}
    pose: list[Tensor] = []
    for j, parent in enumerate(skeleton.parents):
        alike = parent >= 0 and rotation.geodesic(pose[parent], means[j]) < _LIKE
        alike |= j in twists and bool(along[j].abs().argmax() == along[parent].abs().argmax())
        pose.append(pose[parent] if alike else _square(means[j]))
    return torch.stack(pose)
