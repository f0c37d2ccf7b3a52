"""Retargets a motion of any known skeleton to the standard 22 joints, with its error; feet that stand stay in place.

First how a skeleton is read, then the transfer there and back, then what that loses of a rig.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.ik import two_bone_ik
from motionlab.motion import Motion
from motionlab.rest import MOVED, SQUARE, ZERO, reframed, rest_poses
from motionlab.rigs import dropped_joints, find_joints, guessed_joints
from motionlab.skeleton import BALLS, FEET, STANDARD, Skeleton, fk

_EYE = torch.eye(3, dtype=torch.float64)
PLACE, ANGLE = 0.02, 5.0  # metres and degrees that the way there and back may cost a rig, at the 95th percentile
_LEG = ("hip", "knee", "ankle")
_LIMBS = ("hip", "knee", "shoulder", "elbow")  # a bone of these names points along the standard's own


@dataclass(frozen=True, eq=False)
class Match:
    """A source skeleton read as a body.

    joints: standard name -> index in the source. source: where its rest pose is taken from. rest_rot (J, 3, 3): each
    source joint in the T-pose-like rest, seen in body axes (x left, y up, z forward). rest (J, 3): its
    position there, metres.
    """

    joints: dict[str, int]
    source: str
    rest_rot: Tensor
    rest: Tensor


def match_joints(motion: Motion) -> Match:
    """Finds which joint of a motion's skeleton is which standard joint, and its rest pose in body axes.

    Raises:
        DataError: no pelvis, hips, knees and ankles are found, or no pose in which the figure stands.
    """
    motion = motion.to(torch.float64)
    joints = find_joints(motion.skeleton, motion.name)
    guessed = [name for name in guessed_joints(motion.skeleton, joints) if name in BALLS]
    for source, rest_rot, rest in rest_poses(motion, joints):
        for name in guessed:  # what no name says may be the heel: a ball of the foot lies ahead of its ankle
            bone = rest[joints[name]] - rest[joints[name.replace("foot", "ankle")]]
            joints = joints if bone[2] > 0.5 * bone.norm() else {n: j for n, j in joints.items() if n != name}
        return Match(joints, source, rest_rot, rest)
    told = ", ".join(f"{name} = {motion.skeleton.names[j]}" for name, j in joints.items())
    message = f"no pose is found in which the figure stands, its left on the left and its toes in front, if {told}"
    remedy = "say what is what by names=, on the command line --names FILE.json; or export with a T-pose as the rest "
    raise DataError(message, path=motion.name, place="rest pose", remedy=f"{remedy}pose or as the first frame")


# ---------------------------------------------------------------------------------------------------- transfer
@dataclass(frozen=True, eq=False)
class Retargeted:
    """A motion on the standard joints, and how well it fits its source.

    motion: on 22 joints named and turned as the standard's. residual: mean distance in metres between a
    target joint and the source joint it stands for, over frames and mapped joints, after scaling and the
    floor shift; what hangs on a joint that is lost counts as well. per_joint: the same for each of them.
    names: standard name -> source name. unmapped: standard joints that the source lacks; they keep their
    parent's orientation. scale: size of the target over the size of the file's figure. floor: metres by which
    the motion was raised. notes: what had to be decided.
    """

    motion: Motion
    residual: float
    per_joint: dict[str, float]
    names: dict[str, str]
    unmapped: tuple[str, ...]
    scale: float
    floor: float
    notes: tuple[str, ...]


def retarget(
    motion: Motion, *, proportions: str | Skeleton = "source", leg: float | None = None, floor: bool = True,
    plant: bool = True, names: Mapping[str, str] | None = None, body: Match | None = None,
) -> Retargeted:  # fmt: skip
    """Puts a motion of any known skeleton on the standard 22 joints.

    R_target = R_source G^T S: G turns a source joint's frame to body axes in its rest pose (see
    :func:`match_joints`), S turns the T-pose's bone to the source's bone in that rest pose
    by the shortest way. A source that faces forward at rest faces as ``UPRIGHT`` does. Joints that the source
    lacks keep their parent's orientation and share the way between their neighbours.

    Args:
        motion: one clip (T frames), metres, z up.
        proportions: "source" keeps the source's bone lengths and joint places, so the residual shows only
            what the standard tree cannot hold; "standard" takes those of ``STANDARD``, scaled so that thigh
            + shin are as long as the source's: the residual then holds every difference between the bodies.
            A skeleton of the 22 joints: as "standard", of that body. Any way the middle between the hips is where
            the source's is.
        leg: thigh + shin in metres to scale the whole recording to (figure and path); None: as it is.
        floor: raise the motion so that the lowest ball of the foot (2 % of the frames are lower) is at sole height.
        plant: with other proportions, bend the legs so that the ankles are as high as the source's and the
            balls of the feet over the same spots: a foot that stood still stands still. Without effect on
            "source".
        names: standard name -> the file's own, for what is not found by itself.
        body: how the skeleton is read; None: as :func:`match_joints` reads it off this motion.

    Raises:
        DataError: the skeleton's names or rest pose are not known, or the motion holds NaN or infinity.
        ShapeError: the motion has batch axes or no frames.
        ValueError: proportions or leg is none of the above.
    """
    if not check_shape(motion.root, "T 3", "motion.root")["T"]:
        raise ShapeError(f"{motion.name or 'motion'} has no frames")
    if not (motion.root.isfinite().all() and motion.rot.isfinite().all()):
        raise DataError("numbers that are not finite", path=motion.name, place="frames", remedy="cut or fill them")
    if not isinstance(proportions, Skeleton) and proportions not in ("source", "standard"):
        raise ValueError(f"proportions: expected 'source' or 'standard', got {proportions!r}")
    if leg is not None and not leg > 0:
        raise ValueError(f"leg: expected metres above zero, got {leg}")
    source = motion.to(torch.float64)
    if names:
        source = replace(source, skeleton=replace(source.skeleton, roles=names))
    body = body or match_joints(source)
    length = _leg_length(body)
    if not length > 0:
        raise DataError("legs of no length", path=motion.name, place="rest pose", remedy="check the offsets")
    scale = leg / length if leg else 1.0
    standing = (proportions if isinstance(proportions, Skeleton) else STANDARD).to(torch.float64)
    bones = standing.indices([f"{side}_{part}" for side in ("left", "right") for part in _LEG[1:]])
    standing = standing.scaled(scale * length / (float(standing.offsets[bones].norm(dim=-1).sum()) / 2))
    correction = _corrections(body)
    positions, world = source.world
    where = {name: scale * positions[:, j] for name, j in body.joints.items()}
    own = proportions == "source"
    skeleton = _source_proportions(body, correction, standing, scale) if own else standing
    rot = _rotations(body, correction, world)
    hips = (where["left_hip"] + where["right_hip"]) / 2
    below = skeleton.offsets[skeleton.indices(["left_hip", "right_hip"])].mean(0)
    target = Motion(skeleton, hips - rot[:, 0] @ below, rot, source.fps, name=motion.name)
    if plant and not own:
        target = two_bone_ik(target, _planted(target, where))
    balls = target.positions[:, skeleton.indices(FEET[2:])]
    lift = skeleton.sole - float(torch.quantile(balls[..., 2].amin(-1), 0.02)) if floor else 0.0
    up = torch.tensor([0.0, 0.0, lift], dtype=torch.float64)
    target, where = replace(target, root=target.root + up), {name: place + up for name, place in where.items()}
    error = {n: float((target.positions[:, STANDARD.index(n)] - p).norm(dim=-1).mean()) for n, p in where.items()}
    called, lost = source.skeleton.names, _lost(body, source.skeleton, positions, world)
    error |= {called[j]: scale * off for j, off in lost.items()}
    unmapped = tuple(name for name in STANDARD.names if name not in where)
    notes = [f"joints recognised: {len(where)} of {len(STANDARD)}"]
    notes += [f"how the joints are turned is taken from the {body.source}"] if body.source != ZERO else []
    way = "raised" if lift > 0 else "lowered"
    notes += [f"{way} by {abs(lift):.3f} m, so that the feet stand on the floor"] if abs(lift) > 0.0005 else []
    guesses = [f"{name} = {called[j]}" for name, j in guessed_joints(source.skeleton, body.joints).items()]
    notes += [f"said by no name, taken by their place: {', '.join(guesses)}"] if guesses else []
    notes += [f"the file has no {', '.join(unmapped)}: made up from the joints around"] if unmapped else []
    for j, off in lost.items():
        what = f"LOST: what {called[j]} does, as it is none of the joints found; what hangs on it is {off:.2f} m off"
        notes.append(f"{what} (say what it is: names=, on the command line --names)")
    moved, residual = replace(target, notes=(*motion.notes, *notes)).to(motion.root.dtype), sum(error.values())
    source_names = {name: called[j] for name, j in body.joints.items()}
    return Retargeted(moved, residual / len(error), error, source_names, unmapped, scale, lift, tuple(notes))


def retarget_onto(motion: Motion, rig: Motion) -> Retargeted:
    """Puts the movement of one motion on the rig of another: its bones, names and rest pose.

    By way of the 22 joints in the rig's proportions: the path is scaled as the legs are, feet that stood still stand
    still, on the floor. What the rig has besides stays as at rest.

    Args:
        motion: (T) on any joints that are found. rig: any motion of the rig; only its skeleton and rest pose count.

    Returns:
        Its motion is the rig's; all else is told of the 22 joints, and what is not carried over by its notes.

    Raises:
        DataError: as :func:`match_joints`, of either.
    """
    source, body = match_joints(motion), match_joints(rig)
    bones = retarget(rig.cut(0, 1), floor=False, body=body).motion.skeleton
    found = retarget(motion, proportions=bones, leg=_leg_length(body), body=source)
    made = put_on(found.motion, rig.skeleton, body)
    follow, every, off = len(body.joints), len(rig.skeleton), 100 * found.residual
    notes = [f"joints of the rig that follow: {follow} of {every}" + "; the others stay as at rest" * (follow < every)]
    notes += [f"scaled by {found.scale:.3f}, as the rig's legs are"]
    notes += [f"joints are {off:.1f} cm on average from where the file's are, as the bodies differ"]
    lacks = [name for name in source.joints if name not in body.joints]
    notes += [f"not carried over, as the rig has none: {', '.join(lacks)}"] if lacks else []
    skeleton, used = motion.skeleton, {*source.joints.values()}
    more = [skeleton.names[j] for j in range(len(skeleton)) if j not in used and j in skeleton.parents]
    notes += [f"not carried over, as they are none of the 22 joints: {', '.join(more)}"] if more else []
    made = replace(made, notes=(), name=motion.name).to(motion.root.dtype)
    return replace(found, motion=made, notes=(*found.notes, *notes))


def put_on(motion: Motion, skeleton: Skeleton, body: Match) -> Motion:
    """Puts a motion of the 22 joints on a skeleton that :func:`match_joints` has read: the way back of retargeting.

    R_source = R_target S^T G. A joint that stands for none of the 22 is turned against its parent as at rest; the
    middle between the hips is where the motion's is. Bones are the skeleton's.

    motion: (T) on the joints of ``STANDARD``.
    """
    world, places = motion.to(torch.float64).world[1], motion.to(torch.float64).positions
    correction, standard = _corrections(body), {j: STANDARD.index(name) for name, j in body.joints.items()}
    turned: list[Tensor] = []
    for j, parent in enumerate(skeleton.parents):
        above = turned[parent] @ body.rest_rot[parent].T if parent >= 0 else world[:, 0]
        above = world[:, standard[j]] @ correction[standard[j]].T if j in standard else above
        turned.append(above @ body.rest_rot[j])
    rot, skeleton = skeleton.local(torch.stack(turned, dim=1)), skeleton.to(torch.float64)
    own = fk(skeleton, torch.zeros_like(motion.root, dtype=torch.float64), rot)[0]
    hips = places[:, STANDARD.indices(["left_hip", "right_hip"])].mean(1)
    root = hips - own[:, [body.joints["left_hip"], body.joints["right_hip"]]].mean(1)
    return Motion(skeleton, root, rot, motion.fps, name=motion.name)


def with_rest(motion: Motion, pose: str) -> Motion:
    """Computes the same movement on a skeleton of which nothing is turned where it stands in a T, or with its arms half
    down in an A: what Blender, Unity and Unreal take for its rest pose.

    R' = R G^T S A^T: as :func:`retarget` to the T-pose, then A to the other; bones and places of joints stay.

    Args:
        motion: (T) on any joints that are found.
        pose: "t" or "a".

    Raises:
        DataError: as :func:`match_joints`.
    """
    body, skeleton = match_joints(motion), motion.skeleton
    quarter = {"left_shoulder": -0.25, "right_shoulder": 0.25} if pose == "a" else {}
    arms = {j: torch.tensor(quarter[name]).double() for name, j in body.joints.items() if name in quarter}
    correction = {j: _corrections(body)[STANDARD.index(name)] for name, j in body.joints.items()}
    frames, down = [], []
    for j, parent in enumerate(skeleton.parents):
        frames.append(correction[j] if j in correction else frames[parent] if parent >= 0 else _EYE)
        turned = rotation.rotation_about("z", torch.pi * arms[j]) if j in arms else _EYE
        down.append(turned @ down[parent] if parent >= 0 else turned)
    new = body.rest_rot.mT @ torch.stack(frames) @ torch.stack(down).mT
    turned, rot = reframed(skeleton.to(torch.float64), motion.rot.double(), new.mT)
    return replace(motion, skeleton=turned.to(skeleton.offsets), rot=rot.to(motion.rot))


def _lost(body: Match, skeleton: Skeleton, positions: Tensor, world: Tensor) -> dict[int, float]:
    """Joints of the file that no target joint follows: metres by which what hangs on them is off, were they rigid."""
    off = {}
    for j in dropped_joints(skeleton, body.joints):
        child, above = skeleton.parents.index(j), skeleton.parents[j]
        while above not in body.joints.values():
            above = skeleton.parents[above]
        rigid = world[:, above] @ (body.rest_rot[above].T @ (body.rest[child] - body.rest[above]))
        off[j] = float((positions[:, child] - positions[:, above] - rigid).norm(dim=-1).mean())
    return off


def _planted(target: Motion, where: dict[str, Tensor]) -> Tensor:
    """Where the target's ankles (T, 2, 3) go: the source's, shifted level so that the balls lie over the source's."""
    goals = []
    for side in ("left", "right"):
        ankle, ball = target.skeleton.indices([f"{side}_ankle", f"{side}_foot"])
        goal = where[f"{side}_ankle"]
        if f"{side}_foot" in where:
            shift = where[f"{side}_foot"] - goal - target.world[1][:, ankle] @ target.skeleton.offsets[ball]
            goal = goal + shift * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        goals.append(goal)
    return torch.stack(goals, dim=1)


