"""The completer: its state against naive loops, what it may not read, what stays, that it learns, and its bench."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from motionlab import bench, checkpoint, rotation
from motionlab.baselines import Noise, denoised, smooth_curves
from motionlab.bench import PersonWindows
from motionlab.contact import with_contacts
from motionlab.diffusion import completer, features
from motionlab.diffusion.completer import Completer, CompleterRecipe
from motionlab.diffusion.windows import draw_units, gather, on_standard
from motionlab.errors import DataError, ShapeError
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from motionlab.training import completer_training, courses
from motionlab.training.completer_training import CompleterTraining, losses
from motionlab.training.courses import CompleterCourse

FRAMES = 12
TINY = CompleterRecipe(frames=FRAMES, size=64, layers=1, batch=8, steps=60, warm_up=5, lr=3e-3)


@pytest.fixture(scope="module", autouse=True)
def few_windows_measured():
    """Every model of these tests measures its numbers on windows first: of two thousand, that took a second each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(completer_training, "_MEASURED", 200)
        yield


@pytest.fixture(scope="module")
def data(motions):
    return gather([on_standard(m) for m in motions], FRAMES, people=[str(k % 2) for k in range(len(motions))])


@pytest.fixture(scope="module")
def windows(data):
    return replace(data.draw(6, torch.Generator().manual_seed(0)), skeleton=STANDARD)


@pytest.fixture(scope="module")
def known():
    kinds = {"gap": 1.0, "legs": 1.0, "joints": 1.0, "entries": 1.0}
    return draw_units(FRAMES, 6, torch.Generator().manual_seed(3), kinds)


@pytest.fixture(scope="module")
def model(data):
    run = CompleterTraining(TINY, data)
    for _ in range(5):
        run.advance()
    return run.averaged


def hidden_changed(motion: Motion, known: torch.Tensor) -> Motion:
    """Other numbers wherever nothing is known; the first frame's root gives the frame of reference and stays."""
    free = ~known
    free[:, 0, [0, -2]] = False
    return replace(
        motion,
        root=torch.where(free[..., -2:-1], motion.root + 5.0, motion.root),
        rot=torch.where(free[..., :-2, None, None], torch.eye(3), motion.rot),
        contacts=torch.where(free[..., -1:], 1 - motion.contacts, motion.contacts),
    )


# ------------------------------------------------------------------------------------------------------ state
def test_the_state_is_what_a_loop_over_frames_gives(windows):
    motion = windows.clip(0)
    found, p = features.states(motion).numpy(), motion.positions.numpy()
    parts = np.split(found, np.cumsum(list(features._SIZES.values()))[:-1], axis=-1)
    before = None
    for t in range(FRAMES):
        right = -motion.rot[t, 0, :2, 0].numpy()
        c, s = right / np.linalg.norm(right)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        at = p[t] - [p[t, 0, 0], p[t, 0, 1], 0]
        np.testing.assert_allclose(parts[2][t].reshape(-1, 3), at @ turn.T, atol=1e-5)
        if t:
            moved = (p[t] - p[t - 1]) * motion.fps
            np.testing.assert_allclose(parts[3][t].reshape(-1, 3), moved @ turn.T, atol=1e-3)
            np.testing.assert_allclose(parts[4][t], moved[0] @ turn.T, atol=1e-3)
            off = before @ turn.T
            np.testing.assert_allclose(parts[5][t], np.arctan2(off[1, 0], off[0, 0]) * motion.fps, atol=1e-3)
        before = turn


def test_numbers_go_there_and_back_and_belong_to_the_units_of_the_masks(windows):
    back = features.motion_of(features.made(windows), windows)
    assert (back.positions - windows.positions).abs().max() < 1e-5
    assert torch.equal(back.contacts, windows.contacts)
    with pytest.raises(DataError, match="contacts"):
        features.states(replace(windows, contacts=None))


def test_open_places_are_those_that_an_unknown_part_moves(windows):
    motion = windows.clip(slice(0, 1))
    for unit in range(features.UNITS - 1):
        known = torch.ones(1, FRAMES, features.UNITS, dtype=torch.bool)
        known[..., unit] = False
        rot, root = motion.rot.clone(), motion.root.clone()
        if unit < len(STANDARD):
            rot[:, :, unit] = rot[:, :, unit] @ rotation.exp(torch.tensor([0.3, 0.2, 0.4]))
        else:
            root = root + 0.1
        moved = (replace(motion, rot=rot, root=root).positions - motion.positions).norm(dim=-1) > 1e-5
        assert torch.equal(moved, features.open_places(known)), unit


