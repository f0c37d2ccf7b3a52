"""From a score to a motion: evaluate the channels, solve the pose of every frame at once, and say what was planned."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from data_synth.anatomy import RADIUS, clearance, height_at_rest
from data_synth.curves import evaluate, noise, ramp, soft_clip, soft_min
from data_synth.legs import foot_pose, hanging, heading_rotation, two_bone, unit
from data_synth.score import CHANNELS, SIDED, SIDES, SIGN, Score
from data_synth.subjects import Subject
from motionlab.motion import Motion
from motionlab.rotation import rotation_about, sixd_to_matrix
from motionlab.skeleton import fk

#: Standard deviation of the natural noise per channel, metres or radians.
NOISE = {
    "sway": 0.0035, "surge": 0.0035, "z": 0.0015, "yaw": 0.012, "pitch": 0.010, "tilt": 0.007,
    "flex": 0.014, "bend": 0.012, "twist": 0.016, "nod": 0.03, "turn": 0.05, "cock": 0.02,
    "raised": 0.035, "abduct": 0.02, "rotate": 0.04, "elbow": 0.05, "pronate": 0.06, "wrist": 0.04, "shrug": 0.01,
}  # fmt: skip
KNEE = RADIUS["left_knee"]
#: A pelvis lower than this is that of someone who sits or lies on the floor, metres.
DOWN = 0.35
#: A joint of such a body touches the floor within this of its height at rest, metres, and below this speed, m/s.
LYING, STILL = 0.005, 0.028


@dataclass(frozen=True, eq=False)
class Take:
    """A performance with what is known about it.

    motion: with contacts for skeleton.contact_names. labels: the action of each frame. phase (T,): where
    in its cycle (gait: 0 = left heel strike) or in its course (else) the action is, in [0, 1). subject: who.
    """

    motion: Motion
    labels: tuple[str, ...]
    phase: Tensor
    subject: Subject


def perform(score: Score, fps: float = 30.0) -> Take:
    """Play a score from time 0 to the time reached, at any frame rate.

    Feet, knees and hands that the score plants stay where they are; the pelvis gives way to them.
    """
    frames = max(2, round(score.now * fps))
    t = torch.arange(frames, dtype=torch.float64) / fps
    control = _controls(score, t)
    skeleton, name = score.subject.skeleton.to(torch.float64), "+".join(dict.fromkeys(x for *_, x in score.labels))
    root, rot = solve(score.subject, control)
    motion = _resting(Motion(skeleton, root, rot, fps, _planned_contacts(score, t), name), control["settle"])
    return Take(motion.to(torch.float32), *_course(score, t), score.subject)


def _controls(score: Score, t: Tensor) -> dict[str, Tensor]:
    initial = [score.initial[name] for name in CHANNELS]
    names, *columns = zip(*score.pieces, strict=True) if score.pieces else ((), (), (), ())
    channel = torch.tensor([CHANNELS.index(name) for name in names], dtype=torch.long)
    initial, start, duration, pieces = (torch.tensor(x, dtype=torch.float64) for x in (initial, *columns))
    curves = evaluate(initial, channel, start, duration, pieces.reshape(-1, 5), t)
    control = dict(zip(CHANNELS, curves, strict=True))
    noisy = {name: part for name in CHANNELS if (part := name.removeprefix("left_").removeprefix("right_")) in NOISE}
    generator = torch.Generator().manual_seed(int(torch.randint(2**31, (), generator=score.generator)))
    awake = 1 - 0.8 * control["settle"].clamp(0, 1)
    for (name, part), row in zip(noisy.items(), noise(t, len(noisy), generator), strict=True):
        control[name] = control[name] + NOISE[part] * score.subject.restless * row * awake
    breath = (2 * math.pi * 0.26 * score.subject.tempo * t).sin()
    control["flex"] = control["flex"] - 0.008 * breath
    for side in SIDES:
        control[f"{side}_shrug"] = control[f"{side}_shrug"] + 0.012 * breath
    return control


def solve(subject: Subject, c: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Root (T, 3) and local rotations (T, 22, 3, 3) from the channels (T,)."""
    skeleton = subject.skeleton.to(torch.float64)
    name = skeleton.index
    frames = len(c["x"])
    rot = torch.eye(3, dtype=torch.float64).expand(frames, len(skeleton), 3, 3).clone()
    heading = heading_rotation(c["heading"] + c["yaw"])
    tip = rotation_about("x", c["pitch"]) @ rotation_about("y", c["roll"]) @ rotation_about("z", c["tilt"])
    pelvis_rot = heading @ tip
    cos, sin = c["heading"].cos(), c["heading"].sin()
    x = c["x"] - cos * c["sway"] - sin * c["surge"]
    y = c["y"] - sin * c["sway"] + cos * c["surge"]
    pelvis = torch.stack((x, y, c["z"]), -1)

    for joint, share in (("spine1", 0.35), ("spine2", 0.35), ("spine3", 0.30)):
        bend = rotation_about("x", share * c["flex"]) @ rotation_about("z", share * c["bend"])
        rot[:, name(joint)] = bend @ rotation_about("y", share * c["twist"])
    steady = 0.85 * c["steady"]
    nod = soft_clip(c["nod"] - steady * (c["pitch"] + c["flex"]), -0.9, 0.75, 0.25)
    turn = soft_clip(c["turn"] - steady * (c["yaw"] + c["twist"]), -1.1, 1.1, 0.3)
    cock = soft_clip(c["cock"] - steady * (c["tilt"] + c["bend"]), -0.6, 0.6, 0.2)
    half = rotation_about("y", turn / 2) @ rotation_about("x", nod / 2) @ rotation_about("z", cock / 2)
    rot[:, skeleton.indices(["neck", "head"])] = half[:, None]

    sides = {side: c | {part: c[f"{side}_{part}"] for part in SIDED} for side in SIDES}
    offsets = {side: skeleton.offsets[name(f"{side}_foot")] for side in SIDES}
    feet = {side: foot_pose(own, offsets[side], skeleton.sole) for side, own in sides.items()}
    hips = {side: (pelvis_rot @ skeleton.offsets[name(f"{side}_hip")][:, None])[..., 0] for side in SIDES}
    pelvis = _kneel(pelvis, hips, feet, c, subject)
    pelvis = _within_reach(pelvis, hips, feet, c, subject)
    for side, own in sides.items():
        _leg(rot, pelvis + hips[side], pelvis_rot, feet[side], own, side, subject)
        _arm_angles(rot, own, side, subject)
    rot[:, 0] = pelvis_rot
    pelvis = _settle(pelvis, rot, c, subject)
    if any(c[f"{side}_grip"].any() for side in SIDES):
        positions, orientations = fk(skeleton, pelvis, rot)
        for side, own in sides.items():
            _arm_reach(rot, positions, orientations, own, side, subject)
    return pelvis, rot


