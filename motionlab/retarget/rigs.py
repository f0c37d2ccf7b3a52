"""How known skeletons name their joints, and how their joints are turned in a T-pose."""

from __future__ import annotations

import re
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.skeleton import STANDARD, Skeleton


def _sides(**names: str) -> dict[str, str]:
    """Both sides: ``knee="{side}leg"`` gives left_knee = leftleg, right_knee = rightleg; ``{s}`` is l or r."""
    words = {"left": {"side": "left", "s": "l"}, "right": {"side": "right", "s": "r"}}
    return {f"{side}_{part}": name.format(**words[side]) for part, name in names.items() for side in words}


#: Names of the standard joints in each family, lower case, without prefix before a colon and without
#: separators. Spines are found by the hierarchy: families differ in how many joints they have.
RIGS: dict[str, dict[str, str]] = {
    "standard (SMPL)": {n: n.replace("_", "") for n in STANDARD.names if not n.startswith("spine")},
    "CMU ASF": {"pelvis": "root", "neck": "lowerneck", "head": "head"}
    | _sides(hip="{s}femur", knee="{s}tibia", ankle="{s}foot", foot="{s}toes")
    | _sides(collar="{s}clavicle", shoulder="{s}humerus", elbow="{s}radius", wrist="{s}wrist"),
    "Mixamo": {"pelvis": "hips", "neck": "neck", "head": "head"}
    | _sides(hip="{side}upleg", knee="{side}leg", ankle="{side}foot", foot="{side}toebase")
    | _sides(collar="{side}shoulder", shoulder="{side}arm", elbow="{side}forearm", wrist="{side}hand"),
    "Bandai-Namco": {"pelvis": "hips", "neck": "neck", "head": "head"}
    | _sides(hip="upperleg{s}", knee="lowerleg{s}", ankle="foot{s}", foot="toes{s}")
    | _sides(collar="shoulder{s}", shoulder="upperarm{s}", elbow="lowerarm{s}", wrist="hand{s}"),
    "DeepMimic": {"pelvis": "root", "neck": "neck"}
    | _sides(hip="{side}hip", knee="{side}knee", ankle="{side}ankle")
    | _sides(shoulder="{side}shoulder", elbow="{side}elbow", wrist="{side}wrist"),
    "AMP": {"pelvis": "pelvis", "neck": "head"}
    | _sides(hip="{side}thigh", knee="{side}shin", ankle="{side}foot")
    | _sides(shoulder="{side}upperarm", elbow="{side}lowerarm", wrist="{side}hand"),
    "ReActIdle": {"pelvis": "pelvis", "neck": "neck", "head": "face"}
    | _sides(hip="thigh{s}", knee="shin{s}", ankle="foot{s}", foot="foot{s}end")
    | _sides(collar="shoulder{s}", shoulder="upperarm{s}", elbow="forearm{s}", wrist="forearm{s}end"),
    "anny game_engine": {"pelvis": "pelvis", "neck": "neck01", "head": "head"}
    | _sides(hip="thigh{s}", knee="calf{s}", ankle="foot{s}", foot="ball{s}")
    | _sides(collar="clavicle{s}", shoulder="upperarm{s}", elbow="lowerarm{s}", wrist="hand{s}"),
    "anny default": {"pelvis": "root", "neck": "neck01", "head": "head"}
    | _sides(hip="upperleg01{s}", knee="lowerleg01{s}", ankle="foot{s}", foot="toe11{s}")
    | _sides(collar="clavicle{s}", shoulder="upperarm01{s}", elbow="lowerarm01{s}", wrist="wrist{s}"),
}

