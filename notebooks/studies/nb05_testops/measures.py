"""What is measured of a fit beside its mean error: does somebody sit, walk on, tremble, come apart?

Fit and truth are motions (B, T) of the 22 joints at the same frame rate, world, z up; masks are (B, T). Every measure
returns one number per clip (B,), NaN where a mask leaves nothing to measure.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from motionlab import metrics
from motionlab.humor import state
from motionlab.humor.priors import Cvae
from motionlab.humor.rollout import infer, rollout
from motionlab.motion import Motion
from studies.shared.spectra import power_spectrum

CM = 100.0


def quarters(error: Tensor) -> tuple[Tensor, Tensor]:
    """Means (B,) of an error (B, T) over the first and over the last quarter of the clip."""
    part = max(1, error.shape[-1] // 4)
    return error[..., :part].mean(-1), error[..., -part:].mean(-1)


def accumulation(model: Cvae, truth: Motion) -> Tensor:
    """Joint error (B, T) in metres, pelvis on the true one, of the truth's own latents (posterior means) rolled out."""
    states = state.from_motion(truth)
    with torch.no_grad():
        posterior, _ = infer(model, states)
        rolled = rollout(model, states[:, 0], posterior.mean, with_prior=False).states
    found = state.unpack(torch.cat((states[:, :1], rolled), 1))["joints"]
    return metrics.joint_errors(found, truth.positions, align="root").mean(-1)


def moment(truth: Motion) -> Tensor:
    """Finds the first or the last ten frames (B, T) of each clip, whichever have the pelvis lower."""
    height, when = truth.root[..., 2], torch.zeros(truth.root.shape[:-1], dtype=torch.bool)
    early = height[..., :10].mean(-1) < height[..., -10:].mean(-1)
    when[..., :10], when[..., -10:] = early[..., None], ~early[..., None]
    return when


def flexion_error(fit: Motion, truth: Motion) -> Tensor:
    """Computes the mean absolute error of ``metrics.tilt_and_bend``'s angles over frames and legs, degrees."""
    pairs = zip(metrics.tilt_and_bend(fit), metrics.tilt_and_bend(truth), strict=True)
    return torch.stack([(a - b).abs().mean((-1, -2)) for a, b in pairs]).mean(0)


def swing(motion: Motion, where: Tensor) -> Tensor:
    """Computes the standard deviation, over the frames of a mask, of how far the left ankle is ahead of the right one
    along the heading of the pelvis, metres."""
    forward = torch.nn.functional.normalize(motion.rot[..., 0, :2, 2], dim=-1)
    left, right = (motion.positions[..., motion.skeleton.index(f"{side}_ankle"), :2] for side in metrics.SIDES)
    way = ((left - right) * forward).sum(-1)
    mean = metrics.masked_mean(way, where, 1)
    return metrics.masked_mean((way - mean[..., None]).square(), where, 1).sqrt()


def _about_pelvis(motion: Motion) -> Tensor:
    return motion.positions - motion.positions[..., :1, :]


def band_power(fit: Motion, truth: Motion, bands: Sequence[float]) -> Tensor:
    """Power of the joints' velocities about the pelvis over the true one, per band of frequency: (B, bands)."""
    frequency = torch.fft.rfftfreq(truth.frames - 1, 1 / truth.fps)
    inside = torch.stack([(frequency >= low) & (frequency < high) for low, high in pairwise(bands)]).to(truth.root)
    mine, true = (power_spectrum(_about_pelvis(x).diff(dim=-3)) @ inside.mT for x in (fit, truth))
    return mine / true


def acceleration_ratio(fit: Motion, truth: Motion) -> Tensor:
    """Mean size of the acceleration about the pelvis over the true one."""
    mine, true = (metrics.mean_acceleration(_about_pelvis(x), x.fps) for x in (fit, truth))
    return mine / true