# --------------------------------------------------------------------------------------------------- completer
def test_curves_are_smooth_curves_through_what_is_known(windows, known):
    mean, scale = torch.randn(2, features.MADE, generator=torch.Generator().manual_seed(1)).abs() + 0.5
    columns, numbers = known[..., features.OWNERS], (features.made(windows) - mean) / scale
    plain = torch.where(columns, numbers, smooth_curves(numbers, columns, torch.arange(features.MADE))) * scale + mean
    plain = features.made(features.motion_of(plain, windows))
    assert (completer.guess(windows, known, mean, scale) - plain).abs().max() < 1e-4


def test_what_is_hidden_is_never_read(model, windows, known):
    """And what is known is: a planted change of it comes through."""
    made = model.complete(windows, known)
    other = model.complete(hidden_changed(windows, known), known)
    assert torch.equal(made.rot, other.rot) and torch.equal(made.root, other.root)
    leak = replace(windows, root=windows.root + torch.tensor([0.0, 0.0, 0.05]) * known[..., -2:-1])
    assert (model.complete(leak, known).root - made.root).abs().max() > 1e-3


def test_a_motion_without_contacts_is_completed_too(model, windows, known):
    silent = torch.cat((known[..., :-1], torch.zeros_like(known[..., -1:])), -1)
    bare = model.complete(replace(windows, contacts=None), known)
    assert torch.equal(bare.rot, model.complete(windows, silent).rot)


def test_what_is_known_stays_to_the_bit_and_the_room_does_not_matter(model, windows, known):
    made = model.complete(windows, known)
    assert torch.equal(made.rot[known[..., :-2]], windows.rot[known[..., :-2]])
    assert torch.equal(made.root[known[..., -2]], windows.root[known[..., -2]])
    turn, shift = rotation.rotation_about("z", torch.tensor(1.0)), torch.tensor([2.0, 1.0, 0.0])
    rot = torch.cat((turn @ windows.rot[..., :1, :, :], windows.rot[..., 1:, :, :]), -3)
    other = model.complete(replace(windows, root=windows.root @ turn.mT + shift, rot=rot), known)
    assert (other.positions - (made.positions @ turn.mT + shift)).abs().max() < 1e-3


def test_wrong_windows_are_refused(model, windows, known):
    with pytest.raises(ShapeError, match="12 frames"):
        model.complete(windows.cut(0, 8), known[:, :8])


def test_it_learns_what_curves_do_not_know(data):
    """Two clips by heart: hidden legs come nearer than half of the mean pose, from which it begins."""
    mine = replace(data, begins=data.begins[[80, 250]], mirrored=False, people=None)
    run = CompleterTraining(replace(TINY, steps=150, kinds=(("legs", 1.0),), average=0.9), mine)
    some = replace(mine.evenly(2), skeleton=STANDARD)
    known = bench.legs(2, FRAMES)
    error = lambda: bench.error_cm(run.averaged.complete(some, known), some, known).mean()  # noqa: E731
    first = error()
    assert first > 2.0
    run.run()
    assert error() < 0.5 * first


def test_nothing_is_learnt_of_joints_that_were_not_recorded(windows):
    """Their rotations are made up: the loss does not see them. Of the joints above them it sees the places."""
    known = torch.zeros(6, FRAMES, features.UNITS, dtype=torch.bool)
    seen = torch.ones(6, features.UNITS, dtype=torch.bool)
    wrist = STANDARD.index("left_wrist")
    seen[:, [STANDARD.index("left_elbow"), wrist]] = False
    rot = windows.rot.clone()
    rot[:, :, [STANDARD.index("left_elbow"), wrist]] = torch.eye(3)
    other, scale = replace(windows, rot=rot), torch.ones(features.MADE)
    parts = losses(other, windows, known, seen, scale)
    assert max(float(parts[name]) for name in ("places", "moves", "rotations")) < 2e-3
    rot[:, :, STANDARD.index("left_shoulder")] = torch.eye(3)
    assert losses(replace(windows, rot=rot), windows, known, seen, scale)["places"] > 5e-3
    rot = other.rot
    parts = losses(other, windows, known, torch.ones_like(seen), scale)
    assert parts["places"] > 5e-3 and parts["rotations"] > 5e-3


def test_a_file_gives_the_model_back(model, windows, known, tmp_path):
    completer.save(tmp_path / "mine", model, {})
    again = completer.load(tmp_path / "mine")
    assert (again.complete(windows, known).positions - model.complete(windows, known).positions).abs().max() < 2e-3
    about = (tmp_path / "mine.json").read_text()
    (tmp_path / "mine.json").write_text(about.replace('"size": 64', '"size": 128'))
    with pytest.raises(DataError, match="completes no motions"):
        completer.load(tmp_path / "mine")


