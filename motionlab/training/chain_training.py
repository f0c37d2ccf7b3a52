"""Trains the transition prior on hours of motion by chains of many steps, each of one of three kinds.

    closed   z from the posterior, of the state that the chain has reached and the next true one
    open     z from the posterior along the truth; the chain is on its own, so that its errors add up as in use
    free     z drawn from the prior; nothing is compared with the truth, only what the chain says with itself: joints
             where the pose puts them, feet that are called in contact at rest

Every chain begins at the truth. In closed ones the truth takes the place of what was reached, with a probability that
falls to zero (scheduled sampling).

A collection of recordings holds few bodies, so that motions are put on others. Inputs are standardised and outputs
scaled; at the end both are folded into the weights, so that what ships has the official architecture, and ``skip`` and
``direct``, which every model that is trained here has.

Source: HuMoR (Rempe et al. 2021), section 3.3 (closed chains); the others are ours. Its training code takes numbers as
they are, and AMASS, whose hundreds of people bring their own bodies.
Differs: errors are counted in units that matter per part (``ERROR_UNITS``) with a Huber loss; gradients flow through
some steps before the state is cut off (the official code cuts off every one) and are clipped; cosine decay; what ships
is a moving average; joints of the pose come from forward kinematics, without vertices; a linear layer past the decoder
begins at "goes on at its velocity"; velocities are backward differences; a joint that a recording lacks teaches nothing
of its rotation.
"""

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.diffusion.windows import Windows
from motionlab.errors import DataError
from motionlab.humor import body_shape, state
from motionlab.humor.priors import Cvae, Gaussian, kl
from motionlab.humor.state import DELTA_SLICES, ONWARD, SHAPES, SLICES, STATE, globalise, heading, localise, unpack
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, fk
from motionlab.training.training_loop import TrainingRun, fast_halves, seeded

_PEOPLE = 0.7  # standard deviation, in betas, of the bodies that the motions are put on
#: An error of one: metres, m/s, matrix entries, rad/s.
ERROR_UNITS = {
    "trans": 0.003, "trans_vel": 0.04, "root_orient": 0.008, "root_orient_vel": 0.1,
    "pose_body": 0.012, "joints": 0.003, "joints_vel": 0.05,
}  # fmt: skip
_SURE = -3.0  # log variance of z at first, from the posterior


@dataclass(frozen=True)
class ChainRecipe:
    """What a training run depends on, with its examples.

    width: of the networks. steps: of the optimiser. batch: chains of ``length`` transitions; open_loop, free_running:
    shares of them. chain: transitions that gradients flow through. sampling_start, sampling_end: shares of the steps
    between which scheduled sampling fades the truth out. kl: weight per nat; kl_warm_up: share of the steps over which
    it grows to that. kinematics, contact, slide: weights of those losses. average: of the weights, per step.
    """

    width: int = 512
    steps: int = 8000
    batch: int = 128
    length: int = 16
    chain: int = 8
    open_loop: float = 0.4
    free_running: float = 0.2
    lr: float = 3e-3
    sampling_start: float = 0.05
    sampling_end: float = 0.2
    kl: float = 0.02
    kl_warm_up: float = 0.1
    kinematics: float = 0.5
    contact: float = 0.7
    slide: float = 0.1
    average: float = 0.999
    seed: int = 0


@torch.no_grad()
def begun_linear(model: Cvae, scales: "Scales", past: Tensor, now: Tensor) -> None:
    """Sets the linear layers to and from z to the principal components of what differs from going on at the velocity,
    of transitions (N, 339), counted in ``ERROR_UNITS``: z begins as what the change is, and not as noise.

    By random weights z reaches the decoder in a few directions only, and training opens no more.
    """
    change, unit = unforeseen(past, now), error_units(DELTA_SLICES)
    _, size, axes = torch.linalg.svd(change / unit, full_matrices=False)
    axes, size = axes[: model.latent], size[: model.latent] / len(past) ** 0.5
    z = change / unit @ axes.mT / size
    model.decoder.net[-1].weight[:, -model.latent :] = (axes * size[:, None]).mT * (unit / scales.change)[:, None]
    rows = torch.cat((scales.rows(past, now), torch.ones(len(past), 1)), -1)
    square = rows.mT @ rows + 1e-3 * len(rows) * torch.eye(rows.shape[1])
    found = torch.linalg.solve(square, rows.mT @ z)
    model.direct.weight.copy_(found[:-1].mT), model.direct.bias.copy_(found[-1])
    for net in (model.encoder.net, model.prior_net.net):
        net[-1].weight *= 0.1
    model.encoder.net[-1].bias[model.latent :] = _SURE


