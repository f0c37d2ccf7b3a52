"""Betas and bone lengths, and landmarks without a mesh."""

from dataclasses import replace

import pytest
import torch

from data_synth import capture
from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import rotation
from motionlab.body import BodyModel
from motionlab.errors import DataError, ShapeError
from motionlab.humor import body_shape
from motionlab.observation import BODY_25
from motionlab.skeleton import STANDARD, fk


def test_nought_is_the_standard_body_and_one_is_eight_per_cent():
    assert torch.equal(body_shape.offsets(torch.zeros(8)), STANDARD.offsets)
    longer = body_shape.offsets(torch.eye(8)).norm(dim=-1) / STANDARD.offsets.norm(dim=-1).clamp(min=1e-9)
    for g, names in enumerate(body_shape.BONE_GROUPS.values()):
        joints = STANDARD.indices(list(names))
        assert torch.allclose(longer[g, joints].log(), torch.tensor(0.08), atol=1e-6)
        others = sorted(set(range(1, 22)) - set(joints))
        assert torch.allclose(longer[g, others], torch.tensor(1.0), atol=1e-6)


def test_betas_come_back_from_their_skeletons(generator):
    betas = torch.randn(5, 8, generator=generator)
    found = body_shape.from_skeleton(replace(STANDARD, offsets=body_shape.offsets(betas)))
    assert torch.allclose(found, betas, atol=1e-5)


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda s: s.name)
def test_our_subjects_are_within_reach(subject):
    betas = body_shape.from_skeleton(subject.skeleton)
    assert betas.abs().max() < 2.5
    error = body_shape.offsets(betas).norm(dim=-1) - subject.skeleton.offsets.norm(dim=-1)
    assert error.abs().max() < 0.006  # ben's shin and foot differ, and one number holds both
    if subject.name != "ada":  # the standard body is worse: the betas do something
        assert (STANDARD.offsets - subject.skeleton.offsets).norm(dim=-1).max() > 0.012


def test_unknown_lengths_count_as_standard():
    offsets = body_shape.offsets(torch.ones(8))
    offsets[STANDARD.indices(["left_knee", "right_knee", "left_elbow"])] = torch.nan
    found = body_shape.from_skeleton(replace(STANDARD, offsets=offsets))
    names = list(body_shape.BONE_GROUPS)
    assert found[names.index("thighs")] == 0
    assert torch.allclose(found[names.index("upper arms")], torch.tensor(1.0), atol=1e-5)


def test_bones_without_length_and_other_joints_are_refused():
    with pytest.raises(DataError, match="no length"):
        body_shape.from_skeleton(replace(STANDARD, offsets=torch.zeros(22, 3)))
    with pytest.raises(ShapeError):
        body_shape.offsets(torch.zeros(7))


def test_landmarks_are_the_keypoints_of_the_skinned_body():
    take = ACTIONS["kick"](SUBJECTS[0], torch.Generator().manual_seed(3))
    motion = take.motion.cut(0, 40, 4)
    betas = torch.zeros(8)
    ours = body_shape.landmarks(*motion.world, betas)
    theirs = capture.keypoints(motion, BodyModel.from_anny())
    distance = (ours - theirs).norm(dim=-1).amax(0)
    neck = BODY_25.index("neck")
    assert distance[torch.arange(25) != neck].max() < 1e-3
    assert motion.positions.diff(dim=0).norm(dim=-1).max() > 0.05  # it does move


def test_landmarks_follow_shape_batch_and_gradient(generator):
    betas = torch.randn(3, 8, generator=generator, dtype=torch.float64).requires_grad_()
    rot = rotation.random((3, 4, 22), generator, dtype=torch.float64)
    root = torch.randn(3, 4, 3, generator=generator, dtype=torch.float64)
    body = replace(STANDARD, offsets=body_shape.offsets(betas)[:, None])
    found = body_shape.landmarks(*fk(body, root, rot), betas)
    assert found.shape == (3, 4, 25, 3)
    alone = replace(STANDARD, offsets=body_shape.offsets(betas[1]))
    assert torch.allclose(found[1], body_shape.landmarks(*fk(alone, root[1], rot[1]), betas[1]), atol=1e-12)
    nose, ear = found[..., BODY_25.index("nose"), :], found[..., BODY_25.index("left_ear"), :]
    width = (nose - ear).norm(dim=-1)
    scale = (body_shape.SPREAD * betas[:, list(body_shape.BONE_GROUPS).index("head")]).exp()
    expected = torch.dist(torch.tensor(body_shape.MARKS["nose"][1]), torch.tensor(body_shape.MARKS["left_ear"][1]))
    assert torch.allclose(width, (scale * expected)[:, None].expand(3, 4), atol=1e-6)
    found.sum().backward()
    assert betas.grad.isfinite().all() and betas.grad.abs().min() > 0