# ---------------------------------------------------------------------------------------------------- diffusion
def test_noise_is_a_turn_from_the_truth(data, windows, known):
    """At pi / 2 nothing of the hidden truth is seen; at smaller angles it is, which training needs."""
    run = CompleterTraining(replace(TINY, diffusion=True), data)
    for _ in range(5):
        run.advance()
    model, (local, _) = run.averaged, stuck_root(windows)
    other = hidden_changed(local, known)
    noise = completer.motion_noise(known, 30.0, torch.Generator().manual_seed(0))
    for angle, same in ((torch.pi / 2, True), (1.0, False)):
        at = torch.full((6,), angle)
        a, b = (model.filled(m, known, at, noise).rot for m in (local, other))
        assert torch.allclose(a, b, atol=1e-4) == same
    a, b = (model.complete(m, known, torch.Generator().manual_seed(1), steps=4) for m in (windows, other))
    assert torch.equal(a.rot[known[..., :-2]], windows.rot[known[..., :-2]])
    assert not torch.allclose(a.rot, model.complete(windows, known, torch.Generator().manual_seed(2), steps=4).rot)
    with pytest.raises(ValueError, match="by diffusion alone"):
        CompleterTraining(TINY, data).averaged.complete(windows, known, torch.Generator())


def test_noise_moves_as_motion_does():
    """It vanishes where a unit is known, and its amplitude falls with the square of the frequency; that of noise that
    is new in every frame does not."""
    known, fps = torch.zeros(400, 60, features.UNITS, dtype=torch.bool), 30.0
    free = completer.motion_noise(known, fps, torch.Generator().manual_seed(0))[..., 3:] / completer._LOUD
    known[:, :10], known[:, 50:] = True, True
    gap = completer.motion_noise(known, fps, torch.Generator().manual_seed(0))
    assert not gap[known[..., features.OWNERS]].any() and 0.3 < gap[:, 30, 3:].std() < 1.2
    white, wave = torch.randn(free.shape, generator=torch.Generator().manual_seed(1)), torch.arange(60.0)
    cosines = torch.cos(torch.pi / 60 * (wave + 0.5) * wave[:, None])
    four, eight, flat, flat_too = (((cosines[k] @ x).std()) for x in (free, white) for k in (16, 32))
    assert abs(free.square().mean() - 1) < 0.05 and 3.5 < four / eight < 4.5 and 0.8 < flat / flat_too < 1.2


def test_draws_of_an_exact_model_are_draws_of_the_gaussian(data, windows, monkeypatch):
    """With r ~ N(m, s^2) in every number the best estimate from x at angle a is known; DDIM then gives back mean and
    deviation. One that ignores x does not."""
    model, m, s = Completer(replace(TINY, diffusion=True)).eval(), 0.3, 0.7
    known = torch.zeros(6, FRAMES, features.UNITS, dtype=torch.bool)

    def exact(motion, begun, known, x, angle):
        a = angle[:, None, None]
        share = a.cos() * s**2 / (a.cos().square() * s**2 + (a.sin() * completer._LOUD).square())
        return m + share * (x - a.cos() * m)

    size = (6, FRAMES, features.MADE)
    monkeypatch.setattr(model, "_begun", lambda *_: (torch.zeros(size), torch.ones(size, dtype=torch.bool)))
    monkeypatch.setattr(completer, "motion_of", lambda numbers, like: numbers)
    monkeypatch.setattr(completer, "made", lambda numbers: numbers)
    found = []
    for estimate in (exact, lambda motion, begun, known, x, angle: torch.full_like(x, m)):
        monkeypatch.setattr(model, "_added", estimate)
        found.append(model._drawn(windows, known, torch.Generator().manual_seed(0), 400)[..., 3:])
    assert abs(float(found[0].mean()) - m) < 0.06 and abs(float(found[0].std()) - s) < 0.03  # few waves, 852 times
    assert float(found[1].std()) < 0.05


