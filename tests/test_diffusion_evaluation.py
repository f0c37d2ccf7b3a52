"""The evaluation in one call: what it says of real, spoilt, copied and trivial motion; dances and their gaps."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import rotation
from motionlab.diffusion import dances, embedding, evaluation, inbetweening, trivial
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.repair import Way
from motionlab.diffusion.spectral import cosines
from motionlab.diffusion.trained import Recipe, Trained
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError, MissingData, ShapeError
from motionlab.io.anidance import NAMES
from motionlab.io.positions import Positions
from motionlab.metrics import lafan
from motionlab.metrics.memorisation import memorisation
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD
from motionlab.viz import generated as draw

FRAMES = 12


@pytest.fixture(scope="module")
def library():
    made = [perform_sequence(Corpus(seconds=8.0, seed=3), index).motion for index in (0, 1)]
    return [on_standard(m) for m in made]


@pytest.fixture(scope="module")
def data(library):
    return gather(library, FRAMES)


@pytest.fixture(scope="module")
def features(data):
    recipe = embedding.Recipe(frames=FRAMES, size=6, width=8, steps=40, batch=8, lr=5e-3)
    return embedding.train(data, recipe)[0]


@pytest.fixture(scope="module")
def real(data):
    return evaluation.grouped(data, 64)


@pytest.fixture(scope="module")
def model(data, real):
    """A denoiser that says nothing, with a real model's numbers."""

    class Silent(torch.nn.Module):
        told = False

        def __init__(self):
            super().__init__()
            self.nothing = torch.nn.Parameter(torch.zeros(()))

        def forward(self, x, stamps, known=None, mask=None):
            return 0 * x if known is None else known

    recipe = Recipe(frames=FRAMES, noising=20)
    layout = Layout()
    normaliser = Normaliser.measure(layout.encode(real[0]), layout)
    return Trained(Silent(), recipe.schedule, layout, normaliser, recipe)


# -------------------------------------------------------------------------------------------------------- scores
def test_a_set_against_itself_is_perfect(features, real, generator):
    row = evaluation.score(real[0], real[0], features, generator)
    assert set(evaluation.MEASURES) < set(row)
    assert row["frechet"] < 1e-6 and row["precision"] == row["recall"] == row["coverage"] == 1
    assert row["skate ratio"] == row["acceleration ratio"] == 1 and row["n"] == row["m"] == 64
    assert abs(row["diversity ratio"] - 1) < 1e-9


def test_faults_are_seen_and_a_mirror_is_none(features, data, generator):
    one, two = (replace(data.draw(128, generator), skeleton=STANDARD) for _ in range(2))
    judged = evaluation.judged(two, features)
    plain = evaluation.score(one, judged, features, generator)
    rows = {
        name: evaluation.score(m, judged, features, generator) for name, m in evaluation.spoilt(one, generator).items()
    }
    assert rows["mirrored"]["frechet"] < 3 * plain["frechet"]
    for fault in ("slid 20 cm/s", "trembling 2 degrees", "frozen", "legs of another"):
        assert rows[fault]["frechet"] > 1.5 * plain["frechet"], fault
    assert rows["trembling 2 degrees"]["acceleration ratio"] > 3 and rows["frozen"]["acceleration ratio"] == 0
    assert rows["legs of another"]["skate ratio"] > plain["skate ratio"]
    assert rows["frozen"]["recall"] < plain["recall"]


def test_spoilt_windows_are_what_they_say(real, generator):
    motion = real[0]
    found = evaluation.spoilt(motion, generator)
    drift = found["slid 20 cm/s"].root - motion.root
    assert (drift[:, -1].norm(dim=-1) - 0.2 * (FRAMES - 1) / 30).abs().max() < 1e-5 and drift[..., 2].abs().max() == 0
    turned = rotation.geodesic(found["trembling 2 degrees"].rot, motion.rot).square().mean().sqrt()
    assert abs(torch.rad2deg(turned) - 2 * 3**0.5) < 0.1  # two degrees about each of three axes
    assert torch.equal(found["frozen"].rot[:, 0], motion.rot[:, 0])
    assert torch.equal(found["backwards"].root[:, 0], motion.root[:, -1])
    assert torch.equal(found["legs of another"].rot[0, :, 16], motion.rot[0, :, 16])
    assert torch.equal(found["legs of another"].rot[1, :, 1], motion.rot[0, :, 1])


