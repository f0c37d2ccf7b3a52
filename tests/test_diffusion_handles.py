"""Handles: which are drawn, what the network hears of them, and what they cost where they are not met."""

from dataclasses import asdict, replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.diffusion import denoiser, losses, masks
from motionlab.diffusion.denoiser import Denoiser
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.losses import LossWeights
from motionlab.diffusion.model import DenoiserRecipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.heading import stuck_root
from motionlab.skeleton import STANDARD
from studies.nb14_completion import trials

TINY = {"size": 32, "layers": 1, "heads": 2, "hidden": 32}
POSES = DenoiserRecipe(
    size="tiny", frames=1, contacts=False, spectral=True, handles=16, dropout=0.0, noising=100, steps=6, batch=8,
    warm_up=2, weights=LossWeights(fk=0.05, velocity=0.0, handles=20.0, late=0.1), seed=5,
)  # fmt: skip
LAYOUT = POSES.layout


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setitem(denoiser.SIZES, "tiny", TINY)


@pytest.fixture(scope="module")
def poses():
    """All poses of eight clips, one frame a window."""
    clips = scenes.held_out(8)
    return gather([on_standard(replace(clips.clip(i), contacts=None)) for i in range(8)], 1)


# ------------------------------------------------------------------------------------------------- which and where
def test_drawn_handles_are_where_the_joints_are(poses, generator):
    motion = poses.draw(500, generator)
    held = masks.draw_handles(motion, generator)
    assert held.shape == (500, 1, 22, 4)
    which, joints = held[..., 3] > 0, stuck_root(motion)[0].positions
    assert (held[..., :3] - joints)[which].abs().max() < 1e-6
    assert (held[..., :3][~which] == 0).all() and set(held[..., 3].unique().tolist()) == {0.0, 1.0}
    assert held[..., 0, :2].abs().max() < 1e-6  # the pelvis is above the origin


def test_drawn_handles_do_not_know_place_and_heading(poses, generator):
    motion = poses.draw(50, generator)
    turn, start = rotation.rotation_about("z", torch.tensor(2.0)), generator.get_state()
    moved = replace(
        motion,
        root=(motion.root @ turn.mT) + torch.tensor([3.0, -2.0, 0.0]),
        rot=torch.cat((turn @ motion.rot[..., :1, :, :], motion.rot[..., 1:, :, :]), -3),
    )
    one = masks.draw_handles(motion, generator)
    generator.set_state(start)
    assert (masks.draw_handles(moved, generator) - one).abs().max() < 1e-5


def test_targets_of_free_joints_are_never_read(generator):
    targets = torch.randn(3, 22, 3, generator=generator)
    which = trials.chosen_handles(4, 3, generator)
    other = torch.where(which[..., None], targets, torch.nan)
    assert torch.equal(masks.told(targets, which), masks.told(other, which))
    with pytest.raises(ShapeError, match="which"):
        masks.told(targets, which[:2])


# ----------------------------------------------------------------------------------------------------- the network
def test_the_network_hears_of_handles(generator):
    torch.manual_seed(0)
    network = Denoiser(7, **TINY, handles=8).eval()
    x, stamps = torch.randn(5, 3, 7, generator=generator), torch.arange(5)
    held = torch.randn(5, 3, 22, 4, generator=generator)
    free = network(x, stamps)
    assert torch.equal(free, network(x, stamps, handles=torch.zeros_like(held)))
    said = network(x, stamps, handles=held)
    assert said.shape == x.shape and (said - free).abs().max() > 1e-3
    with pytest.raises(ShapeError, match="hears of none"):
        Denoiser(7, **TINY)(x, stamps, handles=held)


def test_handles_go_with_known_areas_and_patches(generator):
    torch.manual_seed(0)
    network = Denoiser(7, **TINY, handles=8, told=True, patch=3).eval()
    x, mask = torch.randn(2, 6, 7, generator=generator), torch.zeros(6, 7)
    held = torch.zeros(2, 6, 22, 4)
    late = held.clone()
    late[:, 5, 0] = 1.0  # the last frame of the second token
    said = [network(x, torch.tensor([3, 4]), x, mask, handles=h) for h in (held, late)]
    assert said[0].shape == x.shape and not torch.allclose(*said)


def test_recipes_from_before_handles_can_be_read():
    content = asdict(POSES)
    assert DenoiserRecipe.read(content) == POSES
    del content["handles"], content["linear"], content["weights"]["handles"]
    before = DenoiserRecipe.read(content)
    assert before.handles == 0 and not before.linear and before.weights.handles == 0
    del content["patch"]
    with pytest.raises(ValueError, match="no patch"):
        DenoiserRecipe.read(content)


# -------------------------------------------------------------------------------------------------------- the loss
def test_the_loss_is_the_squared_way_of_handles(poses, generator):
    motion = poses.draw(6, generator)
    rows = LAYOUT.encode(motion)
    normaliser = Normaliser.measure(rows, LAYOUT)
    truth, held = normaliser.apply(rows), masks.draw_handles(motion, generator)
    wrong = truth + 0.2 * torch.randn(truth.shape, generator=generator)

    def loss(x, told=held):
        return losses.denoising_losses(
            x, truth, LAYOUT, normaliser, motion.skeleton.offsets[:, 0], parts=("handles",), handles=told
        )["handles"]

    assert loss(truth) < 1e-9
    joints = LAYOUT.decode(normaliser.undo(wrong), 30.0).positions
    by_hand = 0.0
    for b in range(6):
        for j in range(22):
            if held[b, 0, j, 3]:
                by_hand += (joints[b, 0, j] - held[b, 0, j, :3]).square().sum() / 6
    assert loss(wrong) == pytest.approx(by_hand.item(), rel=1e-4)
    assert loss(wrong, torch.zeros_like(held)) == 0
    head = torch.zeros_like(held)  # control: what no handle depends on costs nothing
    head[..., STANDARD.index("head"), :3], head[..., STANDARD.index("head"), 3] = joints[..., 15, :].detach(), 1.0
    bent = wrong.clone()
    bent[..., LAYOUT.mask(1, joints=["left_knee"])[0]] += 0.5
    assert loss(bent, head) < 1e-9
