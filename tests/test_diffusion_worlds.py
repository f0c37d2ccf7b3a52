"""Measures that tell root and body apart, on motion whose answer is known."""

from dataclasses import replace
from itertools import product

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion import worlds
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.schedule import cosine
from motionlab.diffusion.trained import Recipe, Trained
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.frames import fix_root_horizontally, stuck_root
from motionlab.skeleton import STANDARD

LAYOUTS = [Layout(f, v, c) for f, v, c in product(("stuck", "world"), (False, True), (False, True))]


@pytest.fixture(scope="module")
def clips():
    """Windows (40, 40) of one walking, stopping and turning person."""
    motion = on_standard(perform_sequence(Corpus(seconds=40.0, seed=3), 0).motion)
    return replace(gather([motion], 40).evenly(40), skeleton=STANDARD)


def made_of(layout, motion, answer):
    """A model whose guess of x_0 is ``answer(x_t)``."""
    network = torch.nn.Module()
    network.forward = lambda x, stamps: answer(x)
    rows = layout.encode(motion)
    return Trained(network, cosine(100), layout, Normaliser.measure(rows, layout), Recipe(frame=layout.frame))


# ------------------------------------------------------------------------------------------ place and heading
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda x: f"{x.frame}-{x.velocities}-{x.contacts}")
def test_rows_lead_back_to_the_windows(clips, layout):
    normaliser = Normaliser.measure(layout.encode(clips), layout)
    assert worlds.round_trip(layout, normaliser, clips).max() < 1e-5


def test_a_move_can_be_undone_and_keeps_heights_and_shape(clips, generator):
    move = worlds.somewhere(len(clips.root), 10.0, generator)
    there = worlds.moved(clips, move)
    assert torch.allclose(there.root[..., 2], clips.root[..., 2], atol=1e-5)
    assert torch.allclose(
        there.positions.diff(dim=-2).norm(dim=-1), clips.positions.diff(dim=-2).norm(dim=-1), atol=1e-5
    )
    assert (there.root - clips.root).norm(dim=-1).amin() > 0.01
    assert worlds.differs(worlds.moved_back(there, move), clips).max() < 1e-5
    assert worlds.differs(there, clips).min() > 0.01


def test_stuck_rows_do_not_know_the_place_and_world_rows_do(clips, generator):
    clips = clips.to(torch.float64)
    there = worlds.moved(clips, worlds.somewhere(len(clips.root), 10.0, generator))
    change = [(Layout(frame).encode(there) - Layout(frame).encode(clips)).abs().amax() for frame in ("stuck", "world")]
    assert change[0] < 1e-10 and change[1] > 1.0


def test_a_shift_has_the_length_asked_for(clips, generator):
    there = worlds.moved(clips, worlds.away(len(clips.root), 3.0, generator))
    assert torch.allclose((there.root - clips.root).norm(dim=-1), torch.tensor(3.0), atol=1e-4)
    assert torch.equal(there.rot[:, :, 1:], clips.rot[:, :, 1:])


def test_windows_begin_where_others_do(clips, generator):
    others = clips.clip(slice(0, 1))
    there = worlds.moved(clips, worlds.as_others(clips, others, generator))
    assert torch.allclose(there.root[:, 0, :2], others.root[:, 0, :2].expand(40, 2), atol=1e-5)
    local, frame = stuck_root(there)
    assert torch.allclose(frame.turn, stuck_root(others)[1].turn.expand_as(frame.turn), atol=1e-5)
    assert worlds.differs(local, stuck_root(clips)[0]).max() < 1e-5


# -------------------------------------------------------------------------------------------- root and body together
def test_real_roots_go_where_the_legs_push_them_and_shuffled_ones_do_not(clips, generator):
    other = worlds.shuffled(clips, generator)
    true, false = worlds.driven(clips), worlds.driven(other)
    assert true.nanmean() > 0.9 > 0.5 > false.nanmean()
    assert worlds.correlated(clips, 20).min() > 0.8
    found = {name: worlds.belongs(m) for name, m in (("true", clips), ("false", other))}
    assert found["true"]["skate"].mean() < found["false"]["skate"].mean()
    assert found["true"]["slide"].nanmean() < found["false"]["slide"].nanmean() / 4


def test_shuffling_takes_the_way_of_another_and_no_more(clips, generator):
    other = worlds.shuffled(clips, generator)
    assert torch.allclose(other.root[:, 0], clips.root[:, 0], atol=1e-5)
    assert torch.allclose(other.root[..., 2], clips.root[..., 2], atol=1e-6)
    assert torch.allclose(other.rot, clips.rot, atol=1e-5)
    way, mine = (stuck_root(m)[0].root[:, -1, :2] for m in (other, clips))
    assert torch.allclose(way.sort(0).values, mine.sort(0).values, atol=1e-4)  # the same ways, each somebody else's


