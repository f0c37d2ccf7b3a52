"""Training of the transition prior: from single steps to roll-outs on its own predictions; resumable to the bit.

First every step sees the truth, then the truth with falling probability (scheduled sampling), then only the model's own
states. The KL weight grows.

Source: HuMoR (Rempe et al. 2021), section 3.3 and its official training code; Adamax.
Differs, in the compact recipe: errors are counted in units that matter per part (``ERROR_UNITS``) with a Huber loss;
inputs are standardised and outputs scaled, both folded into the weights at the end; gradients flow through ``chain``
steps before the state is cut off (the official code cuts off every one) and are clipped; the KL weight starts at a
tenth; truth or prediction is drawn per window, not per batch; cosine decay; the shipped weights are a moving average; a
loss that is not finite ends the run.
Differs, in both: joints of the pose come from forward kinematics, without vertices; steps instead of epochs; windows
drawn evenly over all frames, and from mirror images too; the last weights ship, not those with the least loss on
validation; gradients that are infinite, not just NaN, are skipped too (official) or end the run.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.errors import DataError
from motionlab.humor.cvae import Cvae, Gaussian, kl
from motionlab.humor.examples import Examples
from motionlab.humor.state import (
    DELTA,
    DELTA_SLICES,
    ONWARD,
    SHAPES,
    SLICES,
    STATE,
    apply,
    globalise,
    heading,
    localise,
    unpack,
)
from motionlab.skeleton import STANDARD, fk
from motionlab.training_loop import TrainingRun

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
    def none(cls) -> Scales:
        """The official model: numbers as they are."""
        return cls(torch.zeros(STATE), torch.ones(STATE), torch.ones(DELTA))

    @classmethod
    def measure(cls, past: Tensor, now: Tensor, *, skip: bool = False) -> Scales:
        """From transitions (N, 339), both in the frame of the past state. skip: of what differs from going on at the
        velocity."""
        change = torch.ones(DELTA)
        onward = past @ ONWARD.mT if skip else torch.zeros(len(past), DELTA)
        before, after = unpack(past), unpack(now)
        for name in SHAPES:
            if name in ("root_orient", "pose_body"):
                moved = rotation.log(after[name] @ before[name].mT)
            else:
                moved = after[name] - before[name]
            moved = moved.flatten(1) - onward[:, DELTA_SLICES[name]]
            change[DELTA_SLICES[name]] = moved.std(0).clamp(min=1e-4)
        change[DELTA_SLICES["contacts"]] = 3.0
        return cls(past.mean(0), past.std(0).clamp(min=1e-3), change)

    def rows(self, past: Tensor, now: Tensor) -> Tensor:
        """What the encoder takes (N, 678): the second state enters as its change, in units of 16 errors."""
        return torch.cat(((past - self.mean) / self.std, (now - past) / (16 * _unit(SLICES))), -1)

    def posterior(self, model: Cvae, past: Tensor, now: Tensor) -> Gaussian:
        """q(z | past, now)."""
        rows = self.rows(past, now)
        with self._precision():
            mean, log_var = model.encoder(rows).to(past).chunk(2, -1)
        return Gaussian(mean if model.direct is None else mean + model.direct(rows), log_var)

    def prior(self, model: Cvae, past: Tensor) -> Gaussian:
        """p(z | past)."""
        with self._precision():
            return Gaussian(*model.prior_net((past - self.mean) / self.std).to(past).chunk(2, -1))

    def decode(self, model: Cvae, past: Tensor, z: Tensor) -> Tensor:
        """Raw changes and contact logits (N, 216)."""
        rows = (past - self.mean) / self.std
        with self._precision():
            raw = model.decoder(torch.cat((rows, z), -1)).to(past)
            raw = raw if model.skip is None else raw + model.skip(rows).to(past)
        return raw * self.change + (0.0 if model.skip is None else past @ ONWARD.mT.to(past))

    def _precision(self) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16, enabled=self.half)

    def folded(self, model: Cvae) -> Cvae:
        """The model that computes the same from plain numbers, by its weights alone: the official architecture, but for
        ``skip`` and ``direct``."""
        model = deepcopy(model)
        with torch.no_grad():
            encoding = _encoding(model)
            for first in (*encoding, model.prior_net.net[0], model.decoder.net[0]):
                first.bias -= first.weight[:, :STATE] @ (self.mean / self.std)
                first.weight[:, :STATE] /= self.std
            for first in encoding:
                first.weight[:, STATE:] /= 16 * _unit(SLICES)
                first.weight[:, :STATE] -= first.weight[:, STATE:]
            model.decoder.net[-1].weight *= self.change[:, None]
            model.decoder.net[-1].bias *= self.change
            if model.skip is not None:
                weight = self.change[:, None] * model.skip.weight / self.std
                model.decoder.net[-1].bias -= weight @ self.mean
                model.skip.weight.copy_(weight + ONWARD)
        return model

    def unfolded(self, model: Cvae) -> Cvae:
        """The weights that ``folded`` makes this model of: what training goes on from."""
        model = deepcopy(model)
        with torch.no_grad():
            encoding = _encoding(model)
            for first in encoding:
                first.weight[:, :STATE] += first.weight[:, STATE:]
                first.weight[:, STATE:] *= 16 * _unit(SLICES)
            for first in (*encoding, model.prior_net.net[0], model.decoder.net[0]):
                first.weight[:, :STATE] *= self.std
                first.bias += first.weight[:, :STATE] @ (self.mean / self.std)
            if model.skip is not None:
                weight = model.skip.weight - ONWARD
                model.decoder.net[-1].bias += weight @ self.mean
                model.skip.weight.copy_(weight * self.std / self.change[:, None])
            model.decoder.net[-1].weight /= self.change[:, None]
            model.decoder.net[-1].bias /= self.change
        return model


def _encoding(model: Cvae) -> tuple[torch.nn.Linear, ...]:
    """The layers that take both states."""
    return (model.encoder.net[0], *(() if model.direct is None else (model.direct,)))


def _unit(slices: dict[str, slice]) -> Tensor:
    """``ERROR_UNITS``, one per number of a state (339,)."""
    return torch.cat([torch.full((part.stop - part.start,), ERROR_UNITS[name]) for name, part in slices.items()])


class Predicted(NamedTuple):
    """Transitions: after (N, 339) in the frame of the past state, contact logits (N, 9), posterior and prior of z."""

    after: Tensor
    logits: Tensor
    q: Gaussian
    p: Gaussian


def _predict(model: Cvae, scales: Scales, past: Tensor, now: Tensor, generator: torch.Generator) -> Predicted:
    """Encode pairs (N, 339) and (N, 339), both in a canonical frame, draw z, decode."""
    q, p = scales.posterior(model, past, now), scales.prior(model, past)
    return Predicted(*apply(past, scales.decode(model, past, q.sample(generator))), q, p)


def _transition_losses(
    found: Predicted, now: Tensor, contacts: Tensor, offsets: Tensor, *, official: bool = False
) -> dict[str, Tensor]:
    """Losses of predicted transitions, means over all of them.

    reconstruction: of the state. kinematics: joints of the pose against the truth and against the predicted joints.
    kl: nats. contact: cross entropy. slide: squared speed of joints that are called in contact.

    Args:
        now: (N, 339) the truth, in its canonical frame. contacts: (N, 9) of it. offsets: (N, 22, 3) bones, metres.
        official: plain mean squares of all numbers instead of Huber errors in ``ERROR_UNITS``.
    """
    parts, truth = unpack(found.after), unpack(now)
    rot = torch.cat((parts["root_orient"][:, None], parts["pose_body"]), 1)
    posed, _ = fk(replace(STANDARD, offsets=offsets), parts["trans"], rot)
    size = (lambda e, name: e.square().mean()) if official else (lambda e, name: _huber(e / ERROR_UNITS[name]))
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


def transition_pairs(states: Tensor) -> tuple[Tensor, Tensor]:
    """All transitions of world states (..., T, 339), flat: past and now (N, 339) in the frame of the past."""
    frame = heading(states[..., :-1, :])
    past, now = localise(states[..., :-1, :], frame), localise(states[..., 1:, :], frame)
    return past.flatten(0, -2), now.flatten(0, -2)


@dataclass(frozen=True)
class PriorRecipe:
    """What a training run depends on, with its examples.

    width: of the networks. steps: of the optimiser. batch: windows of ``length`` transitions each. chain: transitions
    that gradients flow through. supervised, sampled: shares of the steps that see the truth, and by which it has faded
    out. kl: weight per nat; annealed: share of the steps over which it grows to that (from a tenth it gets there a
    little sooner). kinematics, contact, slide: weights of those losses. average: of the weights, per step. varied,
    varied_recordings: copies on other bodies, held otherwise, of every synthetic motion and every recording (see
    ``examples``). official: its losses, scales, schedules and what it does about numbers that are not finite.
    """

    width: int = 512
    steps: int = 6600
    batch: int = 160
    length: int = 10
    chain: int = 5
    lr: float = 4e-3
    supervised: float = 0.1
    sampled: float = 0.35
    kl: float = 0.006
    annealed: float = 0.2
    kinematics: float = 0.5
    contact: float = 0.7
    slide: float = 0.1
    average: float = 0.998
    varied: int = 1
    varied_recordings: int = 2
    seed: int = 0
    official: bool = False


#: "official": 200 epochs of the official training set are about 400,000 steps; its rate falls at epochs 50, 80 and 140.
PRIOR_PRESETS = {
    "compact": PriorRecipe(),
    "official": PriorRecipe(
        width=1024, steps=400_000, batch=200, chain=1, lr=1e-4, supervised=0.05, sampled=0.10, kl=4e-4, annealed=0.25,
        kinematics=1.0, contact=0.01, slide=0.01, average=0.0, varied=0, varied_recordings=0,
        official=True,
    ),
}  # fmt: skip
_DECAYS = (0.25, 0.40, 0.70)


class PriorTraining(TrainingRun):
    """A training run of the transition prior.

    ``averaged`` is the averaged model as it is shipped: official architecture, frozen. With the official recipe batches
    that are not finite are skipped, until ``give_up`` in a row; otherwise the first one ends the run.
    """

    data_name = "examples"

    def __init__(self, recipe: PriorRecipe, examples: Examples) -> None:
        if examples.length != recipe.length + 1:
            raise DataError(f"windows of {examples.length} frames for {recipe.length} transitions")
        self.examples, self.scales = examples, Scales.none()
        if recipe.official:
            self.give_up, self.clip = 100, None
        else:
            some, _, _ = examples.draw(2000, torch.Generator().manual_seed(recipe.seed))
            self.scales = Scales.measure(*transition_pairs(some))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            model = Cvae(recipe.width)
        super().__init__(recipe, examples.digest, torch.Generator().manual_seed(recipe.seed), model)

    @classmethod
    def _recipe(cls, content: dict) -> PriorRecipe:
        return PriorRecipe(**content)

    def _optimiser(self) -> torch.optim.Optimizer:
        return torch.optim.Adamax(self.model.parameters(), lr=self.recipe.lr)

    def _made(self, weights: dict[str, Tensor]) -> Cvae:
        model = Cvae(self.recipe.width)
        model.load_state_dict(weights)
        return self.scales.folded(model).frozen()

    def _rate(self) -> float:
        if self.recipe.official:
            return self.recipe.lr * 0.5 ** sum(self.step / self.recipe.steps >= at for at in _DECAYS)
        warm = min(1.0, (self.step + 1) / 50)
        return self.recipe.lr * (warm * (0.51 + 0.49 * math.cos(math.pi * self.step / self.recipe.steps)))

    def _kl(self, share: float) -> float:
        """Weight of the KL divergence after this share of the steps."""
        return self.recipe.kl * min(1.0, (0.0 if self.recipe.official else 0.1) + share / self.recipe.annealed)

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        recipe, share = self.recipe, self.step / self.recipe.steps
        truth = min(1.0, max(0.0, 1 - (share - recipe.supervised) / (recipe.sampled - recipe.supervised)))
        states, contacts, offsets = self.examples.draw(recipe.batch, self.generator)
        x, steps, targets = states[:, 0], [], []
        for t in range(recipe.length):
            frame = heading(x)
            past = localise(x, frame)
            now = localise(states[:, t + 1], heading(states[:, t]) if recipe.official else frame)
            found = _predict(self.model, self.scales, past, now, self.generator)
            steps.append(found)
            targets.append(now)
            given = torch.rand(1 if recipe.official else recipe.batch, 1, generator=self.generator) < truth
            x = torch.where(given, states[:, t + 1], globalise(found.after, frame))
            if (t + 1) % recipe.chain == 0:
                x = x.detach()
        together = Predicted(
            torch.cat([each.after for each in steps]), torch.cat([each.logits for each in steps]),
            Gaussian(*map(torch.cat, zip(*(each.q for each in steps), strict=True))),
            Gaussian(*map(torch.cat, zip(*(each.p for each in steps), strict=True))),
        )  # fmt: skip
        parts = _transition_losses(
            together, torch.cat(targets), contacts[:, 1:].transpose(0, 1).flatten(0, 1),
            offsets.repeat(recipe.length, 1, 1), official=recipe.official,
        )  # fmt: skip
        weights = {
            "reconstruction": 1.0, "kinematics": recipe.kinematics, "kl": self._kl(share), "contact": recipe.contact,
            "slide": recipe.slide,
        }  # fmt: skip
        return sum(w * parts[name] for name, w in weights.items()), parts
