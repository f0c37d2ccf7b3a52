"""Trains models of single poses side by side, on the same batches: windows of one frame, drawn by person, mirrored.

Losses: squared errors of numbers, and distances of joints (metres x 5; squared, over 0.2 m, where noise is shown, as a
diffusion model has to say means); once more those of the handles, by the recipe's ``handle_weight``. Half of what a
diffusion model sees is pure noise. A rotation that a figure lacks counts as right. Source: thesis 4.1.2 and 4.2.4.
"""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.diffusion.poses import NUMBERS, Poser, PoseRecipe
from motionlab.diffusion.windows import Windows
from motionlab.heading import stuck_root
from motionlab.metrics import masked_mean
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from motionlab.training.training_loop import fast_halves, warmed_cosine

#: What people hold a figure by.
_ENDS = ("pelvis", "head", "left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_foot", "right_foot")
_NONE, _MOST, _BLIND, _AVERAGE = 0.1, 8, 0.5, 0.999  # share without handles; handles, at most; share of pure noise


def train(recipes: Sequence[PoseRecipe], windows: Windows) -> list[Poser]:
    """Trains a model for each recipe; steps, batch, rate and seed are those of the first."""
    first = recipes[0]
    generator = torch.Generator().manual_seed(first.seed)
    models = [_begun(recipe, windows) for recipe in recipes]
    averages = deepcopy(models)
    now, mean = ([p for model in some for p in model.parameters()] for some in (models, averages))
    optimiser = torch.optim.AdamW(now, weight_decay=0.01, betas=(0.9, 0.98), fused=True)
    halves = fast_halves() and first.size > 128
    for step in range(first.steps):
        optimiser.param_groups[0]["lr"] = warmed_cosine(first.lr, step, first.steps, 100)
        loss = _loss(models, _batch(windows, models[0], first.batch, generator), halves)
        optimiser.zero_grad()
        loss.backward()
        for model in models:
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(mean, now, 1 - min(_AVERAGE, (1 + step) / (10 + step)))
    return [average.eval().requires_grad_(False) for average in averages]


def draw_handles(count: int, generator: torch.Generator) -> Tensor:
    """Which joints (count, 22) are handles: none, or up to ``_MOST``; of ``_ENDS`` in half of the poses."""
    last = torch.ones(len(STANDARD)).index_fill(0, torch.tensor(STANDARD.indices(_ENDS)), 0.0)
    ends, some = (torch.rand(count, 1, generator=generator) < share for share in (0.5, 1 - _NONE))
    order = torch.rand(count, len(STANDARD), generator=generator) + last * ends
    return (order.argsort(-1).argsort(-1) < torch.randint(1, _MOST + 1, (count, 1), generator=generator)) & some


def _begun(recipe: PoseRecipe, windows: Windows) -> Poser:
    """A new model, with the sizes of numbers: a mean each, one scale for the height and one for all rotations."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        model = Poser(recipe)
    x = model.encode(stuck(windows.draw(4000, torch.Generator().manual_seed(0))))
    spread = x.var(0)
    model.mean.copy_(x.mean(0))
    model.scale.copy_(torch.cat((spread[:1], spread[1:].mean().expand(NUMBERS - 1))).sqrt())
    return model


def stuck(motion: Motion) -> Motion:
    """Computes poses (B, 1) in their stuck frames, on the standard body that they are all on."""
    return replace(stuck_root(replace(motion, contacts=None))[0], skeleton=STANDARD)


def _batch(windows: Windows, model: Poser, count: int, generator: torch.Generator) -> tuple[Motion, Tensor, ...]:
    """Poses, joints that were recorded, handles, numbers, their noise, and angles."""
    motion, clips = windows.drawn(count, generator)
    motion = stuck(motion)
    seen = torch.ones(count, len(STANDARD), dtype=torch.bool) if windows.seen is None else windows.seen[clips]
    angle = torch.rand(count, generator=generator) * math.pi / 2
    angle = torch.where(torch.rand(count, generator=generator) < _BLIND, math.pi / 2, angle)
    noise = torch.randn(count, NUMBERS, generator=generator)
    return motion, seen, draw_handles(count, generator), model.encode(motion), noise, angle


def _loss(models: Sequence[Poser], batch: tuple[Motion, Tensor, ...], halves: bool) -> Tensor:
    """The sum of the models' losses; all that they say goes through one forward kinematics."""
    truth, seen, which, x, noise, angle = batch
    places, silent = truth.positions[:, 0], torch.full_like(angle, math.pi / 2)
    noisy = angle.cos()[:, None] * x + angle.sin()[:, None] * noise
    angles = [angle if model.recipe.diffusion else silent for model in models]
    with torch.autocast("cpu", torch.bfloat16, enabled=halves):
        said = torch.stack([m(places, which, noisy, each) for m, each in zip(models, angles, strict=True)]).float()
    made = models[0].decode(said.flatten(0, 1)).rot.unflatten(0, said.shape[:2])
    rot = torch.where(seen[:, None, :, None, None], made, truth.rot)
    root = torch.nn.functional.pad((said * models[0].scale + models[0].mean)[..., None, :1], (2, 0))
    squares = (Motion(STANDARD, root, rot, truth.fps).positions - truth.positions)[:, :, 0].square().sum(-1)
    blind = torch.stack(angles)[..., None] == math.pi / 2
    far = 5 * torch.where(blind, squares.add(1e-6).sqrt(), squares / 0.2)
    held = (far * which).sum(-1) / which.sum(-1).clamp(min=1)
    columns = torch.nn.functional.pad(seen.repeat_interleave(6, -1), (1, 0), value=True)
    weight = torch.tensor([model.recipe.handle_weight for model in models])[:, None]
    return (far.mean(-1) + masked_mean((said - x).square(), columns, 1) + weight * held).mean(1).sum()