def _leg_length(body: Match) -> float:
    ways = [[body.rest[body.joints[f"{side}_{part}"]] for part in _LEG] for side in ("left", "right")]
    return sum(float((k - h).norm() + (a - k).norm()) for h, k, a in ways) / 2


def _corrections(body: Match) -> Tensor:
    """S (22, 3, 3): from the T-pose's bone to the source's bone in its rest pose, in body axes.

    Limbs follow their bone. The trunk, whose joints carry several bones, keeps the rest pose's axes, and so
    does a foot whose sole is flat at rest, as a figure's is; hands follow the forearm.
    """
    limbs = (*_LIMBS, *(["ankle"] if body.source in (SQUARE, MOVED) else []))
    corrections: list[Tensor] = []
    for joint, name in enumerate(STANDARD.names):
        part, parent = name.rpartition("_")[2], STANDARD.parents[joint]
        child = next((n for n, p in zip(STANDARD.names, STANDARD.parents, strict=True) if p == joint), "")
        if name not in body.joints or part == "wrist":
            corrections.append(corrections[parent] if parent >= 0 else _EYE)
        elif child in body.joints and part in limbs:
            bone = body.rest[body.joints[child]] - body.rest[body.joints[name]]
            corrections.append(rotation.rotation_between(STANDARD.offsets[STANDARD.index(child)].double(), bone))
        else:
            corrections.append(_EYE)
    return torch.stack(corrections)


