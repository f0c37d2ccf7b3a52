"""One transition at a time against all of them in a chain: how far latents that are right locally lead astray.

From a sequence of states the posterior names a latent for every transition. Decoded one by one, each from the
sequence's own state, they show what the latents say; rolled out from the first state alone, they show what they add
up to, which is where stage 3 of the test-time optimisation starts.

Source: thesis 3.3.3, Figs. 3.10 (decoded one by one), 3.11 (the sequence), 3.12 (rolled out).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.bench import by_person
from motionlab.humor import state, testops
from motionlab.humor.energies import JOINTS, KEYPOINTS
from motionlab.humor.priors import Cvae, Priors
from motionlab.humor.rollout import infer, rollout, sample_rollout
from motionlab.metrics import tilt_and_bend
from motionlab.motion import Motion
from motionlab.training import quality
from studies.shared import joints
from studies.shared.one_step import decode_ahead


def rough(priors: Priors, truth: Motion, steps: tuple[int, int], *, noise: Tensor | None = None) -> Motion:
    """Computes stage 2's motion of clips (N, T) from their joints: with noise (N, T, 22, 3), all seen; without, only
    those above a table of 0.9 m."""
    seen, weights = joints.low_hidden(truth), KEYPOINTS
    if noise is not None:
        seen, weights = replace(seen, points=seen.points + noise, visible=torch.ones_like(seen.visible)), JOINTS
    return testops.fit(seen, priors, weights=weights, schedule=testops.Schedule(steps=(*steps, 0))).stages[2]


@dataclass(frozen=True, eq=False)
class Errors:
    """Mean distances of the 22 joints in cm, (N, T) each, from the sequence's own: by what a step or a chain knows.

    step: of one step from the sequence's own state. chain: t steps after the first. added: what the errors of the
    single steps with z come to, summed as vectors.
    """

    step: dict[str, Tensor]
    chain: dict[str, Tensor]
    added: Tensor

    def curves(self) -> dict[str, Tensor]:
        """Returns the errors that a figure shows, by name."""
        return {
            "one step, z": self.step["posterior"], "single errors added": self.added,
            "chain, z": self.chain["posterior z"], "closed loop": self.chain["closed loop"],
            "chain, prior's mean": self.chain["prior mean"], "held pose": self.chain["hold"],
        }  # fmt: skip


def errors(model: Cvae, motion: Motion) -> Errors:
    """Computes the errors of clips (N, T + 2), the first frame of which is their lead."""
    states = state.from_motion(motion, causal=model.causal)[:, 1:]
    step = quality.one_step_errors(model, states)
    step = {name: each.unflatten(0, (len(states), -1)) for name, each in step.items()}
    with torch.no_grad():
        q, _ = infer(model, states)
        made = decode_ahead(model, states[:, :-1], q.mean)
    left = state.unpack(made)["joints"] - state.unpack(states[:, 1:])["joints"]
    added = 100 * left.cumsum(1).norm(dim=-1).mean(-1)
    return Errors(step, quality.rollout_errors(model, states), added)


def measures(found: Errors, whose: Tensor) -> dict[str, tuple[Tensor, str, Tensor | float]]:
    """Computes H15's tests of a sequence: by name each person's number (P,), the statistic, and the baseline's."""
    step = {way: by_person(each.mean(1), whose) for way, each in found.step.items() if each.ndim == 2}
    last, closed = (by_person(found.chain[way][:, -1], whose) for way in ("posterior z", "closed loop"))
    straight, guessed, shown = step["constant velocity"], step["prior mean"], step["posterior"]
    return {
        "local": (shown / straight, "median", guessed / straight),
        "encodes": (shown / guessed, "median", 1.0),
        "diverges": (last / by_person(found.added[:, -1], whose), "median", 1.0),
        "largely": (last, "mean", closed),
    }


