"""The units in which training counts errors of transitions, and the scales that a model's numbers are learnt in.

Inputs are standardised and outputs scaled; at the end both are folded into the weights, so that what ships has the
official architecture, and ``skip`` and ``direct``, which every model that is trained here has. Source: HuMoR (Rempe et
al. 2021), section 3.3, whose training code takes numbers as they are.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.state import DELTA, DELTA_SLICES, ONWARD, SHAPES, SLICES, STATE, TURNED, unpack

#: An error of one: metres, m/s, matrix entries, rad/s.
ERROR_UNITS = {
    "trans": 0.003, "trans_vel": 0.04, "root_orient": 0.008, "root_orient_vel": 0.1,
    "pose_body": 0.012, "joints": 0.003, "joints_vel": 0.05,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scales:
    """Standardisation of states (339,) in their canonical frame, and the size of the raw output (216,).

    half: networks compute in bfloat16, which some processors do several times faster; weights stay in single precision.
    """

    mean: Tensor
    std: Tensor
    change: Tensor
    half: bool = False

    @classmethod
    def measure(cls, past: Tensor, now: Tensor) -> Scales:
        """From transitions (N, 339), both in the frame of the past state; the change is what differs from going on at
        the velocity."""
        change = unforeseen(past, now).std(0).clamp(min=1e-4)
        change[DELTA_SLICES["contacts"]] = 3.0
        return cls(past.mean(0), past.std(0).clamp(min=1e-3), change)

    def rows(self, past: Tensor, now: Tensor) -> Tensor:
        """What the encoder takes (N, 678): the second state enters as its change, in units of 16 errors."""
        return torch.cat(((past - self.mean) / self.std, (now - past) / (16 * error_units(SLICES))), -1)

    def posterior(self, model: Cvae, past: Tensor, now: Tensor) -> Gaussian:
        """q(z | past, now)."""
        rows = self.rows(past, now)
        with self._precision():
            mean, log_var = model.encoder(rows).to(past).chunk(2, -1)
        return Gaussian(mean + model.direct(rows), log_var)

    def prior(self, model: Cvae, past: Tensor) -> Gaussian:
        """p(z | past)."""
        with self._precision():
            return Gaussian(*model.prior_net((past - self.mean) / self.std).to(past).chunk(2, -1))

    def decode(self, model: Cvae, past: Tensor, z: Tensor) -> Tensor:
        """Raw changes and contact logits (N, 216)."""
        rows = (past - self.mean) / self.std
        with self._precision():
            raw = model.decoder(torch.cat((rows, z), -1)).to(past) + model.skip(rows).to(past)
        return raw * self.change + past @ ONWARD.mT.to(past)

    def _precision(self) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16, enabled=self.half)

    def folded(self, model: Cvae) -> Cvae:
        """The model that computes the same from plain numbers, by its weights alone."""
        model = deepcopy(model)
        with torch.no_grad():
            encoding = model.encoder.net[0], model.direct
            for first in (*encoding, model.prior_net.net[0], model.decoder.net[0]):
                first.bias -= first.weight[:, :STATE] @ (self.mean / self.std)
                first.weight[:, :STATE] /= self.std
            for first in encoding:
                first.weight[:, STATE:] /= 16 * error_units(SLICES)
                first.weight[:, :STATE] -= first.weight[:, STATE:]
            model.decoder.net[-1].weight *= self.change[:, None]
            model.decoder.net[-1].bias *= self.change
            weight = self.change[:, None] * model.skip.weight / self.std
            model.decoder.net[-1].bias -= weight @ self.mean
            model.skip.weight.copy_(weight + ONWARD)
        return model

    def unfolded(self, model: Cvae) -> Cvae:
        """The weights that ``folded`` makes this model of: what training goes on from."""
        model = deepcopy(model)
        with torch.no_grad():
            encoding = model.encoder.net[0], model.direct
            for first in encoding:
                first.weight[:, :STATE] += first.weight[:, STATE:]
                first.weight[:, STATE:] *= 16 * error_units(SLICES)
            for first in (*encoding, model.prior_net.net[0], model.decoder.net[0]):
                first.weight[:, :STATE] *= self.std
                first.bias += first.weight[:, :STATE] @ (self.mean / self.std)
            weight = model.skip.weight - ONWARD
            model.decoder.net[-1].bias += weight @ self.mean
            model.skip.weight.copy_(weight * self.std / self.change[:, None])
            model.decoder.net[-1].weight /= self.change[:, None]
            model.decoder.net[-1].bias /= self.change
        return model


def unforeseen(past: Tensor, now: Tensor) -> Tensor:
    """Computes the raw changes (N, 216) of transitions (N, 339) less those of going on at the velocity; contacts 0."""
    before, after, onward = unpack(past), unpack(now), past @ ONWARD.mT
    change = torch.zeros(len(past), DELTA)
    for name in SHAPES:
        turned = name in TURNED
        moved = rotation.log(after[name] @ before[name].mT) if turned else after[name] - before[name]
        change[:, DELTA_SLICES[name]] = moved.flatten(1) - onward[:, DELTA_SLICES[name]]
    return change


def error_units(slices: dict[str, slice]) -> Tensor:
    """Returns ``ERROR_UNITS``, one per number of a state (339,) or of raw outputs (216,), contacts 1."""
    units = [torch.full((part.stop - part.start,), ERROR_UNITS.get(name, 1.0)) for name, part in slices.items()]
    return torch.cat(units)


def huber(error: Tensor) -> Tensor:
    """Computes the mean Huber loss of errors in their units, linear from 3 on."""
    return F.smooth_l1_loss(error, torch.zeros_like(error), beta=3.0)