def _knee_on_floor(foot: tuple[Tensor, Tensor], yaw: Tensor, subject: Subject) -> Tensor:
    """Where the knee of a kneeling leg touches the floor, in front of its ankle."""
    ankle = foot[0]
    shin = subject.length("left_ankle")
    ahead = (shin**2 - (ankle[:, 2] - KNEE).square()).clamp(min=0.01).sqrt()
    way = torch.stack((-yaw.sin(), yaw.cos()), -1)
    return torch.cat((ankle[:, :2] + ahead[:, None] * way, torch.full_like(ankle[:, :1], KNEE)), -1)


def _kneel(pelvis: Tensor, hips: dict, feet: dict, c: dict[str, Tensor], subject: Subject) -> Tensor:
    """Shift the pelvis as little as possible so that the thighs of planted knees keep their length. Least |shift|^2 +
    sum w / (1 - w) error^2, w the weight of ``kneel``: exact at 1, no effect at 0."""
    weight = {side: c[f"{side}_kneel"] for side in SIDES}
    if not any(w.any() for w in weight.values()):
        return pelvis
    moved = pelvis
    slack = torch.stack([(1 - w) / w.clamp(min=1e-9) for w in weight.values()], -1).clamp(min=1e-8)
    thigh = subject.length("left_knee")
    knees = {side: _knee_on_floor(feet[side], c[f"{side}_foot_yaw"], subject) for side in SIDES}
    for _ in range(8):
        rows, residual = [], []
        for side in SIDES:
            line = moved + hips[side] - knees[side]
            length = torch.linalg.vector_norm(line, dim=-1)
            rows.append(line / length[:, None])
            residual.append(length - thigh)
        jacobian, error = torch.stack(rows, 1), torch.stack(residual, 1)[..., None]
        gram = jacobian @ jacobian.mT + torch.diag_embed(slack)
        error = error + jacobian @ (pelvis - moved)[..., None]
        moved = pelvis - (jacobian.mT @ torch.linalg.solve(gram, error))[..., 0]
    return moved


def _within_reach(pelvis: Tensor, hips: dict, feet: dict, c: dict[str, Tensor], subject: Subject) -> Tensor:
    """Lower the pelvis where a standing leg would have to be longer than it is (the compass of gait). A foot in the air
    has leave to hang back, by 0.3 of its height."""
    longest = 0.9985 - 0.06 * c["low"]
    soft = 0.002 + 0.06 * c["low"]
    limits = [pelvis[:, 2]]
    for side, hip in hips.items():
        away = feet[side][0][:, :2] - (pelvis + hip)[:, :2]
        up = ((longest * subject.leg) ** 2 - away.square().sum(-1)).clamp(min=0.01).sqrt()
        free = 0.3 * c[f"{side}_lift"].clamp(min=0) + 3 * (c[f"{side}_loose"] + c[f"{side}_kneel"] + c["air"])
        limits.append(feet[side][0][:, 2] + up - hip[:, 2] + free)
    return torch.cat((pelvis[:, :2], soft_min(torch.stack(limits, -1), soft)[:, None]), -1)