@dataclass(frozen=True, eq=False)
class Decoded:
    """A sequence and what its latents decode to, N clips of T + 1 frames, the first of which is always its own.

    steps, chain: with the posterior's mean, one by one and rolled out; blind_steps, blind_chain: with the prior's mean,
    which knows the state before and not the transition.
    """

    sequence: Motion
    steps: Motion
    blind_steps: Motion
    chain: Motion
    blind_chain: Motion


@torch.no_grad()
def decode(model: Cvae, motion: Motion) -> Decoded:
    """Infers the latents of clips (N, T + 2), the first frame of which is their lead, and decodes them in all ways."""
    states = state.from_motion(motion, causal=model.causal)[:, 1:]
    posterior, prior = infer(model, states)

    def shown(found: Tensor) -> Motion:
        return state.to_motion(torch.cat((states[:, :1], found), 1), motion.skeleton, motion.fps)

    one_by_one = [shown(decode_ahead(model, states[:, :-1], q.mean)) for q in (posterior, prior)]
    chain = rollout(model, states[:, 0], posterior.mean, with_prior=False).states
    blind = sample_rollout(model, states[:, 0], states.shape[1] - 1).states
    return Decoded(replace(motion.cut(1), contacts=None), *one_by_one, shown(chain), shown(blind))


@torch.no_grad()
def closed_loop(model: Cvae, motion: Motion) -> Motion:
    """Computes clips (N, T + 1) as :func:`decode` does, z inferred at every step from where the chain has got to."""
    states = state.from_motion(motion, causal=model.causal)[:, 1:]
    made = [states[:, 0]]
    for true in states[:, 1:].unbind(1):
        z = infer(model, torch.stack((made[-1], true), 1))[0].mean
        made.append(rollout(model, made[-1], z, with_prior=False).states[:, 0])
    return state.to_motion(torch.stack(made, 1), motion.skeleton, motion.fps)


def ways_of_two_seconds(model: Cvae, motion: Motion) -> dict[str, Motion]:
    """Computes what the person did, and three chains from the start: of the clip whose prior's mean ends in the middle
    of all clips (N, T + 2)."""
    found = decode(model, motion)
    ends = (found.blind_chain.positions[:, -1] - found.sequence.positions[:, -1]).norm(dim=-1).mean(-1)
    middle = int(ends.argsort()[len(ends) // 2])
    return {
        "the person": found.sequence.clip(middle),
        "z known, closed loop": closed_loop(model, motion.clip([middle])).clip(0),
        "z known, open loop": found.chain.clip(middle),
        "prior's mean alone": found.blind_chain.clip(middle),
    }


def knees_bent(found: Decoded, truth: Motion, whose: Tensor) -> dict[str, Tensor]:
    """Computes the share (P,) of a person's own knee bend, end less start, that each way of decoding makes.

    truth (N, T + 2): what the person did. Steps one by one: the bend of each step less that of the state it began
    from, summed. Means over a person's clips.
    """
    bends = {name: tilt_and_bend(getattr(found, name))[1].mean(-1) for name in found.__dataclass_fields__}
    true, own = tilt_and_bend(truth.cut(1))[1].mean(-1), bends["sequence"]
    wanted = true[:, -1] - true[:, 0]
    made = {
        "the sequence itself": own[:, -1] - own[:, 0],
        "one by one, z": (bends["steps"][:, 1:] - own[:, :-1]).sum(1),
        "one by one, prior's mean": (bends["blind_steps"][:, 1:] - own[:, :-1]).sum(1),
        "rolled out, z": bends["chain"][:, -1] - own[:, 0],
        "rolled out, prior's mean": bends["blind_chain"][:, -1] - own[:, 0],
    }
    return {name: by_person(bend, whose) / by_person(wanted, whose) for name, bend in made.items()}


@torch.no_grad()
def chain(step: Callable[[Tensor], Tensor], first: Tensor, steps: int) -> Tensor:
    """Computes states (B, steps + 1, 339): a first state (B, 339), and one step after the other."""
    states = [first]
    for _ in range(steps):
        states.append(step(states[-1]))
    return torch.stack(states, 1)
