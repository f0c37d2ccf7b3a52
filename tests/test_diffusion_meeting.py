"""The same clips for both chapters: who sees what, who takes how long."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion import cases, meeting
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.repair import Way
from motionlab.diffusion.rivals import Rivals
from motionlab.diffusion.trained import Recipe, Trained
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError
from motionlab.humor.testops import Schedule
from motionlab.skeleton import STANDARD

QUICK = Schedule(steps=(1, 2, 1), inner=4, refine=(1, 1))
UPPER = [j for j, name in enumerate(STANDARD.names) if name not in cases.HIDDEN]


@pytest.fixture(scope="module")
def windows():
    motion = on_standard(perform_sequence(Corpus(seconds=20.0, seed=3), 0).motion)
    return replace(gather([motion], 24).evenly(60), skeleton=STANDARD)


@pytest.fixture(scope="module")
def clips(windows):
    return windows.clip(slice(10, 12))


@pytest.fixture(scope="module")
def fitted(clips, kit):
    seen = meeting.above_the_knees(clips, 0.01, torch.Generator().manual_seed(0))
    return meeting.optimised(seen, kit, QUICK)


@pytest.fixture
def model(windows):
    """A model that says zero, the mean, whatever it is shown."""
    recipe = Recipe(frames=24, noising=20)
    network = torch.nn.Module()
    network.forward = lambda x, stamps: 0 * x
    rows = recipe.layout.encode(windows)
    return Trained(network, recipe.schedule, recipe.layout, Normaliser.measure(rows, recipe.layout), recipe)


def test_nothing_of_the_legs_is_seen(clips, generator):
    seen = meeting.above_the_knees(clips, 0.01, generator)
    hidden = STANDARD.indices(cases.LOWER)
    assert not seen.visible[..., hidden].any() and (seen.points[..., hidden, :] == 0).all()
    rest = [j for j in range(22) if j not in hidden]
    assert seen.visible[..., rest].all()
    off = seen.points[..., rest, :] - clips.positions[..., rest, :]
    assert off.std() == pytest.approx(0.01, rel=0.1)


def test_the_fit_reports_both_stages_and_their_time(fitted, clips):
    assert set(fitted.stages) == {2, 3}
    assert fitted.before > 0 and fitted.after > 0
    assert fitted.left.shape == (2,) and (fitted.left >= 0).all() and (fitted.left <= 1).all()
    near = fitted.stages[2].positions[..., UPPER, :] - clips.positions[..., UPPER, :]
    assert near.norm(dim=-1).mean() < 0.2


def test_without_stage_3_there_is_nothing_to_compare(clips, kit, generator):
    seen = meeting.above_the_knees(clips, 0.0, generator)
    with pytest.raises(DataError, match="no stage 3"):
        meeting.optimised(seen, kit, replace(QUICK, steps=(1, 1, 0)))


def test_what_is_left_is_the_share_of_the_last_tenth():
    history = torch.tensor([[10.0, 10.0], [4.0, 10.0], [4.5, 5.0], [2.0, torch.nan]])
    fit = SimpleNamespace(results={3: [None, SimpleNamespace(history=history)]})
    assert meeting._left(fit).tolist() == pytest.approx([2 / 8, 0.0])


def test_every_method_keeps_the_upper_body_and_makes_its_own_legs(fitted, model, windows, generator):
    rivals = Rivals.fit(windows, generator, parts=16)
    methods = {
        "diffusion": meeting.by_diffusion(model, Way(steps=4), generator),
        "regression": meeting.by_rival(rivals, "regression"),
        "nearest": meeting.by_rival(rivals, "nearest"),
    }
    met = meeting.meet(fitted, methods)
    start = fitted.stages[2]
    for name in methods:
        made = met.motions[name]
        assert made.skeleton is STANDARD or torch.equal(made.skeleton.offsets, STANDARD.offsets)
        assert torch.allclose(made.root, start.root, atol=1e-4)
        assert torch.allclose(made.rot[..., UPPER, :, :], start.rot[..., UPPER, :, :], atol=1e-4)
        hidden = STANDARD.indices(cases.HIDDEN)
        assert (made.rot[..., hidden, :, :] - start.rot[..., hidden, :, :]).abs().max() > 1e-3
        assert met.seconds[name] > 0
    assert met.seconds["stage 3"] == pytest.approx(fitted.after / 2)
    assert met.motions["stage 3"] is fitted.stages[3]


def test_noise_wants_a_filter_and_clean_joints_none(clips, kit, generator):
    schedule = Schedule(steps=(2, 4, 0), inner=10)
    chosen = {}
    for noise in (0.0, 0.05):
        seen = meeting.above_the_knees(clips, noise, generator)
        chosen[noise] = meeting.best_window(clips, seen, kit, schedule, windows=(0, 5, 9))
    assert chosen[0.05] > chosen[0.0] - 1 and chosen[0.05] > 0


def test_methods_begin_with_the_filtered_estimate(fitted):
    met = meeting.meet(fitted, {"as given": lambda start: start}, window=5)
    given, rough = met.motions["as given"], meeting.known_above(fitted.stages[2])
    assert torch.equal(given.rot, met.motions["stage 2, filtered"].rot)
    jerk = [m.root.diff(n=3, dim=1).norm(dim=-1).mean() for m in (given, rough)]
    assert jerk[0] < jerk[1]


def test_nobody_reads_the_legs_of_the_estimate(fitted, model, windows, generator):
    """Other legs in stage 2's estimate, the same result."""
    rivals = Rivals.fit(windows, generator, parts=16)
    start = meeting.known_above(fitted.stages[2])
    rot = start.rot.clone()
    rot[..., STANDARD.indices(cases.HIDDEN), :, :] = torch.eye(3)
    other = replace(start, rot=rot)
    for make in (
        lambda: meeting.by_diffusion(model, Way(steps=4), torch.Generator().manual_seed(1)),
        lambda: meeting.by_rival(rivals, "regression"),
        lambda: meeting.by_rival(rivals, "nearest"),
    ):
        assert torch.allclose(make()(start).positions, make()(other).positions, atol=1e-5)


def test_a_stage_3_after_diffusion_sees_its_legs(clips, generator):
    seen = meeting.above_the_knees(clips, 0.01, generator)
    more = meeting.with_legs(seen, clips)
    assert more.visible.all()
    hidden = STANDARD.indices(cases.LOWER)
    assert torch.equal(more.points[..., hidden, :], clips.positions[..., hidden, :])
    assert torch.equal(more.points[..., :1, :], seen.points[..., :1, :])
