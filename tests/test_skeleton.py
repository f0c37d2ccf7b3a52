import numpy as np
import pytest
import torch
import twins

from motionlab import rotation
from motionlab.errors import ShapeError
from motionlab.skeleton import FEET, STANDARD, UPRIGHT, Skeleton, fk
from tests.figures import standing

F64 = torch.float64


def random_tree(seed: int) -> Skeleton:
    """A tree of random shape whose joints are not sorted by level."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 30))
    parents = (-1, *(int(rng.integers(0, j)) for j in range(1, count)))
    offsets = torch.as_tensor(rng.standard_normal((count, 3)))
    return Skeleton(tuple(f"joint{j}" for j in range(count)), parents, offsets)


@pytest.mark.parametrize("seed", range(12))
def test_fk_agrees_with_its_scalar_twin(seed):
    generator = torch.Generator().manual_seed(seed)
    skeleton = random_tree(seed)
    rot = rotation.random((2, 3, len(skeleton)), generator, dtype=F64)
    root = torch.randn(2, 3, 3, generator=generator, dtype=F64)
    positions, orientations = fk(skeleton, root, rot)
    for i, t in np.ndindex(2, 3):
        p, r = twins.fk(skeleton.parents, skeleton.offsets.numpy(), root[i, t].numpy(), rot[i, t].numpy())
        np.testing.assert_allclose(positions[i, t], p, atol=1e-13)
        np.testing.assert_allclose(orientations[i, t], r, atol=1e-13)


def test_fk_of_one_body_per_clip_and_of_one_root_for_all(generator):
    scale = torch.tensor([1.0, 1.3])[:, None, None, None]
    bodies = Skeleton(STANDARD.names, STANDARD.parents, STANDARD.offsets * scale)
    rot = rotation.random((2, 5, 22), generator)
    root = torch.randn(2, 5, 3, generator=generator)
    both, _ = fk(bodies, root, rot)
    for i, factor in enumerate((1.0, 1.3)):
        torch.testing.assert_close(both[i], fk(STANDARD.scaled(factor), root[i], rot[i])[0])
    torch.testing.assert_close(fk(STANDARD, root[0, 0], rot)[0], fk(STANDARD, root[0, 0].expand(2, 5, 3), rot)[0])


def test_the_standard_stands_on_the_floor_facing_y():
    joints = dict(zip(STANDARD.names, standing(1).positions[0], strict=True))
    assert joints["left_foot"][2] == pytest.approx(STANDARD.sole, abs=1e-6)
    assert joints["head"][2] > joints["pelvis"][2] > joints["left_knee"][2] > joints["left_ankle"][2] > 0.05
    assert joints["left_wrist"][0] < -0.5 < 0.5 < joints["right_wrist"][0]  # facing +y, left is -x
    assert joints["left_foot"][1] > joints["left_ankle"][1]  # toes ahead
    torch.testing.assert_close(torch.linalg.det(UPRIGHT), torch.tensor(1.0))
    assert [STANDARD.names[i] for i in STANDARD.contact_indices[3:7]] == list(FEET)


def test_mirror_partners_swap_sides():
    partner = STANDARD.mirror_indices
    assert [partner[j] for j in partner] == list(range(22))
    assert STANDARD.names[partner[STANDARD.index("left_knee")]] == "right_knee"
    assert partner[0] == 0
    flip = torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(STANDARD.offsets[partner] * flip, STANDARD.offsets)


@pytest.mark.parametrize("parents", [(-1, 2, 1), (0, 0, 1), (-1, -1, 0), (-1, 0), (-2, 0, 1)])
def test_a_broken_tree_is_refused(parents):
    with pytest.raises(ShapeError, match="parents"):
        Skeleton(("a", "b", "c"), parents, torch.zeros(3, 3))


def test_unknown_joints_and_wrong_shapes_are_named():
    with pytest.raises(KeyError, match="left_knee"):
        STANDARD.index("knee")
    with pytest.raises(KeyError, match="heel"):
        Skeleton(("a",), (-1,), torch.zeros(1, 3), contact_names=("heel",))
    with pytest.raises(ShapeError, match="offsets"):
        Skeleton(("a",), (-1,), torch.zeros(2, 3))
    with pytest.raises(ShapeError, match="rot"):
        fk(STANDARD, torch.zeros(3), torch.zeros(21, 3, 3))
