"""Handles: which are drawn, what the network hears of them, and what they cost where they are not met."""

from dataclasses import asdict, replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation, train_diffusion
from motionlab.diffusion import denoiser, handles, losses, training
from motionlab.diffusion.denoiser import Denoiser
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.losses import Weights
from motionlab.diffusion.trained import Recipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.frames import stuck_root
from motionlab.skeleton import STANDARD

TINY = {"size": 32, "layers": 1, "heads": 2, "hidden": 32}
POSES = Recipe(
    size="tiny", frames=1, contacts=False, spectral=True, handles=16, dropout=0.0, noising=100, steps=6, batch=8,
    warm_up=2, weights=Weights(fk=0.05, velocity=0.0, handles=20.0, late=0.1), seed=5,
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
    held = handles.draw(motion, generator)
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
    one = handles.draw(motion, generator)
    generator.set_state(start)
    assert (handles.draw(moved, generator) - one).abs().max() < 1e-5


def test_how_many_and_which_are_drawn(poses, generator):
    which = handles.draw(poses.draw(6000, generator), generator)[:, 0, :, 3] > 0
    number = which.sum(-1)
    assert number.max() == handles.MOST
    assert (number == 0).float().mean() == pytest.approx(handles.NONE, abs=0.02)
    assert [(number == n).float().mean().item() for n in (1, 4, 8)] == pytest.approx([0.9 / 8] * 3, abs=0.02)
    usual = torch.zeros(22, dtype=torch.bool)
    usual[STANDARD.indices(list(handles.EFFECTORS))] = True
    only = ~(which & ~usual).any(-1) & (number == handles.MOST)  # by chance never, of eight among all
    assert only.float().sum() / (number == handles.MOST).sum() == pytest.approx(0.5, abs=0.06)
    assert (which.float().mean(0) > 0.05).all()  # every joint has its turn


def test_handles_of_longer_windows_stay_the_same(generator):
    motion = scenes.held_out(3).cut(0, 5)
    held = handles.draw(replace(motion, skeleton=STANDARD), generator)
    assert held.shape == (3, 5, 22, 4) and (held[..., 3] == held[:, :1, :, 3]).all()


def test_chosen_handles(generator):
    which = handles.chosen(("head", "left_wrist"), 4, generator)
    assert which.sum() == 8 and which[:, STANDARD.index("head")].all()
    some = handles.chosen(3, 400, generator)
    assert (some.sum(-1) == 3).all() and len(some.unique(dim=0)) > 200
    assert all(handles.chosen(s, 2, generator).any() for s in handles.SETS.values())
    with pytest.raises(KeyError, match="tail"):
        handles.chosen(("tail",), 1, generator)
    with pytest.raises(ValueError, match="0 to 22"):
        handles.chosen(23, 1, generator)


def test_targets_of_free_joints_are_never_read(generator):
    targets = torch.randn(3, 22, 3, generator=generator)
    which = handles.chosen(4, 3, generator)
    other = torch.where(which[..., None], targets, torch.nan)
    assert torch.equal(handles.told(targets, which), handles.told(other, which))
    with pytest.raises(ShapeError, match="which"):
        handles.told(targets, which[:2])


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
    assert Recipe.read(content) == POSES
    del content["handles"], content["linear"], content["weights"]["handles"]
    before = Recipe.read(content)
    assert before.handles == 0 and not before.linear and before.weights.handles == 0
    del content["patch"]
    with pytest.raises(ValueError, match="no patch"):
        Recipe.read(content)


# -------------------------------------------------------------------------------------------------------- the loss
def test_the_loss_is_the_squared_way_of_handles(poses, generator):
    motion = poses.draw(6, generator)
    rows = LAYOUT.encode(motion)
    normaliser = Normaliser.measure(rows, LAYOUT)
    truth, held = normaliser.apply(rows), handles.draw(motion, generator)
    wrong = truth + 0.2 * torch.randn(truth.shape, generator=generator)

    def loss(x, told=held):
        return losses.compare(
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


# ---------------------------------------------------------------------------------------------------- the training
def test_a_stopped_run_with_handles_goes_on_to_the_bit(poses, tmp_path):
    whole = training.Training(POSES, poses).run()
    training.Training(POSES, poses).run(until=4, keep=tmp_path / "run.pt")
    again = training.resume(tmp_path / "run.pt", poses).run()
    assert all(torch.equal(again.average[name], value) for name, value in whole.average.items())
    assert whole.curve[-1]["handles"] > 0


def test_the_arms_differ_in_one_thing():
    arms = train_diffusion.ARMS
    whole, silent, deaf = (arms[f"handles{name}"] for name in ("", "_no_loss", "_no_embedding"))
    assert whole.handles and whole.weights.handles
    assert replace(silent, weights=replace(silent.weights, handles=whole.weights.handles)) == whole
    assert replace(deaf, handles=whole.handles) == whole
    thesis = replace(arms["handles_thesis"], linear=True, recalls=whole.recalls)  # a start goes with what it recalls
    assert thesis == whole and whole.linear
    assert silent.weights.handles == 0 and deaf.handles == 0
    assert train_diffusion.PRESETS["pose"].layout == train_diffusion.PRESETS["handles"].layout == Layout(contacts=False)
