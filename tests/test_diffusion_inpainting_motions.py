"""Inpainting by every way: what is known stays, what is hidden is never read, a perfect denoiser fills in perfectly."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from motionlab.diffusion import sampling
from motionlab.diffusion.features import Normaliser, units
from motionlab.diffusion.model import DenoiserRecipe, MotionDiffusion
from motionlab.diffusion.sampling import Inpainting
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.skeleton import STANDARD

WAYS = {
    "eq. 4.10": Inpainting(),
    "guided": Inpainting(guidance_weight=1.0),
    "soft": Inpainting(mask_ramp=2, replace_last=False, blend_frames=4),  # else held values would be blended in
    "finish": Inpainting(replace_last=False, blend_frames=4),
}


@pytest.fixture(scope="module")
def motion(motions):
    """Six windows of 12 frames of a walk, anywhere in the room."""
    return replace(gather([on_standard(motions[0])], 12).evenly(6), skeleton=STANDARD)


class Oracle(nn.Module):
    """Knows the truth."""

    def __init__(self, x0):
        super().__init__()
        self.x0 = x0
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, x, stamps):
        return self.x0 + 0 * x + self.weight


def whole_frames(model, only):
    """Known (12, D): all of these frames."""
    return (torch.arange(12)[:, None] == torch.tensor(only)).any(1)[:, None].expand(-1, model.layout.size)


def model_of(motion):
    recipe = DenoiserRecipe(frames=12, noising=50)
    normaliser = Normaliser.measure(recipe.layout.encode(motion), recipe.layout)
    x0 = normaliser.apply(recipe.layout.encode(motion))
    return MotionDiffusion(Oracle(x0), recipe.schedule, recipe.layout, normaliser, recipe)


@pytest.mark.parametrize("way", WAYS)
def test_with_a_perfect_denoiser_every_way_returns_the_truth_where_it_was(motion, generator, way):
    model = model_of(motion)
    known = whole_frames(model, [0, 1, 2, 9, 10, 11])
    made = model.inpaint(motion, known, generator, replace(WAYS[way], steps=10))
    assert (made.positions - motion.positions).abs().max() < 1e-3
    assert made.fps == motion.fps and motion.root[..., :2].std() > 0.05  # they were not at the origin


@pytest.mark.parametrize("way", WAYS)
def test_hidden_numbers_are_never_read(motion, way):
    model, way = model_of(motion), replace(WAYS[way], steps=5)
    known = torch.isin(units(model.layout), torch.tensor(STANDARD.indices(["spine1", "spine2", "neck"])))
    known = known.expand(12, -1)
    x0 = model.encode(motion)
    spoilt = torch.where(known, x0, float("nan"))
    first, second = (
        sampling.inpaint(model.denoiser, model.schedule, x, known, torch.Generator().manual_seed(1), way)
        for x in (x0, spoilt)
    )
    assert first.isfinite().all() and torch.equal(first, second)


def test_known_numbers_are_exact_unless_the_last_replacement_is_left_out(motion, generator):
    model = model_of(motion)
    x0, known = model.encode(motion), whole_frames(model, [0, 11])
    model.denoiser.x0 = torch.zeros_like(x0)  # a denoiser that is wrong everywhere
    left = Inpainting(steps=9, replace_last=False)
    ways = {"last": Inpainting(steps=9), "not": left, "finish": Inpainting(replace_last=False, blend_frames=3)}
    ways |= {"guided": replace(ways["last"], guidance_weight=1.0), "guided, not": replace(left, guidance_weight=1.0)}
    gaps = {
        name: (sampling.inpaint(model.denoiser, model.schedule, x0, known, generator, way) - x0)[:, known].abs().max()
        for name, way in ways.items()
    }
    assert gaps["last"] < 1e-6 and gaps["finish"] < 1e-6 and gaps["not"] > 0.1
    assert gaps["guided"] < 1e-6 and gaps["guided, not"] > 0.1


def test_an_unknown_number_takes_the_nearest_known_value_for_a_soft_mask():
    x = torch.arange(6.0)[None, :, None].expand(1, 6, 2).contiguous()
    known = torch.zeros(6, 2, dtype=torch.bool)
    known[[1, 5], 0] = True
    held, _ = sampling._softened(torch.where(known, x, 0.0), known, 3)
    assert held[0, :, 0].tolist() == [1, 1, 1, 1, 5, 5] and not held[0, :, 1].any()


def test_what_makes_no_sense_is_refused(motion, generator):
    model = model_of(motion)
    with pytest.raises(ShapeError, match="known"):
        model.inpaint(motion, torch.ones(11, model.layout.size, dtype=torch.bool), generator)