class ChainTraining(TrainingRun):
    """A training run of the transition prior by chains; ``averaged`` is the model as it is shipped, frozen. start: the
    model to begin from; else z begins as the principal components of the change (:func:`begun_linear`)."""

    least = 0.01
    Recipe = ChainRecipe

    def __init__(self, recipe: ChainRecipe, windows: Windows, start: Cvae | None = None) -> None:
        if windows.length != recipe.length + 2:
            raise DataError(f"windows of {windows.length - 1} states for {recipe.length} transitions")
        self.windows = windows
        some, *_ = drawn(windows, 2000, torch.Generator().manual_seed(recipe.seed))
        pairs = tuple(x.flatten(0, 1) for x in state.transition_pairs(some))
        self.scales = replace(Scales.measure(*pairs), half=fast_halves())
        model = seeded(recipe.seed, lambda: Cvae(recipe.width, skip=True, direct=True))
        torch.nn.init.zeros_(model.skip.weight)
        with torch.no_grad():
            model.decoder.net[-1].weight *= 0.1
        if start is None:
            begun_linear(model, self.scales, *pairs)
        else:
            model = self.scales.unfolded(start).requires_grad_(requires_grad=True).train()
        optimiser = torch.optim.Adamax(model.parameters(), lr=recipe.lr)
        super().__init__(recipe, windows.digest, torch.Generator().manual_seed(recipe.seed), model, optimiser)

    def _ready(self, model: Cvae) -> Cvae:
        return self.scales.folded(model).frozen()

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        recipe, share = self.recipe, self.step / self.recipe.steps
        states, contacts, offsets, seen = drawn(self.windows, recipe.batch, self.generator)
        opened, free = (round(part * recipe.batch) for part in (recipe.open_loop, recipe.free_running))
        closed, judged = recipe.batch - opened - free, recipe.batch - free
        truth = min(1.0, max(0.0, 1 - (share - recipe.sampling_start) / (recipe.sampling_end - recipe.sampling_start)))
        with torch.autocast("cpu", torch.bfloat16, enabled=False):  # so that weights are cast once for all steps
            known = self._along(states[closed:judged])
            x, steps, pasts, posteriors, targets = states[:, 0], [], [], [], []
            for t in range(recipe.length):
                frame = heading(x)
                past, now = localise(x, frame), localise(states[:, t + 1], frame)
                q = self.scales.posterior(self.model, past[:closed], now[:closed])
                p = self.scales.prior(self.model, past[judged:])
                z = torch.cat((q.sample(self.generator), known[t], p.sample(self.generator).detach()))
                steps.append(state.apply(past, self.scales.decode(self.model, past, z)))  # in the frame before
                pasts.append(past[:closed]), posteriors.append(q), targets.append(now)
                given = torch.rand(recipe.batch, 1, generator=self.generator) < truth
                x = torch.where(given, states[:, t + 1], globalise(steps[-1][0], frame))
                x = x.detach() if (t + 1) % recipe.chain == 0 else x
            q = Gaussian(*map(torch.cat, zip(*posteriors, strict=True)))
            divergence = kl(q, self.scales.prior(self.model, torch.cat(pasts))).sum(-1).mean()
            if opened:
                divergence = (closed * divergence + opened * self._along_kl) / judged
        after, logits, now = (torch.stack(each, 1) for each in (*zip(*steps, strict=True), targets))
        parts = self._parts(after, logits, now, contacts[:, 1:], offsets, seen, judged) | {"kl": divergence}
        weights = {
            "reconstruction": 1.0, "kinematics": recipe.kinematics, "contact": recipe.contact, "slide": recipe.slide,
            "kl": recipe.kl * min(1.0, 0.1 + share / recipe.kl_warm_up),
        }  # fmt: skip
        return sum(w * parts[name] for name, w in weights.items()), parts

    def _along(self, states: Tensor) -> list[Tensor]:
        """z (B, 48) of every step along true states (B, T + 1, 339), from the posterior; its divergence is kept."""
        count, length = len(states), states.shape[1] - 1
        if not count:
            return [states.new_zeros(0, self.model.latent)] * length
        past, now = (x.flatten(0, 1) for x in state.transition_pairs(states))
        q, p = self.scales.posterior(self.model, past, now), self.scales.prior(self.model, past)
        self._along_kl = kl(q, p).sum(-1).mean()
        return list(q.sample(self.generator).unflatten(0, (count, length)).unbind(1))

    def _parts(
        self, after: Tensor, logits: Tensor, now: Tensor, contacts: Tensor, offsets: Tensor, seen: Tensor, judged: int
    ) -> dict[str, Tensor]:
        """Losses of chains (B, T, ...), of which the first ``judged`` are compared with the truth."""
        parts, truth = unpack(after), unpack(now[:judged])
        rot = torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3)
        posed, _ = fk(replace(STANDARD, offsets=offsets[:, None]), parts["trans"], rot)
        whole = {name: parts[name][:judged] - truth[name] for name in SHAPES}
        whole["pose_body"] = whole["pose_body"] * seen[:judged, None, 1:, None, None]
        speed = parts["joints_vel"][..., STANDARD.contact_indices, :].square().sum(-1)
        inside = (posed - parts["joints"]) / ERROR_UNITS["joints"]
        return {
            "reconstruction": sum(huber(error / ERROR_UNITS[name]) for name, error in whole.items()),
            "kinematics": huber((posed[:judged] - truth["joints"]) / ERROR_UNITS["joints"]) + 2 * huber(inside),
            "contact": F.binary_cross_entropy_with_logits(logits[:judged], contacts[:judged]),
            "slide": (logits.sigmoid() * speed).mean(),
        }


