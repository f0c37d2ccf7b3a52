"""How good a transition prior is: one step, two seconds, and what it makes up by itself.

Every number stands beside what a model that knows nothing would get: the pose held, or every joint going on as it goes.
Centimetres are mean distances over the 22 predicted joints.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.humor.cvae import Cvae, kl
from motionlab.humor.losses import pairs
from motionlab.humor.rollout import infer, rollout, sample
from motionlab.humor.state import FPS, apply, globalise, heading, localise, unpack
from motionlab.metrics.contact import contact_scores
from motionlab.metrics.pose import mean_acceleration
from motionlab.skeleton import STANDARD

#: A dimension is active where it costs more than this on average, nats.
ACTIVE = 0.05


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


@torch.no_grad()
def plausibility(model: Cvae, first: Tensor, steps: int, generator: torch.Generator) -> dict[str, Tensor]:
    """What samples (W,) of ``steps`` frames from first states (W, 339) look like.

    slide: mm per frame of joints that the sample says are in contact. penetration: share of frames with a toe more than
    2 cm below the floor. sunk: share of clips that end with the head below 30 cm or any joint 30 cm below the floor.
    acceleration: m/s^2. bones: mean change of the predicted joints' bone lengths, per cent of their mean.
    """
    found = sample(model, first, steps, generator=generator)
    joints = unpack(found.states)["joints"]
    touching = found.contact_logits[:, 1:].sigmoid() > 0.5
    speed = 1000 * joints[:, :, STANDARD.contact_indices].diff(dim=1).norm(dim=-1)
    toes = joints[:, :, STANDARD.indices(["left_foot", "right_foot"]), 2].amin(-1) - STANDARD.sole
    parents = list(STANDARD.parents[1:])
    length = (joints[:, :, 1:] - joints[:, :, parents]).norm(dim=-1)
    start = unpack(first)["joints"]
    before = (start[:, 1:] - start[:, parents]).norm(dim=-1)[:, None]
    end = joints[:, -1, :, 2]
    return {
        "slide": (speed * touching).sum((1, 2)) / touching.sum((1, 2)).clamp(min=1),
        "penetration": (toes < -0.02).float().mean(1),
        "sunk": ((end[:, STANDARD.index("head")] < 0.3) | (end.amin(-1) < -0.3)).float(),
        "acceleration": mean_acceleration(joints, FPS),
        "bones": 100 * (length - before).abs().mean((1, 2)) / before.mean((1, 2)),
    }


@torch.no_grad()
def contact_f1(model: Cvae, states: Tensor, contacts: Tensor) -> float:
    """F1 of the decoded contact labels against the true ones (W, T, 9), one step from the truth."""
    past, now = pairs(states)
    _, logits = apply(past, model.decode(past, model.posterior(past, now).mean))
    return float(contact_scores((logits > 0).float(), contacts[:, 1:].flatten(0, 1)).f1)


def summary(model: Cvae, states: Tensor, contacts: Tensor | None = None, seed: int = 0) -> dict[str, float]:
    """One row of the quality table of world states (W, 61, 339): means over windows."""
    step, way = one_step(model, states), drift(model, states)
    made = plausibility(model, states[:, 0], states.shape[1] - 1, torch.Generator().manual_seed(seed))
    row = {f"one step, {name}, cm": float(step[name].mean()) for name in step if name != "kl"}
    row |= {f"2 s, {name}, cm": float(way[name][:, -1].mean()) for name in way}
    row |= {"kl, nats": float(step["kl"].sum(-1).mean()), "active": int((step["kl"].mean(0) > ACTIVE).sum())}
    row |= {f"samples' {name}": float(value.mean()) for name, value in made.items()}
    return row if contacts is None else row | {"contact F1": contact_f1(model, states, contacts)}