def _rotations(body: Match, correction: Tensor, world: Tensor) -> Tensor:
    """Local rotations (T, 22, 3, 3) of the target from the source's world orientations (T, J, 3, 3)."""
    turned: list[Tensor] = []
    for joint, name in enumerate(STANDARD.names):
        j, above = body.joints.get(name), STANDARD.parents[joint]
        turned.append(turned[above] if j is None else world[:, j] @ body.rest_rot[j].T @ correction[joint])
    return STANDARD.local(torch.stack(turned, dim=1))


def _source_proportions(body: Match, correction: Tensor, standing: Skeleton, scale: float) -> Skeleton:
    """The standard tree with the source's joint places: offset = S_ancestor^T (rest_joint - rest_ancestor).

    A joint without a source shares the straight way between its mapped neighbours by the standard's lengths.
    """
    offsets = standing.offsets.clone()
    for name, j in body.joints.items():
        way = [STANDARD.index(name)]
        while STANDARD.parents[way[-1]] >= 0 and STANDARD.names[STANDARD.parents[way[-1]]] not in body.joints:
            way.append(STANDARD.parents[way[-1]])
        ancestor = STANDARD.parents[way[-1]]
        if ancestor >= 0:
            bone = scale * (body.rest[j] - body.rest[body.joints[STANDARD.names[ancestor]]]) @ correction[ancestor]
            lengths = standing.offsets[way].norm(dim=-1, keepdim=True)
            offsets[way] = lengths / lengths.sum() * bone
    return replace(standing, offsets=offsets)