def _leg(rot, hip, pelvis_rot, foot, c, side, subject) -> None:
    name = subject.skeleton.index
    ankle, foot_rot = foot
    thigh, shin = subject.length("left_knee"), subject.length("left_ankle")
    left = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    sign = SIGN[side]
    yaw_left = heading_rotation(c["foot_yaw"])[..., 0]
    hinge = unit(0.55 * yaw_left + 0.45 * (pelvis_rot @ left))
    hinge = (rotation_about("z", sign * c["splay"]) @ hinge[..., None])[..., 0]
    kneel = c["kneel"][:, None]
    if kneel.any():
        knee = _knee_on_floor(foot, c["foot_yaw"], subject)
        hinge = unit(hinge + kneel * (unit(torch.linalg.cross(hip - ankle, knee - ankle, dim=-1)) - hinge))
    loose = c["loose"][:, None]
    if loose.any():
        thigh_rot = pelvis_rot @ rotation_about("x", -c["hip_flex"]) @ rotation_about("z", sign * c["hip_abduct"])
        thigh_rot = thigh_rot @ rotation_about("y", sign * c["hip_twist"])
        shin_rot = thigh_rot @ rotation_about("x", c["knee"])
        free_ankle = hip - thigh * thigh_rot[..., 1] - shin * shin_rot[..., 1]
        ankle = ankle + loose * (free_ankle - ankle)
        hinge = unit(hinge + loose * (thigh_rot[..., 0] - hinge))
        free_foot = shin_rot @ rotation_about("x", c["ankle"])
        mixed = foot_rot[..., :2] + loose[..., None] * (free_foot - foot_rot)[..., :2]
        foot_rot = sixd_to_matrix(mixed.mT.reshape(*mixed.shape[:-2], 6))
    hanging_back = ramp(c["lift"] / (0.012 + 0.06 * c["air"]) + c["loose"])
    ease = 0.02 * hanging_back + 0.07 * (c["bent"] + c["low"])
    upper, lower, axis = two_bone(hip, ankle, hinge, thigh, shin, ease)
    # local x along the hinge, local -y along the bone
    thigh_rot, shin_rot = (torch.stack((axis, -b, torch.linalg.cross(axis, -b, dim=-1)), -1) for b in (upper, lower))
    foot_rot = hanging(foot_rot, shin_rot, ramp(c["lift"] / 0.015))
    rot[:, name(f"{side}_hip")] = pelvis_rot.mT @ thigh_rot
    rot[:, name(f"{side}_knee")] = thigh_rot.mT @ shin_rot
    rot[:, name(f"{side}_ankle")] = shin_rot.mT @ foot_rot
    toes = soft_clip(c["heel"], -0.7, 1.38, 0.12) * (1 - loose[:, 0])
    rot[:, name(f"{side}_foot")] = rotation_about("x", -toes)


def _arm_angles(rot, c, side, subject) -> None:
    name = subject.skeleton.index
    sign = SIGN[side]
    upper = rotation_about("x", -c["raised"]) @ rotation_about("z", sign * (c["abduct"] - math.pi / 2))
    upper = upper @ rotation_about("x", -c["rotate"])
    way = sign * upper[..., 0]  # of the upper arm, in the thorax
    high, ahead = way[:, 1], way[:, 2]
    shrug = 0.45 * ramp((high + 0.75) / 1.75) + c["shrug"] - 0.02
    reach = 0.22 * ramp((ahead + 0.2) / 1.2) - 0.02
    collar = rotation_about("y", -sign * reach) @ rotation_about("z", sign * shrug)
    rot[:, name(f"{side}_collar")] = collar
    rot[:, name(f"{side}_shoulder")] = collar.mT @ upper
    elbow = soft_clip(c["elbow"], 0.03, 2.55, 0.12)
    rot[:, name(f"{side}_elbow")] = rotation_about("y", -sign * elbow)
    rot[:, name(f"{side}_wrist")] = rotation_about("x", -c["pronate"]) @ rotation_about("z", sign * -c["wrist"])


