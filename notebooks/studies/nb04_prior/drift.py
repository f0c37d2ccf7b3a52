"""One transition at a time against all of them in a chain: how far latents that are right locally lead astray.

From a sequence of states the posterior names a latent for every transition. Decoded one by one, each from the
sequence's own state, they show what the latents say; rolled out from the first state alone, they show what they add
up to, which is where stage 3 of the test-time optimisation starts.

Source: thesis 3.3.3, Figs. 3.10 (decoded one by one), 3.11 (the sequence), 3.12 (rolled out).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.errors import ShapeError
from motionlab.humor import state
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.rollout import decode_ahead, infer, rollout, sample_rollout
from motionlab.motion import Motion

LEAST_DESCENT = 0.1  # metres: less is not sitting down


@dataclass(frozen=True, eq=False)
class Decoded:
    """A sequence and what its latents decode to: B clips of T + 1 frames, the first of which is always its own.

    reference: the sequence. one_step, rolled: with the posterior's mean; blind, blind_rolled: with the prior's, which
    does not know the transition. posterior, prior (B, T, 48). states (B, T + 1, 339): the sequence's. steps,
    blind_steps (B, T, 339): the two one-step decodes as states.
    """

    reference: Motion
    one_step: Motion
    rolled: Motion
    blind: Motion
    blind_rolled: Motion
    posterior: Gaussian
    prior: Gaussian
    states: Tensor
    steps: Tensor
    blind_steps: Tensor


def decode(model: Cvae, motion: Motion) -> Decoded:
    """Infer the latents of every transition of clips (B, T + 1) and decode them in both ways. No gradients.

    Raises:
        ShapeError: not a batch of clips, or no transition.
    """
    if motion.root.ndim != 3 or motion.frames < 2:
        raise ShapeError(f"expected clips (B, T + 1) of two frames or more, got root {tuple(motion.root.shape)}")
    with torch.no_grad():
        states = state.from_motion(motion)
        posterior, prior = infer(model, states)
        first, before = states[:, :1], states[:, :-1]

        def shown(found: Tensor) -> Motion:
            return state.to_motion(torch.cat((first, found), 1), motion.skeleton, motion.fps)

        steps, blind = (decode_ahead(model, before, q.mean)[:, :, 0] for q in (posterior, prior))
        return Decoded(
            reference=replace(motion, contacts=None),
            one_step=shown(steps),
            rolled=shown(rollout(model, first[:, 0], posterior.mean, with_prior=False).states),
            blind=shown(blind),
            blind_rolled=shown(sample_rollout(model, first[:, 0], motion.frames - 1).states),
            posterior=posterior,
            prior=prior,
            states=states,
            steps=steps,
            blind_steps=blind,
        )


def _mean_distance(found: Tensor, wanted: Tensor) -> Tensor:
    return 100 * (found - wanted).norm(dim=-1).mean(-1)


def one_step_errors(found: Decoded) -> dict[str, Tensor]:
    """Mean joint error (B, T) in cm, world, of a step from the sequence's own state t - 1 to its state t.

    "hold" is that state itself, "constant velocity" moves its joints by the velocities that it contains.
    """
    wanted = found.reference.positions[:, 1:]
    joints, moved = _straight_on(found.states[:, :-1], found.reference.fps, 1.0)
    return {
        "posterior": _mean_distance(found.one_step.positions[:, 1:], wanted),
        "prior's mean": _mean_distance(found.blind.positions[:, 1:], wanted),
        "constant velocity": _mean_distance(moved, wanted),
        "hold": _mean_distance(joints, wanted),
    }


def velocity_errors(found: Decoded) -> dict[str, Tensor]:
    """Mean error (B, T) in cm/s of the joint velocities after one step; "hold": those of the state before."""

    def speeds(states: Tensor) -> Tensor:
        return state.unpack(states)["joints_vel"]

    wanted = speeds(found.states[:, 1:])
    tried = {"posterior": found.steps, "prior's mean": found.blind_steps, "hold": found.states[:, :-1]}
    return {name: _mean_distance(speeds(states), wanted) for name, states in tried.items()}


def rollout_errors(found: Decoded) -> dict[str, Tensor]:
    """Mean joint error (B, T) in cm, world, t steps after the first state.

    "errors added": the one-step errors as vectors, summed over the steps, as if no error bred another;
    "errors at random": the same if each had its own direction.
    """
    wanted = found.reference.positions[:, 1:]
    steps = torch.arange(1.0, wanted.shape[1] + 1)[:, None, None].to(wanted)
    joints, moved = _straight_on(found.states[:, :1], found.reference.fps, steps)
    residual = found.one_step.positions[:, 1:] - wanted
    return {
        "posterior": _mean_distance(found.rolled.positions[:, 1:], wanted),
        "prior's mean": _mean_distance(found.blind_rolled.positions[:, 1:], wanted),
        "constant velocity": _mean_distance(moved, wanted),
        "hold": _mean_distance(joints, wanted),
        "errors added": 100 * residual.cumsum(1).norm(dim=-1).mean(-1),
        "errors at random": 100 * residual.square().sum(-1).cumsum(1).sqrt().mean(-1),
    }


def _straight_on(states: Tensor, fps: float, steps: Tensor | float) -> tuple[Tensor, Tensor]:
    parts = state.unpack(states)
    return parts["joints"], parts["joints"] + parts["joints_vel"] * steps / fps


def descent_share(decoded: Motion, reference: Motion) -> Tensor:
    """Of a sequence's descent of the pelvis, the share (B,) that its one-step decodes make; NaN where it does not sink.

    sum_t (decoded_t - reference_{t-1}) / (reference_T - reference_0), heights of the pelvis.
    """
    height, wanted = decoded.root[..., 2], reference.root[..., 2]
    made = (height[:, 1:] - wanted[:, :-1]).sum(1)
    own = wanted[:, -1] - wanted[:, 0]
    return torch.where(own < -LEAST_DESCENT, made / own, torch.nan)


def ahead_errors(model: Cvae, found: Decoded, steps: int) -> dict[str, Tensor]:
    """Mean joint error (B, K) in cm, world, after 1..K steps from every state of the sequence that has K left.

    "posterior": all K-step roll-outs at once, each with its own transitions' latents; "prior's mean": without them.
    """
    last = found.states.shape[1] - steps
    if last < 1:
        raise ShapeError(f"steps: the clips have {found.states.shape[1] - 1} transitions, asked {steps}")
    starts = found.states[:, :last]
    with torch.no_grad():
        ahead = decode_ahead(model, found.states[:, :-1], found.posterior.mean, steps)[:, :last]
        blind = sample_rollout(model, starts.flatten(0, 1), steps).states.unflatten(0, (-1, last))
    at = torch.arange(last)[:, None] + 1 + torch.arange(steps)
    wanted = found.reference.positions[:, at]  # (B, last, K, 22, 3)
    skeleton = found.reference.skeleton
    if skeleton.offsets.ndim == 4:
        skeleton = replace(skeleton, offsets=skeleton.offsets[:, None])
    time = torch.arange(1.0, steps + 1)[:, None, None].to(wanted)
    joints, moved = _straight_on(starts[:, :, None], found.reference.fps, time)
    reached = {
        "posterior": state.to_motion(ahead, skeleton).positions,
        "prior's mean": state.to_motion(blind, skeleton).positions,
        "constant velocity": moved,
        "hold": joints,
    }
    return {name: _mean_distance(positions, wanted).mean(1) for name, positions in reached.items()}


def vary(model: Cvae, first: Tensor, dimension: int, sizes: Tensor, steps: int) -> Tensor:
    """Roll-outs (N, steps + 1, 339) from one state (339,), z at the prior's mean but for one dimension.

    sizes (N,): how far that dimension is from the mean, in the prior's standard deviations, at every step.
    """
    x = first.expand(len(sizes), -1)
    states = [x]
    with torch.no_grad():
        for _ in range(steps):
            prior = model.prior(state.localise(x, state.heading(x)))
            z = prior.mean.clone()
            z[:, dimension] += sizes * (0.5 * prior.log_var[:, dimension]).exp()
            x = rollout(model, x, z[:, None], with_prior=False).states[:, 0]
            states.append(x)
    return torch.stack(states, 1)