def test_who_stands_still_has_no_cosine(clips):
    assert worlds.driven(fix_root_horizontally(clips)).isnan().all()


def test_backwards_is_minus_one(clips):
    still = worlds.driven(clips)
    back = replace(clips, root=clips.root * torch.tensor([-1.0, -1.0, 1.0]))
    assert torch.allclose(worlds.driven(back)[still > 0], -still[still > 0], atol=1e-4)


def test_correlation_is_pearsons(generator):
    a, b = torch.randn(2, 3, 50, generator=generator).double()
    expected = [torch.corrcoef(torch.stack(pair))[0, 1] for pair in zip(a, b, strict=True)]
    assert torch.allclose(worlds.correlation(a, b), torch.stack(expected))


def test_too_few_clips_have_no_correlation(clips):
    with pytest.raises(ShapeError, match="64 clips"):
        worlds.correlated(clips, 64)


# --------------------------------------------------------------------------------------------- size of the space
def test_the_spread_counts_directions(generator):
    basis = torch.linalg.qr(torch.randn(60, 5, generator=generator))[0]
    rows = (torch.randn(400, 5, generator=generator) @ basis.mT).unflatten(1, (10, 6))
    found = worlds.spread(rows)
    assert found.needed == 5
    assert found.effective == pytest.approx(5, abs=0.3)
    assert found.shares.sum() == pytest.approx(1)


def test_place_lies_between_windows(generator):
    rows = torch.randn(200, 1, 3, generator=generator).expand(200, 20, 3)
    assert worlds.between(rows, slice(0, 3)) == pytest.approx(1)
    assert worlds.between(torch.randn(200, 50, 3, generator=generator), slice(0, 3)) < 0.05


def test_distances_of_rows_know_the_place_only_in_the_world(clips, generator):
    there = worlds.moved(clips, worlds.somewhere(len(clips.root), 10.0, generator))
    change = {f: (worlds.as_rows(there, f) - worlds.as_rows(clips, f)).abs().max() for f in ("stuck", "world")}
    assert change["stuck"] < 1e-4 and change["world"] > 1.0


# ------------------------------------------------------------------------------------------------------- one guess
@pytest.mark.parametrize("frame", ["stuck", "world"])
def test_a_guess_is_given_where_the_windows_are(clips, generator, frame):
    model = made_of(Layout(frame), clips, lambda x: x)
    quiet = torch.zeros_like(worlds.noise_for(model, clips, generator))
    assert (
        worlds.apart(worlds.guess(model, clips, 0.0, quiet), clips).max() < 0.02
    )  # x_t is x_0 but for the signal's share
    noise = worlds.noise_for(model, clips, generator)
    assert worlds.apart(worlds.guess(model, clips, 0.9, noise), clips).min() > 0.1


def test_noise_turns_with_the_window(clips, generator):
    """x_t of a moved window is the moved x_t, but for the columns' means, which both lose here."""
    layout = Layout("world")
    model = made_of(layout, clips, lambda x: x)
    model = replace(model, normaliser=Normaliser(torch.zeros_like(model.normaliser.mean), model.normaliser.scale))
    noise = worlds.noise_for(model, clips, generator)
    move = worlds.away(len(clips.root), 0.0, generator)  # no shift, so that fading to the origin is the same
    move = replace(worlds.somewhere(len(clips.root), 0.0, generator), shift=move.shift)
    here = worlds.guess(model, clips, 0.3, noise)
    there = worlds.guess(model, worlds.moved(clips, move), 0.3, worlds.turned_noise(noise, move, layout))
    assert worlds.apart(worlds.moved_back(there, move), here).max() < 1e-4
    unturned = worlds.guess(model, worlds.moved(clips, move), 0.3, noise)
    assert worlds.apart(worlds.moved_back(unturned, move), here).mean() > 0.01


def test_noise_of_velocities_is_refused(clips, generator):
    move = worlds.somewhere(1, 1.0, generator)
    with pytest.raises(ShapeError, match="without velocities"):
        worlds.turned_noise(torch.zeros(1, 2, 3), move, Layout(velocities=True))


def test_root_and_body_errors_are_told_apart(clips):
    shifted = replace(clips, root=clips.root + torch.linspace(0, 1, 40)[:, None] * torch.tensor([1.0, 0.0, 0.0]))
    path, body = worlds.errors(shifted, clips)
    assert torch.allclose(path, torch.tensor(0.5), atol=1e-4) and body.max() < 1e-5
    path, body = worlds.errors(replace(clips, rot=clips.rot.roll(1, 0)), clips)
    assert path.max() == 0 and body.min() > 0.001


def test_pairs_leave_out_what_is_no_number():
    assert worlds.both(torch.tensor([3.0, torch.nan, 1.0]), torch.tensor([1.0, 1.0, torch.nan])).tolist() == [2.0]
