"""How good a transition prior is: one step, two seconds, and what it makes up by itself.

Every number stands beside what a model that knows nothing would get: the pose held, or every joint going on as it goes.
Samples stand beside the data that they begin from. Centimetres are mean distances over the 22 predicted joints.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.humor.cvae import Cvae, kl
from motionlab.humor.losses import pairs
from motionlab.humor.rollout import infer, rollout, sample
from motionlab.humor.state import FPS, apply, globalise, heading, localise, unpack
from motionlab.metrics.contact import contact_scores
from motionlab.metrics.pose import masked_mean, mean_acceleration
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, Skeleton

#: A dimension is active where it costs more than this on average, nats.
ACTIVE = 0.05
#: A foot is down where its ball is less than this above its resting height, metres.
DOWN = 0.03


def _error(a: Tensor, b: Tensor) -> Tensor:
    return 100 * (unpack(a)["joints"] - unpack(b)["joints"]).norm(dim=-1).mean(-1)


@torch.no_grad()
def one_step(model: Cvae, states: Tensor) -> dict[str, Tensor]:
    """Errors (N,) in cm of all transitions of world states (W, T, 339): z from the posterior's and the prior's mean,
    the pose held, and every joint going on at its velocity; "kl": nats (N, 48)."""
    past, now = pairs(states)
    q, p = model.posterior(past, now), model.prior(past)
    ahead = unpack(past)["joints"] + unpack(past)["joints_vel"] / FPS
    return {
        "posterior": _error(apply(past, model.decode(past, q.mean))[0], now),
        "prior mean": _error(apply(past, model.decode(past, p.mean))[0], now),
        "hold": _error(past, now),
        "constant velocity": 100 * (ahead - unpack(now)["joints"]).norm(dim=-1).mean(-1),
        "kl": kl(q, p),
    }


@torch.no_grad()
def drift(model: Cvae, states: Tensor) -> dict[str, Tensor]:
    """Errors (W, T - 1) in cm over time of roll-outs from the first of world states (W, T, 339).

    "posterior z": inferred once from the truth, then rolled out. "closed loop": z inferred at every step from the
    state that the roll-out has reached and the next true one. "prior mean": no look at the truth at all.
    """
    first, truth = states[:, 0], states[:, 1:]
    q, _ = infer(model, states)
    x, closed = first, []
    for t in range(truth.shape[1]):
        frame = heading(x)
        past = localise(x, frame)
        z = model.posterior(past, localise(truth[:, t], frame)).mean
        x = globalise(apply(past, model.decode(past, z))[0], frame)
        closed.append(x)
    velocity = unpack(first)["joints_vel"]
    time = torch.arange(1, truth.shape[1] + 1).to(first)[:, None, None] / FPS
    ahead = unpack(first)["joints"][:, None] + time * velocity[:, None]
    return {
        "posterior z": _error(rollout(model, first, q.mean, with_prior=False).states, truth),
        "closed loop": _error(torch.stack(closed, 1), truth),
        "prior mean": _error(sample(model, first, truth.shape[1]).states, truth),
        "hold": _error(first[:, None], truth),
        "constant velocity": 100 * (ahead - unpack(truth)["joints"]).norm(dim=-1).mean(-1),
    }


def looks(first: Tensor, states: Tensor) -> dict[str, Tensor]:
    """What motions look like that go on from first states (W, 339) with world states (W, T, 339), one number each (W,).

    All of it is measured from the joints, none from what a model says of its contacts; a foot is down where its ball is
    lower than 3 cm above where it rests. slide: mm per frame over the floor of balls that are down in both frames, NaN
    where none is; a foot that swings close to the floor counts as well, so compare with data. feet up: share of frames
    with no foot down. penetration: share of frames with a ball more than 2 cm below where it rests. sunk: 1 where the
    head ends below 30 cm or any joint 30 cm below the floor. acceleration: m/s^2. bones: mean change of the bone
    lengths, per cent of their mean.
    """
    joints = unpack(states)["joints"]
    balls = joints[:, :, STANDARD.indices(["left_foot", "right_foot"])]
    above = balls[..., 2] - STANDARD.sole
    down = above < DOWN
    speed = 1000 * balls[..., :2].diff(dim=1).norm(dim=-1)
    parents = list(STANDARD.parents[1:])
    length = (joints[:, :, 1:] - joints[:, :, parents]).norm(dim=-1)
    start = unpack(first)["joints"]
    before = (start[:, 1:] - start[:, parents]).norm(dim=-1)[:, None]
    end = joints[:, -1, :, 2]
    return {
        "slide": masked_mean(speed, down[:, 1:] & down[:, :-1], 2),
        "feet up": (~down.any(-1)).float().mean(1),
        "penetration": (above.amin(-1) < -0.02).float().mean(1),
        "sunk": ((end[:, STANDARD.index("head")] < 0.3) | (end.amin(-1) < -0.3)).float(),
        "acceleration": mean_acceleration(joints, FPS),
        "bones": 100 * (length - before).abs().mean((1, 2)) / before.mean((1, 2)),
    }


@torch.no_grad()
def plausibility(model: Cvae, first: Tensor, steps: int, generator: torch.Generator) -> dict[str, Tensor]:
    """:func:`looks` of samples (W,) of ``steps`` frames from first states (W, 339), z drawn from the prior."""
    return looks(first, sample(model, first, steps, generator=generator).states)


# ------------------------------------------------------------------------------------------------- do they go on?
class Points(NamedTuple):
    """As much of a motion (B, T) as the measures of ``cases`` read: of a model of points there is no more."""

    positions: Tensor
    rot: Tensor
    skeleton: Skeleton
    fps: float


def going_on(motion: Motion, at: int, steps: int) -> dict[str, Points]:
    """What knows nothing makes of frame ``at`` of motions (B, T), as (B, steps + 1): "hold", the pose stays; "constant
    velocity", every joint goes on along a line with its velocity, the central difference that a state contains."""
    joints, time = motion.positions, torch.arange(float(steps + 1))[:, None, None]
    velocity = (joints[:, at + 1] - joints[:, at - 1])[:, None] / 2
    held = joints[:, at, None].expand(-1, steps + 1, -1, -1)
    rot = motion.rot[:, at, None].expand(-1, steps + 1, -1, -1, -1)
    paths = {"hold": held, "constant velocity": held + time * velocity}
    return {name: Points(path, rot, motion.skeleton, motion.fps) for name, path in paths.items()}