def test_every_fault_is_told_in_floors(features, data, generator):
    found = evaluation.seen(replace(data.draw(256, generator), skeleton=STANDARD), features, generator, draws=3)
    assert all(len(values) == 3 for values in found.values()) and (found["as they are"] > 0).all()
    assert found["slid 20 cm/s"].min() > 1.5 and found["trembling 2 degrees"].min() > 3
    assert found["mirrored"].max() < 3


def test_spread_shrinks_with_the_sets_and_knows_its_least(features, data, generator):
    def error(count):
        x, y = (evaluation.judged(data.draw(count, generator), features) for _ in range(2))
        return evaluation.spread(x, y, features, generator, draws=30)

    few, many = error(32), error(512)
    assert set(few) == set(evaluation.MEASURES)
    assert many["acceleration ratio"] < 0.6 * few["acceleration ratio"] and many["frechet"] < few["frechet"]
    x = evaluation.judged(data.draw(8, generator), features)
    with pytest.raises(ShapeError, match="16 windows"):
        evaluation.spread(x, x, features, generator)


def test_spread_is_about_the_deviation_of_fresh_sets(features, data, generator):
    real = evaluation.judged(data.draw(2000, generator), features)
    rows, told = [], []
    for _ in range(12):
        made = evaluation.judged(data.draw(64, generator), features)
        rows.append(evaluation.score(made, real, features, generator)["acceleration ratio"])
        told.append(evaluation.spread(made, real, features, generator)["acceleration ratio"])
    true, said = torch.tensor(rows).std(), torch.tensor(told).mean()
    assert 0.5 < said / true < 2


def test_a_trial_draws_with_every_generator_and_scores_against_every_set(features, data, model):
    def seeds():
        return [torch.Generator().manual_seed(k) for k in range(3)]

    real = {name: evaluation.judged(data.draw(40, torch.Generator().manual_seed(9)), features) for name in ("a", "b")}
    found = evaluation.trial(trivial.copying(data), 32, seeds(), real, features, draws=3)
    assert {k: len(v) for k, v in found.rows.items()} == {"a": 3, "b": 3} and set(found.errors) == {"a", "b"}
    assert len({row["frechet"] for row in found.rows["a"]}) == 3  # three different draws
    again = evaluation.trial(trivial.copying(data), 32, seeds(), real, features, draws=3)
    assert again.rows == found.rows and again.errors == found.errors
    torch.testing.assert_close(evaluation.judged(found.first, features).latent, found.sets[0].latent)
    made = evaluation.sampler(model, 4)(3, torch.Generator().manual_seed(0))
    assert made.root.shape == (3, FRAMES, 3) and made.root.isfinite().all()


def test_windows_that_are_not_finite_are_refused(features, real):
    root = real[0].root.clone()
    root[3, 2, 1] = torch.nan
    with pytest.raises(DataError, match="finite"):
        evaluation.judged(replace(real[0], root=root), features)


def test_rows_of_seeds_become_one(features, real, generator):
    row = evaluation.score(real[0], real[0], features, generator)
    both = [row, row | {"frechet": 2.0, "skate ratio": 3.0}]
    found = evaluation.together(both, [dict.fromkeys(evaluation.MEASURES, 0.25)])
    assert found["skate ratio"] == "2 ± 1 (0.2)" and found["n / m"] == "64 / 64" and found["seeds"] == 2
    assert [evaluation.rough(x) for x in (12.4, 0.0432, 4e-14, float("nan"))] == ["10", "0.04", "0", "-"]
    assert list(found)[: len(evaluation.MEASURES)] == list(evaluation.MEASURES)


def test_groups_are_the_motions_that_windows_come_from(library, data):
    motion, groups = evaluation.grouped(data, 50)
    assert groups.unique().tolist() == [0, 1] and len(motion.root) == 50 and motion.skeleton is STANDARD
    for at in (0, 49):
        starts = library[int(groups[at])].root
        assert (starts - motion.root[at, 0]).norm(dim=-1).min() < 1e-6


