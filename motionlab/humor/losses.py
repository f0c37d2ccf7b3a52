"""What a transition model is trained by, and the scales that give its errors a common meaning.

Source: HuMoR (Rempe et al. 2021), section 3.3 and its official training code.
Differs, in the compact recipe: errors are counted in units that matter per part (``UNITS``) with a Huber loss, inputs
are standardised and outputs scaled, both folded into the weights at the end; joints of the pose come from forward
kinematics, where the official code also compares 6,890 vertices.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.humor.cvae import Cvae, Gaussian, kl
from motionlab.humor.state import DELTA, DELTA_SLICES, SHAPES, SLICES, STATE, apply, heading, localise, unpack
from motionlab.skeleton import STANDARD, fk

#: An error of one: metres, m/s, matrix entries, rad/s.
UNITS = {
    "trans": 0.003, "trans_vel": 0.04, "root_orient": 0.008, "root_orient_vel": 0.1,
    "pose_body": 0.012, "joints": 0.003, "joints_vel": 0.05,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scales:
    """Standardisation of states (339,) in their canonical frame, and the size of the raw output (216,)."""

    mean: Tensor
    std: Tensor
    change: Tensor

    @classmethod
    def none(cls) -> Scales:
        """The official model: numbers as they are."""
        return cls(torch.zeros(STATE), torch.ones(STATE), torch.ones(DELTA))

    @classmethod
    def measure(cls, past: Tensor, now: Tensor) -> Scales:
        """From transitions (N, 339), both in the frame of the past state."""
        change = torch.ones(DELTA)
        before, after = unpack(past), unpack(now)
        for name in SHAPES:
            if name in ("root_orient", "pose_body"):
                moved = rotation.log(after[name] @ before[name].mT)
            else:
                moved = after[name] - before[name]
            change[DELTA_SLICES[name]] = moved.flatten(1).std(0).clamp(min=1e-4)
        change[DELTA_SLICES["contacts"]] = 3.0
        return cls(past.mean(0), past.std(0).clamp(min=1e-3), change)

    def posterior(self, model: Cvae, past: Tensor, now: Tensor) -> Gaussian:
        """q(z | past, now); the second state enters as its change, in units of 16 errors."""
        units = 16 * unit(SLICES)
        rows = torch.cat(((past - self.mean) / self.std, (now - past) / units), -1)
        return Gaussian(*model.encoder(rows).chunk(2, -1))

    def prior(self, model: Cvae, past: Tensor) -> Gaussian:
        """p(z | past)."""
        return Gaussian(*model.prior_net((past - self.mean) / self.std).chunk(2, -1))

    def decode(self, model: Cvae, past: Tensor, z: Tensor) -> Tensor:
        """Raw changes and contact logits (N, 216)."""
        return model.decoder(torch.cat(((past - self.mean) / self.std, z), -1)) * self.change

    def folded(self, model: Cvae) -> Cvae:
        """The model that computes the same from plain numbers, by its weights alone: the official architecture."""
        model = deepcopy(model)
        with torch.no_grad():
            for net in (model.encoder.net, model.prior_net.net, model.decoder.net):
                weight = net[0].weight
                net[0].bias -= weight[:, :STATE] @ (self.mean / self.std)
                weight[:, :STATE] /= self.std
            weight = model.encoder.net[0].weight
            weight[:, STATE:] /= 16 * unit(SLICES)
            weight[:, :STATE] -= weight[:, STATE:]
            model.decoder.net[-1].weight *= self.change[:, None]
            model.decoder.net[-1].bias *= self.change
        return model


def unit(slices: dict[str, slice]) -> Tensor:
    """``UNITS``, one per number of a state (339,)."""
    return torch.cat([torch.full((part.stop - part.start,), UNITS[name]) for name, part in slices.items()])


class Predicted(NamedTuple):
    """Transitions: after (N, 339) in the frame of the past state, contact logits (N, 9), posterior and prior of z."""

    after: Tensor
    logits: Tensor
    q: Gaussian
    p: Gaussian


def predict(model: Cvae, scales: Scales, past: Tensor, now: Tensor, generator: torch.Generator) -> Predicted:
    """Encode pairs (N, 339) and (N, 339), both in a canonical frame, draw z, decode."""
    q, p = scales.posterior(model, past, now), scales.prior(model, past)
    return Predicted(*apply(past, scales.decode(model, past, q.sample(generator))), q, p)


def compare(
    found: Predicted, now: Tensor, contacts: Tensor, offsets: Tensor, *, official: bool = False
) -> dict[str, Tensor]:
    """Losses of predicted transitions, means over all of them.

    reconstruction: of the state. kinematics: joints of the pose against the truth and against the predicted joints.
    kl: nats. contact: cross entropy. slide: squared speed of joints that are called in contact.

    Args:
        now: (N, 339) the truth, in its canonical frame. contacts: (N, 9) of it. offsets: (N, 22, 3) bones, metres.
        official: plain mean squares of all numbers instead of Huber errors in ``UNITS``.
    """
    parts, truth = unpack(found.after), unpack(now)
    rot = torch.cat((parts["root_orient"][:, None], parts["pose_body"]), 1)
    posed, _ = fk(replace(STANDARD, offsets=offsets), parts["trans"], rot)
    size = (lambda e, name: e.square().mean()) if official else (lambda e, name: _huber(e / UNITS[name]))
    speed = parts["joints_vel"][:, STANDARD.contact_indices].square().sum(-1)
    return {
        "reconstruction": sum(size(parts[name] - truth[name], name) for name in SHAPES),
        "kinematics": size(posed - truth["joints"], "joints") + size(posed - parts["joints"], "joints"),
        "kl": kl(found.q, found.p).sum(-1).mean(),
        "contact": F.binary_cross_entropy_with_logits(found.logits, contacts),
        "slide": (found.logits.sigmoid() * speed).mean(),
    }


def _huber(error: Tensor) -> Tensor:
    return F.smooth_l1_loss(error, torch.zeros_like(error), beta=3.0)


def pairs(states: Tensor) -> tuple[Tensor, Tensor]:
    """All transitions of world states (..., T, 339), flat: past and now (N, 339) in the frame of the past."""
    frame = heading(states[..., :-1, :])
    past, now = localise(states[..., :-1, :], frame), localise(states[..., 1:, :], frame)
    return past.flatten(0, -2), now.flatten(0, -2)
