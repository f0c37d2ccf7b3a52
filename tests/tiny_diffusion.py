"""An untrained diffusion model and smooth motions, for tests that need no quality."""

from __future__ import annotations

from functools import cache

import torch

from motionlab import baselines, rotation
from motionlab.diffusion import spectral
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.model import DenoiserRecipe, Trained
from motionlab.humor.state import FPS
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT

FRAMES = 20


def smooth(count: int, seed: int = 0, frames: int = FRAMES) -> Motion:
    """Upright bodies (count, frames) that sway and travel smoothly; some joint always touches the floor."""
    generator = torch.Generator().manual_seed(seed)
    slow = baselines.cosine_transform(frames)[:4].T
    turn = slow @ torch.randn(count, 4, 22 * 3, generator=generator) * 0.4
    rot = rotation.exp(turn.unflatten(-1, (22, 3)))
    rot[:, :, 0] = rot[:, :, 0] @ UPRIGHT
    root = slow @ torch.randn(count, 4, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.9])
    contacts = (torch.rand(count, frames, len(STANDARD.contact_names), generator=generator) < 0.5).float()
    return Motion(STANDARD, root, rot, FPS, contacts)


@cache
def tiny(*, told: bool = False, frame: str = "stuck") -> Trained:
    """A small spectral model with the statistics of smooth motions and weights of chance."""
    recipe = DenoiserRecipe(size="small", frames=FRAMES, patch=2, spectral=True, told=told, frame=frame)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = recipe.denoiser().eval().requires_grad_(False)
    rows = recipe.layout.encode(smooth(40))
    normaliser = Normaliser.measure(rows, recipe.layout)
    model.spectrum.copy_(spectral.power(normaliser.apply(rows)))
    return Trained(model, recipe.schedule, recipe.layout, normaliser, recipe)
