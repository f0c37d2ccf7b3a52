"""People behind a wall or a desk, fitted, and what else they could have been doing: places about the pelvis, metres."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from data_synth import scenes
from data_synth.scenes import Scene
from motionlab import posterior
from motionlab.bench import HIDDEN, JOINTS
from motionlab.diffusion import completer
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule, fit
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.shared import clips

TEMPERATURES = (1.0, 10.0, 30.0, 100.0)
SIDES = {side: STANDARD.indices([n for n in HIDDEN if n.startswith(side)]) for side in ("left", "right")}


@dataclass(frozen=True, eq=False)
class Clip:
    """One clip: M places of hidden limbs about the pelvis, one for each joint and frame.

    person: who it is. truth, fit (M, 3): true and fitted. drawn: temperature -> draws (K, M, 3).
    rival: draws of chapter 4's network (K, M, 3). seen: mean error of the limbs that were seen. doubtful: by the fit.
    """

    person: str
    truth: Tensor
    fit: Tensor
    drawn: dict[float, Tensor]
    rival: Tensor | None = None
    seen: float = math.nan
    doubtful: bool = False

    @property
    def error(self) -> Tensor:
        """Distances (M,) of the fit from the truth."""
        return (self.fit - self.truth).norm(dim=-1)


def recorded(folder: Path, part: str, count: int, seed: int) -> tuple[Scene, tuple[str, ...]]:
    """Films people of the CMU library, one walk and one other clip each, at most ``count`` of either, behind a low wall
    or, where they go nowhere, a desk; and who they are. Where a clip begins is drawn."""
    cast = []
    for metres in (1.5, -1.0):
        draws = torch.Generator().manual_seed(seed)
        cast += clips.begun(clips.takes(folder, part), partial(clips.goes, metres=metres), draws, 1, count)
    people, motions = zip(*cast, strict=True)
    return scenes.film_recorded("behind a low wall", [replace(m, name="") for m in motions], seed=seed), people


def fitted(scene: Scene, priors: Priors, work: Schedule, batch: int = 8) -> list[tuple[Fitted, int]]:
    """Fits every clip as ``motionlab fit`` does, some at once: of each the fit that it is in, and its place there."""
    found = []
    for at in torch.arange(len(scene)).split(batch):
        cameras = [scene.cameras[k] for k in at.tolist()]
        one = fit(clips.part(scene.observation, at), priors, cameras=cameras, schedule=work, solver="shooting")
        found += [(one, k) for k in range(len(at))]
    return found


def opened(
    fits: Sequence[tuple[Fitted, int]], scene: Scene, people: Sequence[str], seed: int, count: int = 32
) -> list[Clip]:
    """Draws from every clip's posterior at ``TEMPERATURES``, ``count`` motions at each."""
    found, heats = [], torch.tensor(TEMPERATURES).repeat_interleave(count)
    for index, ((fit_, k), person) in enumerate(zip(fits, people, strict=True)):
        generator = torch.Generator().manual_seed(1000 * seed + index)
        draws = posterior.sample(fit_, len(heats), generator=generator, clip=k, temperature=heats)
        places = about_pelvis(draws.motions)[:, draws.hidden].split(count)
        true, own = (about_pelvis(m) for m in (scene.truth.clip(index), draws.fit))
        shown = (own - true).norm(dim=-1)[draws.limbs & ~draws.hidden].mean()
        drawn = dict(zip(TEMPERATURES, places, strict=True))
        how = {"seen": shown.item(), "doubtful": bool(draws.diagnostics)}
        found.append(Clip(person, true[draws.hidden], own[draws.hidden], drawn, **how))
    return found


def about_pelvis(motion: Motion) -> Tensor:
    """Computes where joints (..., T, J, 3) are from the pelvis."""
    return motion.positions - motion.root[..., None, :]


def with_chapter_4(
    clips: Sequence[Clip], fits: Sequence[tuple[Fitted, int]], generator: torch.Generator, count: int = 16
) -> list[Clip]:
    """Draws the hidden legs of fits anew by our network of chapter 4, too (``completer_draws``, ten steps).

    It is told the fit, but for the rotations of a leg while a joint of it is hidden.
    """
    found, network = [], completer.load("completer_draws")
    for clip, (fit_, k) in zip(clips, fits, strict=True):
        draws = posterior.sample(fit_, 1, generator=generator, clip=k)
        known = torch.ones(draws.fit.frames, JOINTS + 2, dtype=torch.bool)
        for joints in SIDES.values():
            known[:, joints] &= ~draws.hidden[:, joints].any(-1, keepdim=True)
        known[:, -1] = False
        skeleton = replace(draws.fit.skeleton, offsets=draws.fit.skeleton.offsets.reshape(1, 1, -1, 3))
        root, rot = draws.fit.root.expand(count, -1, -1), draws.fit.rot.expand(count, -1, -1, -1, -1)
        many = replace(draws.fit, skeleton=skeleton, root=root, rot=rot, contacts=None)
        made = network.complete(many, known.expand(count, -1, -1), generator)
        found.append(replace(clip, rival=about_pelvis(made)[:, draws.hidden]))
    return found