# --------------------------------------------------------------------------------------------------------- plots
def test_scores_have_a_dot_per_seed_and_lines_for_floor_and_aim():
    rows = {
        "real": [{"frechet": 1.0, "skate ratio": 1.0}],
        "ours": [{"frechet": x, "skate ratio": x} for x in (2, 3.0)],
    }
    fig = draw.scores(rows, {"frechet": "low", "skate ratio": "1"}, floor={"frechet": 1.5}, columns=2)
    dots = [[line for line in ax.get_lines() if line.get_marker() == "o"] for ax in fig.axes]
    assert [[len(line.get_xdata()) for line in lines] for lines in dots] == [[1, 2], [1, 2]]
    assert [line.get_xdata()[0] for line in fig.axes[0].get_lines() if line.get_linestyle() == "--"] == [1.5]
    assert [line.get_xdata()[0] for line in fig.axes[1].get_lines() if line.get_linestyle() == ":"] == [1.0]
    assert fig.axes[0].get_xscale() == "log" and fig.axes[1].get_xscale() == "linear"
    with pytest.raises(ShapeError, match="nothing"):
        draw.scores({}, {"frechet": "low"})


def test_cumulative_ends_at_all_and_marks_the_quantile():
    fig = draw.cumulative({"real": torch.arange(1.0, 101), "made": torch.ones(4)}, xlabel="m", quantile=("real", 0.05))
    real, made, mark = fig.axes[0].get_lines()
    assert real.get_ydata()[-1] == 100 and made.get_ydata().tolist() == [25, 50, 75, 100]
    assert abs(mark.get_xdata()[0] - 5.95) < 1e-6


def test_gaps_have_a_panel_each_in_centimetres():
    gaps = {gap: {"ours": torch.full((4, gap), 0.02), "theirs": torch.rand(4, gap)} for gap in (5, 15)}
    fig = draw.through_gaps(gaps, fps=30)
    assert [ax.get_title() for ax in fig.axes] == ["gap of 5 frames", "gap of 15 frames"]
    assert np.allclose(fig.axes[1].get_lines()[0].get_ydata(), 2) and len(fig.axes[1].get_lines()[0].get_xdata()) == 15


def test_the_curve_of_the_features_is_drawn_in_percent():
    fig = draw.learning([{"step": k, "place": 1 / k} for k in (1, 2)], ["place"])
    assert fig.axes[0].get_lines()[0].get_ydata().tolist() == [100, 50]


# -------------------------------------------------------------------------------------------------------- copies
def test_copies_are_found_and_brought_back(library, data, generator):
    copies = trivial.copying(data)(6, generator)
    moved = replace(copies, root=copies.root + torch.tensor([2.0, 1.0, 0.0]))
    fresh = evaluation.spoilt(copies, generator)["legs of another"]
    found = evaluation.neighbours({"copies": moved, "new": fresh}, library)
    assert found["copies"].distance.max() < 1e-4 < found["new"].distance.min()
    assert memorisation(found["copies"].distance, found["new"].distance).copies == 1
    for at in range(6):
        back = evaluation.recalled(found["copies"], at, library, FRAMES)
        torch.testing.assert_close(back.rot, copies.rot[at], atol=1e-5, rtol=0)


def test_a_mirrored_copy_is_brought_back_in_its_own_hand(library):
    copy = mirror(library[0].cut(5, 5 + FRAMES))
    query = Motion(STANDARD, copy.root[None], copy.rot[None], 30.0)
    found = evaluation.neighbours({"one": query}, library)["one"]
    assert found.mirrored.all() and int(found.start) == 5
    torch.testing.assert_close(evaluation.recalled(found, 0, library, FRAMES).rot, copy.rot, atol=1e-5, rtol=0)


# ------------------------------------------------------------------------------------------- trivial generators
def test_the_spectral_gaussian_has_the_power_and_no_correlation(model, real, generator):
    x0 = model.encode(real[0])
    plain = replace(model, normaliser=Normaliser(torch.zeros(x0.shape[-1]), torch.ones(x0.shape[-1])))
    made = trivial.spectral_gaussian(plain, x0)(2000, generator).root
    power = (cosines(FRAMES) @ made).square().mean(0)
    wanted = (cosines(FRAMES) @ x0[..., :3]).square().mean(0)
    big = wanted > 1e-3
    assert big.any() and (power[big] / wanted[big]).log().abs().max() < 0.25