def test_how_long_a_models_six_numbers_are_does_not_matter(data, windows, known, monkeypatch):
    """Only their directions were ever asked of it: twice as long on the way, they draw the same."""
    model, (local, _) = CompleterTraining(replace(TINY, diffusion=True), data).averaged, stuck_root(windows)
    truth, scale = features.made(local), model.sizes[1]
    drawn = []
    for long, seed in ((1.0, 0), (2.0, 0), (1.0, 1)):
        six = torch.ones(features.MADE)
        six[3 : 3 + 6 * 22] = long

        def half_way(motion, begun, told, x, angle, six=six):
            return ((0.5 * truth + 0.5 * (begun + x * scale)) * six - begun) / scale

        monkeypatch.setattr(model, "_added", half_way)
        drawn.append(model._drawn(local, known, torch.Generator().manual_seed(seed), 8).positions)
    assert (drawn[0] - drawn[1]).abs().max() < 1e-3 < 1e-2 < (drawn[0] - drawn[2]).abs().max()


# -------------------------------------------------------------------------------------- of motion that was smoothed
def test_smoothed_windows_and_the_truth_are_shown_in_one_frame_of_reference(data, monkeypatch):
    """That of the smoothed first frame: the truth's own would tell how it differs."""
    run, seen = CompleterTraining(replace(TINY, refines=True), data), []
    draws = torch.Generator().set_state(run.generator.get_state())
    monkeypatch.setattr(
        run.model, "filled", lambda shown, known, tremble: seen.append((shown, known, tremble)) or shown
    )
    monkeypatch.setattr(completer_training, "losses", lambda made, truth, *_, **__: seen.append(truth) or {"places": 0})
    run._loss()
    (shown, known, trembled), truth = seen
    motion, (turn, shift) = data.drawn(TINY.batch, draws)[0], torch.rand(2, generator=draws).tolist()
    noise = Noise.of(8 * turn, 4 * shift)
    local, frame = stuck_root(denoised(noise.on(motion, draws), noise))
    assert trembled.tolist() == pytest.approx([noise.turn] * TINY.batch)
    assert not known.any() and torch.equal(shown.root, local.root) and torch.equal(shown.rot, local.rot)
    assert torch.equal(shown.contacts, with_contacts(shown).contacts)
    off = [(m.positions - motion.positions).abs().max() for m in (local_to_world(frame, m) for m in (truth, shown))]
    assert off[0] < 1e-5 < 1e-2 < off[1]
    assert (stuck_root(motion)[0].positions - truth.positions).abs().max() > 1e-3


def test_what_was_smoothed_stays_where_nothing_is_added(windows):
    """Where a completer that is not for that forgets it, as nothing of it is known."""
    nothing = torch.zeros(*windows.root.shape[:2], features.UNITS, dtype=torch.bool)
    for rough, least, most in ((True, 0.0, 1e-5), (False, 0.1, 10.0)):
        model, told = Completer(replace(TINY, refines=rough)), {"tremble": 0.02} if rough else {}
        made = model.complete(windows, nothing, **told)
        assert least <= (made.positions - windows.positions).abs().max() < most, rough
        with pytest.raises(ValueError, match="tremble"):
            model.complete(windows, nothing, **({} if rough else {"tremble": 0.02}))


# ------------------------------------------------------------------------------------------------------- bench
def test_windows_are_drawn_evenly_by_person(motions):
    long, short = motions[0], motions[1].cut(0, 16)
    data = gather([long, short], 12, people=["a", "b"])
    _, clips = data.drawn(2000, torch.Generator().manual_seed(0))
    assert abs(float((clips == 1).float().mean()) - 0.5) < 0.05
    _, clips = gather([long, short], 12).drawn(2000, torch.Generator().manual_seed(0))
    assert float((clips == 1).float().mean()) < 0.1


@pytest.fixture
def people(motions):
    whole = gather([on_standard(m) for m in motions], bench.FRAMES).evenly(4)
    motion = replace(whole, skeleton=STANDARD)
    return PersonWindows(motion, torch.tensor([0, 0, 1, 1]), torch.zeros(4, 1, features.UNITS, dtype=torch.bool))


def test_the_truth_is_judged_as_the_truth_and_nobody_else(people):
    case = bench.CASES["gap of 30 frames"]
    truth = bench.judged(lambda motion, known: people.motion, case, people)
    assert float(truth["cm"].max()) < 1e-4 and torch.allclose(truth["acceleration"], torch.ones(2).double())
    lifted = replace(people.motion, root=people.motion.root + torch.tensor([0.0, 0.0, 0.1]))
    off = bench.judged(lambda motion, known: lifted, case, people)
    assert torch.allclose(off["cm"], torch.full((2,), 10.0).double(), atol=1e-3)