#: Skeletons whose zero pose is no human pose (every bone along its own x): where each joint's x, y and z
#: point in the T-pose, as Left, Right, Up, Down, Forward, Back of the body. Found from recordings: the mean
#: hinges of knees and elbows and the trunk's directions fall on these letters, most within 1 degree, all
#: within 8. A joint that is not named is turned like its parent.
AXES: dict[str, dict[str, str]] = {
    "Bandai-Namco": {"Hips": "URF", "Spine": "UFL"}
    | {"UpperLeg_L": "DLF", "Foot_L": "FLU", "UpperLeg_R": "ULB", "Foot_R": "BLD"}
    | {"Shoulder_L": "LUF", "Shoulder_R": "LDB"},
    "Rokoko": {"Hips": "LUF", "Spine": "URF"}
    | {"LeftUpLeg": "DLF", "LeftFoot": "FUR", "RightUpLeg": "DLF", "RightFoot": "FUR"}
    | {"LeftShoulder": "LUF", "RightShoulder": "RUB"},
}
_LETTERS = {"L": (1, 0, 0), "R": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
_NEEDED = ("pelvis", *(f"{s}_{part}" for s in ("left", "right") for part in ("hip", "knee", "ankle")))


@dataclass(frozen=True, eq=False)
class Match:
    """A source skeleton read as a body.

    rig: the family whose names fit. joints: standard name -> index in the source. rest_rot (J, 3, 3): each
    source joint in the T-pose-like rest, seen in body axes (x left, y up, z forward). rest (J, 3): its
    position there, metres. flat_feet: the rest pose is a figure's (its soles are flat), not one of axes.
    """

    rig: str
    joints: dict[str, int]
    rest_rot: Tensor
    rest: Tensor
    flat_feet: bool


def match(skeleton: Skeleton) -> Match:
    """Which joint is which, and the rest pose in body axes.

    The rest pose is the zero pose if that is a standing figure, else the one that ``AXES`` describes.

    Raises:
        DataError: no family has names for pelvis, hips, knees and ankles, or no rest pose stands.
    """
    plain = [re.sub(r"[^a-z0-9]|^mixamorig\d*", "", name.lower().rpartition(":")[2]) for name in skeleton.names]
    found = {rig: {k: plain.index(v) for k, v in names.items() if v in plain} for rig, names in RIGS.items()}
    rig = max(found, key=lambda name: len(found[name]))
    missing = [name for name in _NEEDED if name not in found[rig]]
    if missing:
        raise DataError(
            f"skeleton with joints {', '.join(skeleton.names[:8])}, ...: nearest to {rig}, but no {', '.join(missing)}",
            place="joint names",
            remedy="rename its joints to one of the families in motionlab.retarget.RIGS",
        )
    joints = found[rig] | _spine(skeleton, found[rig])
    zero = _zero_pose(skeleton, joints)
    poses = [zero] if zero is not None else []
    poses += [_axes_pose(skeleton, axes) for axes in AXES.values() if set(axes) <= set(skeleton.names)]
    for i, rest_rot in enumerate(poses):
        rest = _rest(skeleton, rest_rot)
        if _stands(rest, joints):
            return Match(rig, joints, rest_rot, rest, flat_feet=zero is not None and i == 0)
    raise DataError(
        f"{rig} names, but the zero pose is not a standing figure and its axes are not known",
        place="rest pose",
        remedy="export with a T-pose as the rest pose, or add the joints' axes to motionlab.retarget.rigs.AXES",
    )


def _spine(skeleton: Skeleton, joints: dict[str, int]) -> dict[str, int]:
    """Spine joints from the chain between the pelvis and what carries neck and shoulders."""

    def chain(joint: int) -> list[int]:
        path = []
        while joint not in (-1, joints["pelvis"]):
            path.append(joint)
            joint = skeleton.parents[joint]
        return path[::-1]

    tips = ("neck", "head", "left_collar", "right_collar", "left_shoulder", "right_shoulder")
    paths = [chain(joints[tip])[:-1] for tip in tips if tip in joints]
    shared = [j for j in min(paths, key=len, default=[]) if all(j in path for path in paths)]
    if not shared:
        return {}
    if len(shared) == 1:
        return {"spine3": shared[0]}
    middle = {"spine2": shared[len(shared) // 2]} if len(shared) > 2 else {}
    return {"spine1": shared[0], **middle, "spine3": shared[-1]}


def _rest(skeleton: Skeleton, rest_rot: Tensor) -> Tensor:
    rest = torch.zeros(len(skeleton), 3, dtype=torch.float64)
    for j, parent in enumerate(skeleton.parents[1:], start=1):
        rest[j] = rest[parent] + rest_rot[parent] @ skeleton.offsets[j].double()
    return rest


def _zero_pose(skeleton: Skeleton, joints: dict[str, int]) -> Tensor | None:
    """Body axes from file axes (J, 3, 3), read off the zero pose; right angles where they nearly are."""
    rest = _rest(skeleton, torch.eye(3, dtype=torch.float64).expand(len(skeleton), 3, 3))
    hips = rest[joints["left_hip"]], rest[joints["right_hip"]]
    left = hips[0] - hips[1]
    ankles = rest[joints["left_ankle"]] + rest[joints["right_ankle"]]
    up = sum(hips) / 2 - ankles / 2
    if torch.linalg.cross(left, up).norm() < 1e-3 * left.norm() * up.norm() or not left.norm() > 0:
        return None
    axes = []
    for vector in (up, left):
        unit = vector / vector.norm()
        axis = torch.zeros(3, dtype=torch.float64)
        axis[unit.abs().argmax()] = unit[unit.abs().argmax()].sign()
        axes.append(axis if unit @ axis > 0.9 else unit)
    up = axes[0]
    left = torch.nn.functional.normalize(axes[1] - (axes[1] @ up) * up, dim=0)
    return torch.stack((left, up, torch.linalg.cross(left, up))).expand(len(skeleton), 3, 3)


def _axes_pose(skeleton: Skeleton, axes: dict[str, str]) -> Tensor:
    pose: list[Tensor] = []
    for name, parent in zip(skeleton.names, skeleton.parents, strict=True):
        if name in axes:
            pose.append(torch.tensor([_LETTERS[letter] for letter in axes[name]], dtype=torch.float64).T)
        else:
            pose.append(pose[parent] if parent >= 0 else torch.eye(3, dtype=torch.float64))
    return torch.stack(pose)


def _stands(rest: Tensor, joints: dict[str, int]) -> bool:
    """Legs down, trunk up, left on the left, toes in front; 60 degrees of freedom each."""
    bones = [
        ((0, -1, 0), f"{s}_{a}", f"{s}_{b}") for s in ("left", "right") for a, b in (("hip", "knee"), ("knee", "ankle"))
    ]
    bones += [
        ((1, 0, 0), "right_hip", "left_hip"),
        ((0, 1, 0), "pelvis", "neck"),
        ((1, 0, 0), "right_shoulder", "left_shoulder"),
    ]
    for direction, a, b in bones:
        if a in joints and b in joints:
            bone = rest[joints[b]] - rest[joints[a]]
            if bone @ torch.tensor(direction, dtype=torch.float64) < 0.5 * bone.norm():
                return False
    feet = [rest[joints[f"{s}_foot"]] - rest[joints[f"{s}_ankle"]] for s in ("left", "right") if f"{s}_foot" in joints]
    return all(foot[2] >= 0 for foot in feet)