def test_the_pca_gaussian_has_mean_and_covariance(model, generator):
    mix = torch.randn(5, FRAMES * model.layout.size, generator=generator)
    x0 = (torch.randn(400, 5, generator=generator) @ mix + 1).unflatten(1, (FRAMES, -1))
    plain = replace(model, normaliser=Normaliser(torch.zeros(x0.shape[-1]), torch.ones(x0.shape[-1])))
    made = trivial.pca_gaussian(plain, x0, kept=0.999)(4000, generator).root.flatten(1)
    true = x0[..., :3].flatten(1)
    assert (made.mean(0) - true.mean(0)).abs().max() < 0.2
    assert (made.T.cov() - true.T.cov()).norm() < 0.1 * true.T.cov().norm()
    with pytest.raises(ShapeError, match="two windows"):
        trivial.pca_gaussian(model, x0[:1])


def test_the_mean_is_held(model, real, generator):
    made = trivial.mean_held(model, model.encode(real[0]))(3, generator)
    assert made.root.shape == (3, FRAMES, 3) and made.root.diff(dim=1).abs().max() == 0


# -------------------------------------------------------------------------------------------------------- dances
def markers(motion):
    """Positions with AniDance's names, on the joints, of a body whose legs are as long as the standard's."""
    turns, points = motion.world[1], motion.positions
    found = {joint: points[:, STANDARD.index(joint)] for joint in dances.MARKERS}
    head, neck = STANDARD.index("head"), STANDARD.index("neck")
    for side, sign in (("left", 1.0), ("right", -1.0)):
        found[f"{side}_head"] = points[:, neck] + turns[:, head] @ torch.tensor([0.1 * sign, 0.2, 0.0])
        ankle = STANDARD.index(f"{side}_ankle")
        for name, along in (("heel", -0.05), ("toe", 0.15)):
            found[f"{side}_{name}"] = points[:, ankle] + turns[:, ankle] @ torch.tensor([0.0, -0.05, along])
    whole = torch.stack([found.get(name, points[:, 0]) for name in NAMES], 1)
    return Positions(NAMES, whole, torch.ones(whole.shape[:2], dtype=torch.bool), motion.fps, "made")


def test_markers_on_the_joints_give_the_motion_back(library):
    motion = library[0]
    found = dances.danced(markers(motion))
    assert found.residual < 0.02
    legs = STANDARD.indices([f"{s}_{part}" for s in ("left", "right") for part in ("knee", "ankle")])
    apart = (found.motion.positions - motion.positions).norm(dim=-1)
    assert apart[:, legs].mean() < 0.01 and apart.mean() < 0.02
    hips = STANDARD.indices(["left_hip", "right_hip"])
    wrong = torch.rad2deg(rotation.geodesic(found.motion.rot[:, hips], motion.rot[:, hips]))
    assert wrong.median() < 8  # the hinge says how a limb is turned


def test_a_body_twice_as_big_dances_the_same(library):
    points = markers(library[0].cut(0, 40))
    twice = dances.danced(replace(points, positions=2 * points.positions))
    torch.testing.assert_close(twice.motion.rot, dances.danced(points).motion.rot, atol=1e-4, rtol=0)


def test_other_points_are_no_dance(library):
    points = markers(library[0].cut(0, 5))
    with pytest.raises(ShapeError, match="AniDance"):
        dances.danced(points.select(NAMES[:5]))


def test_dances_are_split_by_kind_and_put_on_the_floor(library, tmp_path):
    with pytest.raises(MissingData):
        dances.load(tmp_path)
    (tmp_path / "anidance").mkdir()
    for number, name in enumerate(("c_1", "c_2", "w_1", "w_2", "w_3", "w_4")):
        points = markers(library[number % 2].cut(number, number + 60)).positions + torch.tensor([0.0, 0.0, 0.3])
        relative = torch.cat((points[:, :1], points[:, 1:] - points[:, :1]), 1)
        y_up = relative[..., [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])
        path = tmp_path / "anidance" / f"dance_{name}.npz"
        np.savez(path, positions_cm=(100 * y_up).numpy(), fps=25.0)
    split = dances.load(tmp_path)
    assert [d.motion.name for d in split["test"]] == ["dance_c_1", "dance_w_1", "dance_w_4"]
    assert [d.motion.name for d in split["train"]] == ["dance_c_2", "dance_w_2", "dance_w_3"]
    assert all(d.motion.fps == 30 for part in split.values() for d in part)
    assert [len(part) for part in dances.load(tmp_path, most=2).values()] == [2, 2]
    cut = dances.cut(split["train"], 30, 10)
    feet = cut.positions[..., STANDARD.indices(dances.FEET), 2]
    assert cut.root.shape[1:] == (30, 3) and 0 < feet.amin((1, 2)).min() < feet.amin((1, 2)).max() < 0.09