# ------------------------------------------------------------------------------------------------------- certificates
@dataclass(frozen=True)
class Certificate:
    """What the way of recordings of one rig to the standard 22 joints and back costs.

    rig: names and parents. file: the first recording. files: how many. joints: of the 22 that the rig has. source:
    where its rest pose is taken from. place, angle: metres and degrees by which the body's joints are off, at the
    95th percentile, in the worst recording. lost: joints that stand where one of the 22 is missing.
    """

    rig: tuple
    file: str
    files: int
    joints: int
    source: str
    place: float
    angle: float
    lost: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing is lost and the way costs no more than ``PLACE`` and ``ANGLE``."""
        return not self.lost and self.place <= PLACE and self.angle <= ANGLE


def by_rig(certificates: Iterable[Certificate]) -> list[Certificate]:
    """Returns the worst of every rig, in the order in which they come; rigs differ in names or tree."""
    found: dict[object, Certificate] = {}
    for row in certificates:
        old = found.get(row.rig, replace(row, files=0))
        place, angle = max(old.place, row.place), max(old.angle, row.angle)
        found[row.rig] = replace(old, files=old.files + row.files, place=place, angle=angle)
    return list(found.values())


def certify(motion: Motion) -> Certificate:
    """Certifies the rig of one recording (T frames).

    Raises:
        DataError: a skeleton whose joints are not known.
    """
    body, motion = match_joints(motion), motion.to(torch.float64)
    skeleton = motion.skeleton
    back = put_on(retarget(motion, floor=False, body=body).motion, skeleton, body)
    lost = dropped_joints(skeleton, body.joints)
    joints = {*body.joints.values(), *lost}
    for j in range(len(skeleton) - 1, 0, -1):  # what carries the body belongs to it, fingers and faces do not
        if j in joints and j != body.joints["pelvis"]:
            joints.add(skeleton.parents[j])
    joints = sorted(joints | {j for j, parent in enumerate(skeleton.parents) if parent in lost})
    off = (back.positions - motion.positions).norm(dim=-1), rotation.geodesic(back.world[1], motion.world[1])
    place, angle = (float(each[:, joints].flatten().quantile(0.95)) for each in (off[0], torch.rad2deg(off[1])))
    lost, rig = tuple(skeleton.names[j] for j in lost), (skeleton.names, skeleton.parents)
    return Certificate(rig, motion.name, 1, len(body.joints), body.source, place, angle, lost)