def _arm_reach(rot, positions, orientations, c, side, subject) -> None:
    """Bring the wrist to the place that the score gives, by the weight of the grip."""
    name = subject.skeleton.index
    sign = SIGN[side]
    grip = c["grip"][:, None]
    shoulder, wrist = positions[:, name(f"{side}_shoulder")], positions[:, name(f"{side}_wrist")]
    place = torch.stack([c[f"hand_{axis}"] for axis in "xyz"], -1)
    target = wrist + grip * (place - wrist)
    target = target + 0.2 * grip * (1 - grip) * target.new_tensor([0.0, 0.0, 1.0])  # it comes from above
    swing = orientations[:, name(f"{side}_shoulder"), :, 1]
    ease = (0.02 * grip + 0.4 * grip * (1 - grip))[:, 0]  # on the way no elbow snaps straight
    lengths = subject.length("left_elbow"), subject.length("left_wrist")
    *bones, axis = two_bone(shoulder, target, -sign * swing, *lengths, ease)
    frames = ((sign * bone, -sign * axis, torch.linalg.cross(sign * bone, -sign * axis, dim=-1)) for bone in bones)
    upper_rot, lower_rot = (torch.stack(frame, -1) for frame in frames)
    used = (grip > 0)[..., None]
    at, elbow = name(f"{side}_shoulder"), name(f"{side}_elbow")
    rot[:, at] = torch.where(used, orientations[:, name(f"{side}_collar")].mT @ upper_rot, rot[:, at])
    rot[:, elbow] = torch.where(used, upper_rot.mT @ lower_rot, rot[:, elbow])


def _settle(pelvis: Tensor, rot: Tensor, c: dict[str, Tensor], subject: Subject) -> Tensor:
    """Lay the body on the floor: raise or lower it until its lowest part touches, by the weight of ``settle``. An arm
    whose hand has a place of its own does not count."""
    weight = c["settle"]
    if not weight.any():
        return pelvis
    skeleton = subject.skeleton.to(torch.float64)
    above = clearance(skeleton, *fk(skeleton, pelvis, rot))
    for side in SIDES:
        for part in ("elbow", "wrist"):
            above[:, list(RADIUS).index(f"{side}_{part}")] += c[f"{side}_grip"]
    return torch.cat((pelvis[:, :2], (pelvis[:, 2] - weight * soft_min(above, 0.006))[:, None]), -1)


# ----------------------------------------------------------------------------------------------- what is known of it
def _planned_contacts(score: Score, t: Tensor) -> Tensor:
    """Contacts (T, C) of the joints that the score plants."""
    names = score.subject.skeleton.contact_names
    contacts = torch.zeros(len(t), len(names), dtype=torch.float64)
    for joint, start, stop in [*score.contacts, *((joint, start, math.inf) for joint, start in score.planted.items())]:
        contacts[(t >= start - 1e-9) & (t <= stop + 1e-9), names.index(joint)] = 1
    return contacts


def _resting(motion: Motion, settle: Tensor) -> Motion:
    """Add the contacts of a body on the floor: joints at the floor that keep still.

    Pelvis: within 4 cm of its thickness. The others, while it is lower than DOWN: within LYING of their height at
    rest. Still: slower than STILL before and after.
    """
    names, points = motion.skeleton.contact_names, motion.positions[:, motion.skeleton.contact_indices]
    rest = torch.tensor([height_at_rest(motion.skeleton, name) for name in names], dtype=torch.float64)
    step = points.diff(dim=0).norm(dim=-1) * motion.fps
    still = (torch.cat((step, step[-1:])) < STILL) & (torch.cat((step[:1], step)) < STILL)
    touching = (motion.root[:, 2:] < DOWN) & ((points[..., 2] - rest).abs() < LYING)
    lying = ((motion.root[:, 2] - RADIUS["pelvis"]).abs() < 0.04) & (settle > 0.999)
    touching[:, names.index("pelvis")] = lying
    return replace(motion, contacts=torch.maximum(motion.contacts, (touching & still).to(motion.contacts)))


def _course(score: Score, t: Tensor) -> tuple[tuple[str, ...], Tensor]:
    """Label and phase of every frame; the innermost action that covers a frame names it."""
    labels, phase = ["idle"] * len(t), torch.zeros(len(t))
    for start, stop, label in sorted(score.labels, key=lambda mark: mark[0] - mark[1]):
        inside = (t >= start - 1e-9) & (t < stop - 1e-9)
        labels = [label if here else was for here, was in zip(inside.tolist(), labels, strict=True)]
        phase[inside] = ((t[inside] - start) / (stop - start)).clamp(0, 0.9999).float()
    for (start, cycle), (stop, after) in pairwise(sorted(score.gait)):
        if after > cycle:
            inside = (t >= start) & (t < stop)
            phase[inside] = ((cycle + (after - cycle) * (t[inside] - start) / (stop - start)) % 1).float()
    return tuple(labels), phase