# ------------------------------------------------------------------------------------------------------- in-betweens
@pytest.fixture(scope="module")
def long(library):
    return replace(gather(library, 24).evenly(60), skeleton=STANDARD)


def test_windows_are_turned_to_their_heading_and_centred(long):
    found = inbetweening.canonical(long)
    assert rotation.yaw(found.rot[:, 9, 0]).abs().max() < 1e-4 and found.root[..., :2].mean(1).abs().max() < 1e-5
    torch.testing.assert_close(found.rot[..., 1:, :, :], long.rot[..., 1:, :, :])
    gaps = [m.root.diff(dim=1).norm(dim=-1) for m in (found, long)]
    torch.testing.assert_close(*gaps, atol=1e-5, rtol=1e-4)


def test_the_linear_model_keeps_what_is_given_and_beats_interpolation_where_it_was_trained(long):
    gap = 10
    model = inbetweening.linear(long, long, gap, penalties=(1e-4,))
    stats = inbetweening.statistics(long)
    found = inbetweening.judge(long, inbetweening.BASELINES | {"linear": model}, gap, stats)
    assert found["linear"].errors.mean() < 0.7 * found["interpolation"].errors.mean()
    assert found["interpolation"].errors.mean() < found["zero velocity"].errors.mean()
    seen = lafan.hidden(long, gap)
    filled = model(seen, gap)
    known = [*range(10), 20]
    torch.testing.assert_close(filled.rot[:, known], long.rot[:, known], atol=1e-5, rtol=0)
    torch.testing.assert_close(filled.root[:, known], long.root[:, known], atol=1e-5, rtol=0)
    with pytest.raises(ShapeError, match="gaps of 10"):
        model(seen, 5)


def test_the_penalty_is_chosen_by_the_error_on_other_windows(long):
    noise = replace(
        long, root=long.root + 0.1 * torch.randn(long.root.shape, generator=torch.Generator().manual_seed(1))
    )
    free, bound = (inbetweening.linear(noise, long, 5, penalties=(p,)) for p in (1e-9, 1e4))
    error = [inbetweening.errors(m(lafan.hidden(long, 5), 5), long, 5).mean() for m in (free, bound)]
    best = inbetweening.linear(noise, long, 5, penalties=(1e-9, 1e4))
    assert torch.equal(best.weights, (free, bound)[int(error[0] > error[1])].weights)


def test_a_perfect_filling_scores_nothing_and_a_model_never_sees_the_gap(long, model):
    stats = inbetweening.statistics(long)
    truth = inbetweening.canonical(long)
    perfect = {"truth": lambda seen, gap: truth.cut(0, 16)}
    found = inbetweening.judge(long, perfect, 5, stats)["truth"]
    assert found.errors.max() < 1e-5 and found.l2p.max() < 1e-4 and found.npss < 1e-6
    short = long.cut(0, 12)
    fill = inbetweening.by_diffusion(model, torch.Generator().manual_seed(0), Way(put="imputed", steps=4, finish=1))
    filled = fill(lafan.hidden(short, 1), 1)
    known = [*range(10), 11]
    torch.testing.assert_close(filled.rot[:, known], short.rot[:, known], atol=1e-4, rtol=0)
    torch.testing.assert_close(filled.root[:, known], short.root[:, known], atol=1e-4, rtol=0)
    other = replace(short, rot=short.rot.clone())
    other.rot[:, 10] = other.rot[:, 0]
    again = inbetweening.by_diffusion(model, torch.Generator().manual_seed(0), Way(put="imputed", steps=4, finish=1))
    torch.testing.assert_close(again(lafan.hidden(other, 1), 1).rot, filled.rot)
    with pytest.raises(ShapeError, match="do not fit"):
        fill(lafan.hidden(long, 5), 5)
