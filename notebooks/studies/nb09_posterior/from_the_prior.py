"""Simulation-based calibration: truths drawn from the model itself, filmed, and their ranks among the draws.

Where truths come from the very density that a sampler claims to draw from, the truth is one more draw, so that its rank
among them is uniform. Only then does a wrong rank mean a wrong sampler, and not a wrong model.

Source: Talts et al. 2018 (simulation-based calibration).
"""

from dataclasses import replace

import torch
from torch import Tensor

from data_synth.scenes import Scene
from motionlab import posterior
from motionlab.humor import state, unknowns
from motionlab.humor.energies import RGB_LIGHT
from motionlab.humor.evidence import evidence
from motionlab.humor.feedback_solver import Plan, solve
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import sample_rollout
from motionlab.humor.stages import Problem
from motionlab.humor.testops import Fitted
from motionlab.humor.unknowns import Unknowns
from studies.nb09_posterior.hidden_people import about_pelvis

_TIMES = (0.5, 0.75, 1.0)  # of a clip, at which ankles are ranked


def whitened(z: Tensor, prior) -> Tensor:
    """Computes 1/2 |(z - mu) / sigma|^2 (B,): the prior without the log of its widths, as a density of the whitened
    latents has it."""
    return 0.5 * ((z - prior.mean).square() * (-prior.log_var).exp()).flatten(1).sum(1)


@torch.no_grad()
def truths(scene: Scene, priors: Priors, generator: torch.Generator) -> tuple[Problem, Unknowns, Tensor]:
    """Draws motions by the prior from the first states of a scene's people, shapes and keypoint noise as the energy has
    them: the problem that sees them where the scene's camera sees, their unknowns, and joints about the pelvis.
    The energy keeps what is a density of these: image, shape, motion prior and first state.
    """
    frames, clips, weights = scene.truth.frames, len(scene), RGB_LIGHT
    nat = weights.motion_prior[2]
    off = dict.fromkeys(("joint_consistency", "bone_length", "contact_vel", "contact_height"), (0.0,) * 3)
    weights = replace(weights, **off, init_motion_prior=(0.0, 0.0, nat * 15 / frames))  # grows by frames / 15
    first = state.from_motion(scene.truth, causal=priors.motion.causal)[:, 0]
    latent = priors.pose.encode(state.unpack(first)["pose_body"]).mean
    shape = (nat / (2 * frames * weights.shape_prior[2])) ** 0.5
    betas = shape * torch.randn(clips, 8, generator=generator)
    begun = unknowns.of_first_state(first, latent, betas=betas, camera=torch.zeros(clips, 3))
    rolled = sample_rollout(priors.motion, unknowns.first_state(begun, priors), frames - 1, generator=generator)
    true = replace(begun, z=rolled.z)
    body = unknowns.roll(true, priors, evidence(scene.observation, cameras=scene.cameras)).body
    noise = (nat / (2 * weights.joints2d[2])) ** 0.5 * torch.randn(body.observed.shape, generator=generator)
    sure = (scene.observation.confidence > 0).float()
    seen = replace(scene.observation, keypoints=body.observed + noise, confidence=sure)
    problem = Problem(evidence(seen, cameras=scene.cameras), priors, weights)
    return problem, true, body.joints - body.joints[:, :, :1]


def found(problem: Problem, true: Unknowns, rounds: int = 4) -> Fitted:
    """Searches the energy's minimum from the truth, so that a wrong valley cannot spoil the ranks."""
    at, _ = solve(problem, true, Plan(rounds, 20, 1e-5, mode_jumps=0, trial_rounds=0))
    return Fitted(None, {}, None, None, None, None, None, {}, {}, problem=problem, unknown=at.detached())


def ranks(fit: Fitted, joints: Tensor, seed: int, *, spread: float = 1.0) -> Tensor:
    """Ranks (B, 18) of the truth among draws at temperature 1, 0 to 1: both ankles' places about the pelvis at three
    times while they are hidden. spread: how many times as wide they are drawn, for a control."""
    rows, ankles = [], torch.tensor([7, 8])
    times = torch.tensor([round(t * (joints.shape[1] - 1)) for t in _TIMES])
    for clip in range(len(joints)):
        generator = torch.Generator().manual_seed(1000 * seed + clip)
        many = posterior.rolled(fit, 63, generator, clip, spread**2)
        places = about_pelvis(many)[:, times][:, :, ankles]
        rows.append((places < joints[clip, times][:, ankles]).double().mean(0).flatten())
    return torch.stack(rows)


def outside(ranks_: Tensor) -> Tensor:
    """Share (B,) of a clip's ranks in the outer tenth: 0.1 where the sampler is right."""
    return ((ranks_ < 0.05) | (ranks_ > 0.95)).double().mean(1)
