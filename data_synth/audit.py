"""Is a motion what ground truth should be? Feet that stand, bodies above the floor, joints within reach, no pop."""

from dataclasses import dataclass

import torch
from torch import Tensor

from data_synth.anatomy import clearance, excess, height_at_rest
from data_synth.perform import DOWN, LYING
from motionlab.metrics import mean_acceleration
from motionlab.motion import Motion

#: Half the depth of the trunk, how much more its half width is, and half of a forearm, metres.
TRUNK, FLANK, ARM = 0.10, 0.04, 0.03


@dataclass(frozen=True)
class Audit:
    """The worst of a motion.

    contact_speed: metres per frame, of a joint whose contact is on in this frame and the next.
    contact_height: metres between such a joint and its height at rest on the floor.
    penetration: metres below the floor, of heel, ball, toes, or the body's thickness around any other joint.
    limit_excess: degrees beyond the anatomical range; at: which joint and angle.
    arm_depth: metres by which an arm is inside the trunk.
    mean_acceleration: m/s^2, over joints and frames.
    """

    contact_speed: float
    contact_height: float
    penetration: float
    limit_excess: float
    at: str
    arm_depth: float
    mean_acceleration: float


def audit(motion: Motion) -> Audit:
    """Measure a motion on a skeleton with the standard joint names; without contacts the contact figures are 0.

    At rest, feet and ankles are at the height of the flat foot, knees and wrists at their thickness, the pelvis (on
    back, belly or side) anywhere within 4 cm of its; while it is lower than DOWN, the others within LYING of theirs.
    """
    motion = motion.to(torch.float64)
    skeleton, points = motion.skeleton, motion.positions[..., motion.skeleton.contact_indices, :]
    height = points[..., 2]
    on = torch.zeros_like(height) if motion.contacts is None else motion.contacts
    speed = points.diff(dim=-3).norm(dim=-1) * (on[..., 1:, :] * on[..., :-1, :])
    rest = torch.tensor([height_at_rest(skeleton, name) for name in skeleton.contact_names]).to(height)
    pelvis = skeleton.contact_names.index("pelvis")
    loose = LYING * (height[..., pelvis : pelvis + 1] < DOWN).to(height).expand_as(height).clone()
    loose[..., pelvis] = 0.04
    beyond = excess(skeleton, motion.rot)
    worst = max(beyond, key=lambda key: float(beyond[key].max()))
    return Audit(
        contact_speed=float(speed.max()),
        contact_height=float((((height - rest).abs() - loose).clamp(min=0) * on).max()),
        penetration=float(-clearance(skeleton, *motion.world).min().clamp(max=0)),
        limit_excess=float(beyond[worst].max()),
        at=" ".join(worst),
        arm_depth=float(arm_depth(motion).max()),
        mean_acceleration=float(mean_acceleration(motion.positions, motion.fps).mean()),
    )


def arm_depth(motion: Motion) -> Tensor:
    """Metres (..., T) by which forearms and the lower halves of upper arms are inside the trunk.

    Trunk: TRUNK metres around the strip FLANK to both sides of the line from pelvis to spine3. Arms: ARM metres
    around nine points each.
    """
    p, orientations = motion.world
    low, high = (p[..., motion.skeleton.index(name), :] for name in ("pelvis", "spine3"))
    along = high - low
    points = []
    for side in ("left", "right"):
        arm = motion.skeleton.indices([f"{side}_{name}" for name in ("shoulder", "elbow", "wrist")])
        shoulder, elbow, wrist = p[..., arm, :].unbind(-2)
        points += [shoulder + share * (elbow - shoulder) for share in (0.5, 0.6, 0.7, 0.8)]
        points += [elbow + share * (wrist - elbow) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    off = torch.stack(points, -2) - low[..., None, :]
    share = ((off * along[..., None, :]).sum(-1) / along.square().sum(-1)[..., None]).clamp(0, 1)
    off = off - share[..., None] * along[..., None, :]
    left = orientations[..., motion.skeleton.index("spine1"), :, 0][..., None, :]
    aside = (off * left).sum(-1, keepdim=True).clamp(-FLANK, FLANK)
    distance = (off - aside * left).norm(dim=-1)
    return (TRUNK + ARM - distance).clamp(min=0).amax(-1)