def test_lone_keys_are_so_many_frames_apart_and_as_far_from_either_end():
    assert bench.keys(1, 60, 15)[0, :, 0].nonzero()[:, 0].tolist() == [7, 22, 37, 52]
    assert bench.keys(1, 31, 15)[0, :, 0].nonzero()[:, 0].tolist() == [0, 15, 30]
    assert bench.keys(2, 9, 4).all(-1).sum() == 2 * 3  # contacts, too


def test_the_energy_score_rewards_draws_about_the_truth(people):
    truth, known = people.motion, bench.gap(4, bench.FRAMES, 30)
    up, down = (replace(truth, root=truth.root + torch.tensor([0.0, 0.0, x])) for x in (0.1, -0.1))
    one = bench.energy_score([up], truth, known)
    assert torch.allclose(one, torch.full((4,), 10.0), atol=1e-3)
    assert bench.energy_score([up, down], truth, known).abs().max() < 1e-3  # mean error 10, mean distance 20
    assert torch.allclose(bench.energy_score([up, up], truth, known), one, atol=1e-3)


def test_who_corrects_what_was_smoothed_is_judged_beside_the_smoother(people, monkeypatch):
    """One that adds nothing leaves what the smoother leaves; the truth leaves nothing."""
    recipe = CompleterRecipe(size=64, layers=1, refines=True)
    course, model = CompleterCourse("completer_rough", recipe, None, (None, people)), Completer(recipe)
    silent = course.measured(model)
    monkeypatch.setattr(model, "complete", lambda motion, known, tremble: people.motion)
    exact, (first, *rest) = course.measured(model), list(silent)
    mine, alone = rest[::2], rest[1::2]
    assert first == "noise, cm" and all("smoother alone" in name for name in alone) and len(mine) == len(alone) == 3
    assert silent[first] == pytest.approx(sum(silent[name] for name in mine) / 3)
    for own, smoother in zip(mine, alone, strict=True):
        assert silent[own] == pytest.approx(silent[smoother], abs=1e-3) and silent[smoother] == exact[smoother] > 0.3
    assert silent[alone[0]] < silent[alone[1]] < silent[alone[2]] and max(exact[name] for name in (first, *mine)) < 1e-3
    with pytest.raises(DataError, match="not a completer_rough"):
        course.load(checkpoint.SHIPPED / "completer")


# ---------------------------------------------------------------------------------------------------- training
MINE = Path("mine")


def kept_in_cache() -> Path:
    return courses._kept("completer", MINE)


@pytest.fixture
def go_on(motions, people, here):
    """Trains one schedule of a recipe; the windows that it learns from."""
    data = gather([on_standard(m) for m in motions], bench.FRAMES, people=["a", *["b"] * (len(motions) - 1)])
    small = CompleterRecipe(size=64, layers=1, batch=4, steps=4, warm_up=1)

    def train(name="completer", more=True, **change):
        course = CompleterCourse(name, replace(small, **change), None, (data, people))
        return next(courses.go_on(course, MINE, more=more, every=2))

    return train, small, data


def test_training_writes_what_is_better_only(go_on):
    train, _, data = go_on
    train()
    content = MINE.with_suffix(".safetensors").read_bytes()
    for again in (True, False):  # goes on from what is there, or begins anew, and spoils it: the file stays
        kept_in_cache().unlink()
        train(more=again, lr=1e3)
        assert MINE.with_suffix(".safetensors").read_bytes() == content
    assert CompleterTraining.resume(kept_in_cache(), data).recipe.lr == 1e3
    with pytest.raises(DataError, match="not a completer_draws"):
        train("completer_draws", diffusion=True)
    with pytest.raises(DataError, match="--data"):
        courses.learnt_from(None, bench.FRAMES)


@pytest.mark.parametrize("rough", [False, True])
def test_training_that_was_killed_goes_on_as_if_it_had_not_been(go_on, monkeypatch, rough):
    """At step 3 of 4: the resumed run ends with the weights of one that nobody stopped."""
    train, small, data = go_on
    whole = CompleterTraining(replace(small, refines=rough), data)
    for _ in range(4):
        whole.advance()
    advance = CompleterTraining.advance

    def killed(run):
        if run.step == 3:
            raise KeyboardInterrupt
        return advance(run)

    monkeypatch.setattr(CompleterTraining, "advance", killed)
    with pytest.raises(KeyboardInterrupt):
        train(refines=rough)
    monkeypatch.setattr(CompleterTraining, "advance", advance)
    train(refines=rough)
    made = CompleterTraining.resume(kept_in_cache(), data)
    assert made.step == 4
    assert all(torch.equal(x, made.model.state_dict()[name]) for name, x in whole.model.state_dict().items())
