"""From the motion of stage 2 to the unknowns of stage 3: a first state, and the latent of every transition.

Source: stage-3 initialisation of the official code: velocities by finite differences, then the posterior's mean.
Differs, in lean mode: z_t leads from where the roll-out *is* to where stage 2 is next, as far as the prior allows,

    z_t = argmin 1/2 |x(x_t, z) - x*_{t+1}|^2_W + w/2 |(z - mu_t) / sigma_t|^2

by two Gauss-Newton steps from the posterior's mean. What one step misses the next makes up for, and the start does not
drift away as that of the official code does (thesis 3.3.3, Fig. 3.10). W is in square metres: joints count as they
are, rotations with a lever of 0.3 m, velocities over one frame; what was not observed counts little.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.humor import state, windows
from motionlab.humor.cvae import Cvae
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import infer
from motionlab.humor.variables import from_matrix
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

_ITERATIONS, _STEP = 2, 1e-2
#: Of the prior's weight while following. Little, since a miss now is a miss in all frames to come; with more of it what
#: was not seen moves more as the prior would. Fits by ``shooting`` begin with both.
EAGER, CALM = 0.02, 0.3
_LASTING = 1.0  # p
_LEVER = 0.3**2  # square metres per squared radian
#: The joint that tells most of a joint's rotation: its first child, or itself at the end of a limb.
_CHILD = [next((c for c, p in enumerate(STANDARD.parents) if p == j), j) for j in range(len(STANDARD))]


def start(
    motion: Motion,
    latent: Tensor,
    shared: dict[str, Tensor],
    trust: Tensor,
    priors: Priors,
    starts: tuple[int, ...],
    length: int,
    mode: str = "lean",
    weight: float = 1e-3,
    eager: float = EAGER,
) -> tuple[dict[str, Tensor], Tensor | None]:
    """The unknowns of stage 3 in windows; and in lean mode factors (G, W, L - 1, 48, 48) that make z round.

    A factor is L^-T of (L - t)^p H_t + w diag(1 / sigma^2) = L L^T, with H_t the Gauss-Newton matrix of one way. What
    z_t does to the frame after it stays done in all that follow, hence the first factor.

    Args:
        motion (G, T): of stage 2. latent (G, T, 32): its pose latents. shared: its betas, camera.
        trust (G, T, 22): how much each joint of it is to be believed, 0 to 1; used in lean mode.
        starts, length: of the windows. weight: of the motion prior beside a square metre, w. eager: its share while
            following.
    """
    states = state.from_motion(motion)
    first = state.unpack(states[:, list(starts)])
    with torch.no_grad():
        if mode == "lean":
            aims, share = (windows.cut(x, starts, length).flatten(0, 1) for x in (states, trust))
            z, curvature, sharp = followed(priors.motion, aims, share, eager * weight)
            z, factors = (x.unflatten(0, (-1, len(starts))) for x in (z, _factors(curvature, sharp, weight)))
        else:
            z, factors = windows.cut(infer(priors.motion, states)[0].mean, starts, length - 1), None
    unknown = {
        "trans": first["trans"],
        "orient": from_matrix(first["root_orient"], mode),
        "latent": latent[:, list(starts)],
        "trans_vel": first["trans_vel"],
        "root_orient_vel": first["root_orient_vel"],
        "joints_vel": first["joints_vel"].flatten(-2),
        "z": z,
        **shared,
    }
    return unknown, factors


def followed(model: Cvae, states: Tensor, trust: Tensor, weight: float) -> tuple[Tensor, Tensor, Tensor]:
    """z (B, T - 1, 48) of a roll-out from the first of states (B, T, 339) that is steered to follow them.

    trust (B, T, 22): how much each joint of stage 2 is to be believed; where none is, z is the prior's mean.
    weight: w above. Also the Gauss-Newton matrices (B, T - 1, 48, 48) of the ways, and the prior's
    1 / sigma^2 (B, T - 1, 48).
    """
    now, found, curvature, precision = states[:, 0], [], [], []
    for aim, share in zip(states[:, 1:].unbind(1), trust[:, 1:].unbind(1), strict=True):
        frame = state.heading(now)
        past, aim = state.localise(now, frame), state.localise(aim, frame)
        prior, z = model.prior(past), model.posterior(past, aim).mean
        sharp = (-prior.log_var).exp().clamp(max=1e4)
        root = _importance(share).sqrt()
        for _ in range(_ITERATIONS):
            miss, slope = _linearised(model, past, z, aim, root)
            gauss_newton = slope @ slope.mT
            pull = (slope @ miss[..., None])[..., 0] + weight * sharp * (z - prior.mean)
            z = z - torch.linalg.solve(gauss_newton + torch.diag_embed(weight * sharp + 1e-6), pull)
        now = state.globalise(state.apply(past, model.decode(past, z))[0], frame)
        found.append(z), curvature.append(gauss_newton), precision.append(sharp)
    return tuple(torch.stack(each, 1) for each in (found, curvature, precision))


def _factors(curvature: Tensor, sharp: Tensor, weight: float) -> Tensor:
    left = torch.arange(curvature.shape[1], 0, -1).to(sharp) ** _LASTING
    whole = left[:, None, None] * curvature + torch.diag_embed(weight * sharp + 1e-6)
    factor = torch.linalg.cholesky(whole.double())
    unit = torch.eye(whole.shape[-1], dtype=factor.dtype, device=factor.device).expand_as(factor)
    return torch.linalg.solve_triangular(factor.mT, unit, upper=True).to(sharp)


def _linearised(model: Cvae, past: Tensor, z: Tensor, aim: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted miss (B, 339) of the next state, and its derivative (B, 48, 339) in z by finite differences."""
    size = z.shape[-1]
    around = torch.cat((torch.zeros(1, size), _STEP * torch.eye(size))).to(z) + z[:, None]
    past = past[:, None].expand(-1, size + 1, -1)
    after, _ = state.apply(past, model.decode(past, around))
    return root * (after[:, 0] - aim), root[:, None] * (after[:, 1:] - after[:, :1]) / _STEP


def _importance(trust: Tensor) -> Tensor:
    """W (B, 339) from how much each joint (B, 22) is believed."""
    whole = trust.mean(-1, keepdim=True)
    child = torch.stack([trust[:, _CHILD[j]] for j in range(1, 22)], 1)
    parts = {
        "trans": whole.expand(-1, 3),
        "trans_vel": (whole / state.FPS**2).expand(-1, 3),
        "root_orient": (_LEVER * whole).expand(-1, 9),
        "root_orient_vel": (_LEVER * whole / state.FPS**2).expand(-1, 3),
        "pose_body": (_LEVER * child).repeat_interleave(9, 1),
        "joints": trust.repeat_interleave(3, 1),
        "joints_vel": trust.repeat_interleave(3, 1) / state.FPS**2,
    }
    return torch.cat([parts[name] for name in state.SHAPES], 1)