def walks_on(found: Motion | Points, person: Motion, frames: int = 15) -> Tensor:
    """1 where the pelvis's mean speed over the floor in the last ``frames`` steps is above half of the person's mean
    speed over the whole of the clip, else 0: (B,)."""
    ours, own = (m.positions[..., 0, :2].diff(dim=1).norm(dim=-1) * m.fps for m in (found, person))
    return (ours[:, -frames:].mean(1) > 0.5 * own.mean(1)).to(ours)


@torch.no_grad()
def contact_f1(model: Cvae, states: Tensor, contacts: Tensor) -> float:
    """F1 of the decoded contact labels against the true ones (W, T, 9), one step from the truth, with the latent of a
    posterior that saw the answer."""
    past, now = pairs(states)
    _, logits = apply(past, model.decode(past, model.posterior(past, now).mean))
    return float(contact_scores((logits > 0).float(), contacts[:, 1:].flatten(0, 1)).f1)


def summary(model: Cvae, states: Tensor, contacts: Tensor | None = None, seed: int = 0) -> dict[str, float]:
    """One row of the quality table of world states (W, 61, 339): means over windows.

    Rows that start with "samples' " are :func:`looks` of samples, those with "data's " of the windows themselves.
    """
    step, way = one_step(model, states), drift(model, states)
    made = plausibility(model, states[:, 0], states.shape[1] - 1, torch.Generator().manual_seed(seed))
    row = {f"one step, {name}, cm": float(step[name].mean()) for name in step if name != "kl"}
    if contacts is not None:
        row["one step, posterior, contact F1"] = contact_f1(model, states, contacts)
    row |= {f"2 s, {name}, cm": float(way[name][:, -1].mean()) for name in way}
    row |= {"kl, nats": float(step["kl"].sum(-1).mean()), "active": int((step["kl"].mean(0) > ACTIVE).sum())}
    for whose, found in (("samples'", made), ("data's", looks(states[:, 0], states[:, 1:]))):
        row |= {f"{whose} {name}": float(value.nanmean()) for name, value in found.items()}
    return row
