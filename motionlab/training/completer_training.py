"""Trains a completer: windows by person, every kind of mask, and the distance of joints as its loss.

Losses: distance of every joint whose place is open (metres, x 5) and of its velocity (metres a frame, x 10), squared
errors of open 6-D numbers and contacts. A diffusion model has to say means, so that its distances are squared, too
(over 0.2 m, and over 3 cm a frame). Source: thesis 4.1.2, whose denoiser has the same parts.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.baselines import Noise, denoised
from motionlab.contact import with_contacts
from motionlab.diffusion import features
from motionlab.diffusion.completer import Completer, CompleterRecipe, motion_noise
from motionlab.diffusion.windows import Windows, draw_units
from motionlab.heading import stuck_root, world_to_local
from motionlab.motion import Motion
from motionlab.training.training_loop import TrainingRun, fast_halves, seeded

_MEASURED = 2000  # windows that the sizes of numbers are measured on
_WEIGHTS = {"places": 5.0, "moves": 10.0, "rotations": 1.0, "contacts": 0.3}
_SQUARED = {"places": 1 / 0.2, "moves": 1 / 0.03}  # per metre
_SILENT = 0.3  # of windows: contacts are told nowhere, as of motion that nobody labelled
_ROUGH = (8.0, 4.0)  # degrees, centimetres of noise, at most


class CompleterTraining(TrainingRun):
    """A training run of a completer. start: the model to begin from, with its sizes of numbers; None: new weights."""

    Recipe = CompleterRecipe

    def __init__(self, recipe: CompleterRecipe, windows: Windows, start: Completer | None = None) -> None:
        self.windows = windows
        model = seeded(recipe.seed, lambda: Completer(recipe))
        if start is not None:
            model.load_state_dict(start.state_dict())
        else:
            some = stuck_root(windows.draw(_MEASURED, torch.Generator().manual_seed(0)))[0]
            for kept, found in zip((model.mean, model.scale), features.sizes(features.states(some)), strict=True):
                kept.copy_(found)
        model.halves = fast_halves()
        how = {"lr": recipe.lr, "weight_decay": recipe.decay, "betas": (0.9, 0.98)}
        optimiser = torch.optim.AdamW(model.parameters(), **how)
        super().__init__(recipe, windows.digest, torch.Generator().manual_seed(recipe.seed), model, optimiser)

    def _ready(self, model: Completer) -> Completer:
        model.halves = False
        return model

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        recipe = self.recipe
        motion, clips = self.windows.drawn(recipe.batch, self.generator)
        seen = torch.ones(recipe.batch, features.UNITS, dtype=torch.bool)
        if self.windows.seen is not None:
            seen[:, :-2] = self.windows.seen[clips]
        if recipe.refines:
            shown, tremble = self._smoothed(motion)
            shown, frame = stuck_root(shown)
            motion = world_to_local(frame, motion)
            known = torch.zeros(*shown.root.shape[:2], features.UNITS, dtype=torch.bool)
            made = self.model.filled(shown, known, tremble=tremble)
        else:
            motion = stuck_root(motion)[0]
            known = draw_units(recipe.frames, recipe.batch, self.generator, dict(recipe.kinds)) & seen[:, None]
            silent = torch.rand(recipe.batch, 1, generator=self.generator) < _SILENT
            known[..., -1] &= ~silent
            made = self.model.filled(motion, known, *self._noise(known))
        parts = losses(made, motion, known, seen, self.model.sizes[1], squared=recipe.diffusion)
        return sum(_WEIGHTS[name] * part for name, part in parts.items()), parts

    def _smoothed(self, motion: Motion) -> tuple[Motion, Tensor]:
        """Windows that tremble, by as much as is drawn, and are smoothed; and by how much joints did (B,)."""
        turn, shift = torch.rand(2, generator=self.generator).tolist()
        noise = Noise.of(_ROUGH[0] * turn, _ROUGH[1] * shift)
        shown = with_contacts(denoised(noise.on(motion, self.generator), noise))
        return shown, torch.full((len(motion.root),), noise.turn)

    def _noise(self, known: Tensor) -> tuple[Tensor, Tensor] | tuple[()]:
        """Angles (B,), evenly but for those at pure noise, and noise (B, T, ``MADE``); nothing without noise."""
        if not self.recipe.diffusion:
            return ()
        angle = torch.rand(len(known), generator=self.generator) * math.pi / 2
        blind = torch.rand(len(known), generator=self.generator) < self.recipe.pure_noise_share
        return torch.where(blind, math.pi / 2, angle), motion_noise(known, self.windows.fps, self.generator)


def losses(
    made: Motion, truth: Motion, known: Tensor, seen: Tensor, scale: Tensor, *, squared: bool = False
) -> dict[str, Tensor]:
    """Computes the parts of the loss of windows (B, T), each window's mean over what was open in it.

    known (B, T, ``UNITS``), seen (B, ``UNITS``): units that were told, and that were recorded at all. What was not
    recorded counts as right: its rotation is made up, but the places of the joints above it are not. squared: distances
    of joints are.
    """
    told = known | ~seen[:, None]
    open_ = features.open_places(told).float()
    whole = replace(made, rot=torch.where(told[..., :-2, None, None], truth.rot, made.rot))
    off = whole.positions - truth.positions
    places, moves = (x.square().sum(-1) for x in (off, off.diff(dim=1)))
    if squared:
        places, moves = places * _SQUARED["places"], moves * _SQUARED["moves"]
    else:
        places, moves = (x.add(1e-6).sqrt() for x in (places, moves))
    both = torch.maximum(open_[:, 1:], open_[:, :-1])
    asked = (~known & seen[:, None]).float()
    columns = asked[..., features.OWNERS]
    squares = ((features.made(made) - features.made(truth)) / scale).square()
    rotations = squares[..., 3 : -len(truth.skeleton.contact_names)]
    steps = (made.contacts - truth.contacts).square()
    return {
        "places": _mean(places, open_),
        "moves": _mean(moves, both),
        "rotations": _mean(rotations, columns[..., 3 : 3 + rotations.shape[-1]]),
        "contacts": _mean(steps, asked[..., -1:].expand_as(steps)),
    }


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """The mean over windows that have any weight of each window's weighted mean."""
    total = weight.flatten(1).sum(1)
    mine = (values * weight).flatten(1).sum(1) / total.clamp(min=1.0)
    return mine.sum() / (total > 0).sum().clamp(min=1)
