import pytest
import torch
import trimesh

from data_synth.body import capsule_body, planted
from motionlab.errors import ShapeError
from motionlab.skeleton import STANDARD
from motionlab.skinning import tree_distance


@pytest.fixture(scope="module")
def body():
    return capsule_body(0.04)


def test_the_capsule_body_is_closed_and_fits_its_skeleton(body):
    mesh = trimesh.Trimesh(body.template.numpy(), body.faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
    assert 0.05 < mesh.volume < 0.11  # cubic metres, outward normals
    assert mesh.contains(body.joints.numpy()).all()
    assert torch.equal(body.skeleton.offsets, STANDARD.offsets)
    assert body.skeleton.sole == pytest.approx(STANDARD.sole, abs=1e-3)  # soles at the standard's floor


def test_its_weights_are_clean(body):
    torch.testing.assert_close(body.weights.sum(1), torch.ones(len(body.template)))
    assert body.weights[body.weights > 0].min() >= 0.02
    owner = body.weights.argmax(1)
    reach = tree_distance(body.skeleton)[owner][body.weights > 0]
    assert reach.max() <= 2
    assert set(owner.tolist()) == set(range(22))  # every joint carries flesh


@pytest.mark.parametrize("share", [0.01, 0.03, 0.1])
def test_planted_weights_are_the_share_asked_for_and_known(body, generator, share):
    faulty, mask = planted(body, generator, share)
    new = (faulty.weights > 0) & (body.weights == 0)
    assert torch.equal(new, mask)
    small = (faulty.weights > 0) & (faulty.weights < 1e-2)
    assert torch.equal(small, mask)
    assert float(small.sum() / (faulty.weights > 0).sum()) == pytest.approx(share, abs=1e-3)
    torch.testing.assert_close(faulty.weights.sum(1), torch.ones(len(faulty.template)))
    assert torch.equal(body.weights == 0, (faulty.weights == 0) | mask)  # the clean body stayed clean


def test_planting_more_than_there_is_room_for(body, generator):
    with pytest.raises(ShapeError, match="room"):
        planted(body, generator, 0.95)
