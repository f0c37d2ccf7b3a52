"""How good a transition prior is: one step, two seconds, and what it makes up by itself.

Centimetres are mean distances over the 22 predicted joints; beside them stands what knows nothing.
"""

import math

import torch
from torch import Tensor

from motionlab.humor.priors import Cvae, kl
from motionlab.humor.rollout import infer, rollout, sample_rollout
from motionlab.humor.state import apply, bone_lengths, globalise, heading, localise, transition_pairs, unpack
from motionlab.metrics import contact_f1, masked_mean, mean_acceleration
from motionlab.motion import FPS
from motionlab.skeleton import BALLS, STANDARD

ACTIVE_NATS = 0.05  # a dimension of the latent is active where it costs more than this on average
_SAMPLES = 8


def _error(a: Tensor, b: Tensor) -> Tensor:
    return 100 * (unpack(a)["joints"] - unpack(b)["joints"]).norm(dim=-1).mean(-1)


@torch.no_grad()
def one_step_errors(model: Cvae, states: Tensor) -> dict[str, Tensor]:
    """Errors (N,) in cm of all transitions of world states (W, T, 339): z from the posterior's and the prior's mean,
    the pose held, and every joint going on at its velocity; "kl": nats (N, 48), "contacts": logits (N, 9), by the
    posterior, which saw the answer."""
    past, now = (x.flatten(0, -2) for x in transition_pairs(states))
    q, p = model.posterior(past, now), model.prior(past)
    ahead = unpack(past)["joints"] + unpack(past)["joints_vel"] / FPS
    told, contacts = apply(past, model.decode(past, q.mean))
    return {
        "posterior": _error(told, now),
        "prior mean": _error(apply(past, model.decode(past, p.mean))[0], now),
        "hold": _error(past, now),
        "constant velocity": 100 * (ahead - unpack(now)["joints"]).norm(dim=-1).mean(-1),
        "kl": kl(q, p), "contacts": contacts,
    }  # fmt: skip


@torch.no_grad()
def rollout_errors(model: Cvae, states: Tensor) -> dict[str, Tensor]:
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
    return {
        "posterior z": _error(rollout(model, first, q.mean, with_prior=False).states, truth),
        "closed loop": _error(torch.stack(closed, 1), truth),
        "prior mean": _error(sample_rollout(model, first, truth.shape[1]).states, truth),
        "hold": _error(first[:, None], truth),
    }


def looks(first: Tensor, states: Tensor) -> dict[str, Tensor]:
    """Computes what motions look like that go on from first states (W, 339) with world states (W, T, 339), one number
    each (W,).

    Measured from the joints. slide: mm per frame over the floor of the balls of the feet while they are, in both
    frames, lower than 3 cm above where they rest; NaN where none is (feet that swing close to it count, so compare with
    data). penetration: share of frames with a ball more than 2 cm below where it rests. acceleration: m/s^2. bones:
    mean change of the bone lengths, per cent of their mean.
    """
    joints = unpack(states)["joints"]
    balls = joints[:, :, STANDARD.indices(BALLS)]
    above = balls[..., 2] - STANDARD.sole
    down = above < 0.03
    speed = 1000 * balls[..., :2].diff(dim=1).norm(dim=-1)
    length, before = bone_lengths(states), bone_lengths(first)[:, None]
    return {
        "slide": masked_mean(speed, down[:, 1:] & down[:, :-1], 2),
        "penetration": (above.amin(-1) < -0.02).float().mean(1),
        "acceleration": mean_acceleration(joints, FPS),
        "bones": 100 * (length - before).abs().mean((1, 2)) / before.mean((1, 2)),
    }


@torch.no_grad()
def best_of(model: Cvae, states: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Errors (W,) in cm at the end of world states (W, T, 339) of the closest of ``count`` samples from the first."""
    first = states[:, 0].repeat(count, 1)
    made = sample_rollout(model, first, states.shape[1] - 1, generator=generator).states[:, -1]
    return _error(made.unflatten(0, (count, -1)), states[:, -1]).amin(0)


@torch.no_grad()
def effective_rank(model: Cvae, past: Tensor) -> float:
    """Computes in how many directions z moves the next joints: the effective rank (Roy and Vetterli 2007) of d joints /
    d z, z in deviations of the prior about its mean; mean over past states (N, 339)."""
    prior, step = model.prior(past), 0.1
    off = step * torch.diag_embed((0.5 * prior.log_var).exp())  # (N, 48, 48): a deviation along each axis

    def joints(z: Tensor) -> Tensor:
        x = past[:, None].expand(-1, z.shape[1], -1)
        return unpack(apply(x, model.decode(x, z))[0])["joints"].flatten(2)

    slope = joints(prior.mean[:, None] + off) - joints(prior.mean[:, None] - off)
    values = torch.linalg.svdvals(slope)
    return float(torch.special.entr(values / values.sum(-1, keepdim=True)).sum(-1).exp().mean())


def quality_row(model: Cvae, states: Tensor, contacts: Tensor, seed: int = 0) -> dict[str, float]:
    """Computes one row of the quality table from world states (W, 61, 339), contacts (W, 61, 9): means over windows.

    The best of 8 samples is of 48 windows at most, the effective rank of as many states. "samples' ": how samples look,
    "data's ": the windows themselves.
    """
    step, way = one_step_errors(model, states), rollout_errors(model, states)
    nats, logits = step.pop("kl"), step.pop("contacts")
    row = {f"one step, {name}, cm": float(error.mean()) for name, error in step.items()}
    guesses = {"one step, posterior, contact F1": logits > 0, "contact F1, as one frame before": contacts[:, :-1]}
    row |= {name: float(contact_f1(x.reshape(-1, 9), contacts[:, 1:].flatten(0, 1))) for name, x in guesses.items()}
    row |= {f"2 s, {name}, cm": float(way[name][:, -1].mean()) for name in way}
    some = states[:: math.ceil(len(states) / 48)]
    best = best_of(model, some, _SAMPLES, torch.Generator().manual_seed(seed))
    row[f"2 s, best of {_SAMPLES} samples, cm"] = float(best.mean())
    row["effective rank"] = effective_rank(model, localise(some[:, 0], heading(some[:, 0])))
    row |= {"kl, nats": float(nats.sum(-1).mean()), "active": int((nats.mean(0) > ACTIVE_NATS).sum())}
    first, draw = states[:, 0], torch.Generator().manual_seed(seed)
    made = sample_rollout(model, first, states.shape[1] - 1, generator=draw).states
    for whose, shown in (("samples'", made), ("data's", states[:, 1:])):
        row |= {f"{whose} {name}": float(value.nanmean()) for name, value in looks(first, shown).items()}
    return row