def drawn(
    windows: Windows, count: int, generator: torch.Generator, bodies: float = _PEOPLE
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Draws states evenly over all frames, half of them mirrored, each window on another body; computed when they are
    drawn, as those of hours of motion would not fit into memory. Velocities are backward differences.

    windows: L + 1 frames with contacts, 30 fps, floor at z = 0. bodies: standard deviation of the bodies' betas; one
    recording in three keeps its own.

    Returns:
        states (B, L, 339), contacts (B, L, 9), offsets (B, 22, 3), and which joints' rotations were recorded (B, 22).
    """
    motion, clip = windows.drawn(count, generator)
    betas = bodies * torch.randn(count, body_shape.BETAS, generator=generator)
    betas = betas * (torch.rand(count, 1, generator=generator) < 2 / 3)
    motion = _grown(motion, body_shape.scales(betas)[:, None, :, None])
    states = state.from_motion(motion, causal=True)
    recorded = torch.ones(count, len(STANDARD), dtype=torch.bool) if windows.seen is None else windows.seen[clip]
    return states[:, 1:], motion.contacts[:, 1:], motion.skeleton.offsets[:, 0], recorded


def random_body(motion: Motion, generator: torch.Generator) -> Motion:
    """Puts the same angles on a body drawn at random; the path grows with the legs, so that feet hardly slide."""
    betas = _PEOPLE * torch.randn(body_shape.BETAS, generator=generator)
    return _grown(motion, body_shape.scales(betas)[:, None])


def _grown(motion: Motion, scale: Tensor) -> Motion:
    """A motion whose bones are so many times as long, (..., 22, 1)."""
    offsets, legs = motion.skeleton.offsets * scale, STANDARD.indices(["left_knee", "left_ankle"])
    longer, before = (x[..., legs, :].norm(dim=-1).sum(-1) for x in (offsets, motion.skeleton.offsets))
    root = motion.root * (longer / before)[..., None]
    return replace(motion, skeleton=replace(motion.skeleton, offsets=offsets), root=root)


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
    def measure(cls, past: Tensor, now: Tensor) -> Self:
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
    change = torch.zeros(len(past), state.DELTA)
    for name in SHAPES:
        turned = name in state.TURNED
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
