"""Measures what windows of motion are like, in a few physical numbers, so that sets of them can be compared."""

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.contact import with_contacts
from motionlab.metrics.pose import jitter
from motionlab.motion import Motion, velocity
from motionlab.skeleton import FEET

#: What :func:`describe` measures, with its unit.
DESCRIPTION_UNITS = {
    "root speed": "m/s", "turning rate": "deg/s", "joint speed": "m/s", "joint acceleration": "m/s^2",
    "jitter": "m/s^3", "quick motion": "% above 4 Hz", "feet on the floor": "%", "foot height": "m",
    "knee flexion": "deg", "elbow flexion": "deg", "trunk lean": "deg", "hand height": "m",
}  # fmt: skip


def describe(motion: Motion) -> dict[str, Tensor]:
    """Computes a physical summary of each window of motions on the standard joints: ``DESCRIPTION_UNITS`` -> (...).

    Means over the T frames of a window (and over the joints or sides concerned); the root moves on the floor
    plane only; heights are above z = 0; flexion is the angle between the two bones of a limb; quick motion is the
    share of the joints' velocity power above 4 Hz; floor contacts are measured, never taken from labels.
    """
    p, fps, index = motion.positions, motion.fps, motion.skeleton.index
    pelvis, world = p[..., 0, :], motion.world[1]
    moving = velocity(p, fps, dim=-3)
    second = p.diff(n=2, dim=-3) * fps**2
    turn = rotation.geodesic(world[..., :-1, 0, :, :], world[..., 1:, 0, :, :]) * fps
    trunk = torch.nn.functional.normalize(p[..., index("neck"), :] - pelvis, dim=-1)
    feet = [motion.skeleton.contact_names.index(name) for name in FEET]
    hands = p[..., [index("left_wrist"), index("right_wrist")], 2]
    return {
        "root speed": moving[..., 0, :2].norm(dim=-1).mean(-1),
        "turning rate": torch.rad2deg(turn).mean(-1),
        "joint speed": moving.norm(dim=-1).mean((-1, -2)),
        "joint acceleration": second.norm(dim=-1).mean((-1, -2)),
        "jitter": jitter(p, fps),
        "quick motion": 100 * _power_above(moving - moving.mean(-3, keepdim=True), fps, 4.0),
        "feet on the floor": 100 * with_contacts(motion).contacts[..., feet].mean((-1, -2)),
        "foot height": p[..., motion.skeleton.indices(FEET), 2].mean((-1, -2)),
        "knee flexion": _flexion(motion, "hip", "knee", "ankle"),
        "elbow flexion": _flexion(motion, "shoulder", "elbow", "wrist"),
        "trunk lean": torch.rad2deg(torch.acos(trunk[..., 2].clamp(-1, 1))).mean(-1),
        "hand height": hands.mean((-1, -2)),
    }


def _power_above(moving: Tensor, fps: float, hertz: float) -> Tensor:
    """Share (...) of the power of signals (..., T, J, 3) above a frequency."""
    window = torch.hann_window(moving.shape[-3], periodic=False).to(moving)[:, None, None]
    power = torch.fft.rfft(window * moving, dim=-3).abs().square().sum((-1, -2))
    quick = torch.fft.rfftfreq(moving.shape[-3], 1 / fps) > hertz
    return power[..., quick].sum(-1) / power.sum(-1).clamp_min(torch.finfo(power.dtype).tiny)


def _flexion(motion: Motion, *chain: str) -> Tensor:
    angles = []
    for side in ("left", "right"):
        a, b, c = (motion.positions[..., motion.skeleton.index(f"{side}_{part}"), :] for part in chain)
        upper, lower = torch.nn.functional.normalize(b - a, dim=-1), torch.nn.functional.normalize(c - b, dim=-1)
        angles.append(torch.acos((upper * lower).sum(-1).clamp(-1, 1)))
    return torch.rad2deg(torch.stack(angles)).mean((0, -1))
