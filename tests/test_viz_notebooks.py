"""The figures of the notebooks: they draw what they are given, once for each panel and series."""

import torch

from data_synth.body import capsule_body, planted
from motionlab import leakage, rotation, skinning
from motionlab import representations as rep
from motionlab.metrics.distribution import UNITS
from motionlab.rotation_trials import Consistency
from motionlab.viz import data, rotations, weights


def seed():
    return torch.Generator().manual_seed(0)


def test_a_leaning_turn_turns_as_far_as_asked():
    path = rotations.leaning_turn(2.0, 401)
    assert torch.rad2deg(rotation.geodesic(path[0], path[100])) > 85
    torch.testing.assert_close(path.det(), torch.ones(401, dtype=torch.float64))


def test_components_has_a_panel_per_representation_and_a_line_per_parameter():
    choices = (rep.AXIS_ANGLE, rep.QUATERNION, rep.SIXD)
    fig = rotations.components(rotations.leaning_turn(1.0, 50), choices)
    assert [len(ax.get_lines()) for ax in fig.axes] == [3, 4, 6]


def test_angles_are_cumulative_shares():
    angles = torch.cat((torch.full((25,), 179.0), torch.full((75,), 150.0)))
    fig = rotations.angles_from_the_cut({"synthetic": angles})
    line = next(line for line in fig.axes[0].get_lines() if line.get_label() == "synthetic")
    share = dict(zip(line.get_xdata().tolist(), line.get_ydata().tolist(), strict=True))
    assert share[2.0] == 25 and share[40.0] == 100


def test_excess_separates_gaps_by_the_cut():
    crossing = {"a": torch.tensor([True, False, False])}
    fig = rotations.excess({("a", "6D"): torch.tensor([300.0, 1.0, 2.0])}, crossing)
    dots = [sum(len(c.get_offsets()) for c in ax.collections) for ax in fig.axes]
    assert dots == [1, 2]


def test_consistency_and_carried_draw():
    outcome = Consistency({"axis-angle": torch.tensor([90.0, 1.0]), "6D": torch.zeros(2)}, torch.tensor([True, False]))
    assert "n = 1" in rotations.consistency({"a": outcome}).axes[0].get_title()
    assert len(rotations.carried_and_decoded(rotations.leaning_turn(1.0, 60).float()).axes) == 2


def test_weights_draw():
    body = capsule_body(spacing=0.06)
    faulty, mask = planted(body, seed())
    reports = {"clean": skinning.weight_report(body), "planted": skinning.weight_report(faulty)}
    assert len(weights.sizes(reports).axes) == 2
    figure = weights.reach(faulty.weights, skinning.surface_distance(faulty), mask)
    assert len(figure.axes[0].collections[1].get_offsets()) == int(mask.sum())
    face = [body.keypoint_vertices["nose"]]
    pose = torch.zeros(3), torch.eye(3).expand(22, 3, 3)
    grid = leakage.influence(faulty, *pose, face)
    assert weights.who_moves_whom({"planted": grid}, faulty, ["nose"]).axes[0].images
    assert weights.legs_moved([10.0], [0.0], "x").axes


def test_descriptions_and_distances_draw():
    found = {name: {k: torch.rand(20, generator=seed()) for k in UNITS} for name in ("synthetic", "a")}
    assert len(data.descriptions(found).axes) == len(UNITS)
    figure = data.distances({"a": (0.5, torch.rand(20, generator=seed()))})
    assert figure.axes[0].get_lines()[0].get_xdata()[0] == 0.5
