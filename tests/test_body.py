from dataclasses import replace

import pytest
import torch
import twins

from data_synth.body import capsule_body
from motionlab import body, rotation
from motionlab.body import (
    AVERAGE_ADULT,
    BodyModel,
    _standard_owners,
    _t_pose_offsets,
    _to_rest_frame,
    cache_path,
    lbs,
    tailored,
)
from motionlab.errors import ShapeError
from motionlab.skeleton import STANDARD, Skeleton, fk
from tests.figures import standing

PARENTS = (-1, 0, 1, 1, 0, 4)


@pytest.fixture(scope="module")
def capsule() -> BodyModel:
    return capsule_body(0.05)


def random_body(generator, vertices=30, correctives=False) -> BodyModel:
    """Six joints, a bent bind pose and dense weights: nothing about it is special."""

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    joints, bind_rot = normal(6, 3), rotation.random((6,), generator, dtype=torch.float64)
    return BodyModel(
        template=normal(vertices, 3),
        joints=joints,
        bind_rot=bind_rot,
        weights=torch.softmax(3 * normal(vertices, 6), 1),
        faces=torch.arange(vertices).reshape(-1, 3),
        skeleton=Skeleton(tuple("abcdef"), PARENTS, _t_pose_offsets(joints, bind_rot, PARENTS)),
        keypoint_vertices={"nose": 3},
        pose_directions=0.1 * normal(vertices, 3, 45) if correctives else None,
    )


def random_pose(generator, *batch, joints=6):
    root = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    return root, rotation.random((*batch, joints), generator, dtype=torch.float64)


@pytest.mark.parametrize("correctives", [False, True])
def test_lbs_agrees_with_the_naive_twin(generator, correctives):
    body = random_body(generator, correctives=correctives)
    root, rot = random_pose(generator, 2, 4)
    own = body.skeleton.offsets
    skeleton = replace(body.skeleton, offsets=torch.stack((own, 1.2 * own))[:, None])  # one a clip
    found = lbs(body, skeleton, root, rot)
    positions, world = fk(skeleton, root, rot)
    for clip in range(2):
        for t in range(4):
            bent = body.template
            if correctives:
                bent = bent + body.pose_directions @ (rot[clip, t, 1:] - torch.eye(3)).flatten()
            where = positions[clip, t], world[clip, t]
            pose = [x.numpy() for x in (*where, body.bind_rot, body.joints, body.weights, bent)]
            torch.testing.assert_close(found[clip, t], torch.from_numpy(twins.lbs(*pose)), rtol=0, atol=1e-10)


def test_a_subset_is_rows_of_the_whole_and_touches_nothing_else(generator):
    body = random_body(generator, correctives=True)
    root, rot = random_pose(generator, 5)
    whole = lbs(body, body.skeleton, root, rot)
    for rows in ([3, 3, 17], torch.tensor([29])):
        torch.testing.assert_close(lbs(body, body.skeleton, root, rot, rows), whole[:, rows], rtol=0, atol=1e-12)


def test_gradients(generator):
    body = random_body(generator, vertices=6)
    root, rot = random_pose(generator, 1)
    tangent = torch.zeros(6, 3, dtype=torch.float64, requires_grad=True)
    grown = torch.ones((), dtype=torch.float64, requires_grad=True)

    def vertices(w, factor):
        return lbs(body, body.skeleton.scaled(factor), root, rot @ rotation.exp(w), [0, 4])

    assert torch.autograd.gradcheck(vertices, (tangent, grown))


def test_shapes_are_checked(generator):
    body = random_body(generator)
    root, rot = random_pose(generator, 2)
    with pytest.raises(ShapeError, match="rot"):
        lbs(body, body.skeleton, root, rot[:, :5])
    with pytest.raises(ShapeError, match="retarget"):  # an order of its own, as in a BVH: it would move other bones
        lbs(body, replace(body.skeleton, names=(*"acbdef",)), root, rot)
    with pytest.raises(ShapeError, match="weights"):
        BodyModel(**{**vars(body), "weights": body.weights[:, :5]})
    with pytest.raises(ShapeError, match="pose_directions"):
        BodyModel(**{**vars(body), "pose_directions": torch.zeros(30, 3, 9)})


@pytest.mark.parametrize("damage", ["cut", "garbage", "empty", "absent"])
def test_the_body_is_baked_once_and_again_where_the_cache_is_damaged(tmp_path, monkeypatch, capsule, damage):
    monkeypatch.setenv("MOTIONLAB_CACHE", str(tmp_path / "cache"))
    bakes = []
    monkeypatch.setattr(body, "_bake", lambda: bakes.append(1) or capsule)
    BodyModel.from_anny()
    path = cache_path()
    whole = path.read_bytes()
    again = BodyModel.from_anny()
    assert len(bakes) == 1  # the second call read the cache
    for name, value in vars(capsule).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, getattr(again, name)), name
    assert torch.equal(again.skeleton.offsets, capsule.skeleton.offsets)
    assert (again.skeleton.names, again.skeleton.sole) == (capsule.skeleton.names, capsule.skeleton.sole)
    assert again.keypoint_vertices == capsule.keypoint_vertices
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no half-written file stays
    path.write_bytes({"cut": whole[: len(whole) // 2], "garbage": b"\xff" * 300, "empty": b"", "absent": whole}[damage])
    if damage == "absent":
        path.unlink()
    assert torch.equal(BodyModel.from_anny().template, capsule.template)
    assert BodyModel.from_anny() and len(bakes) == 2


@pytest.fixture(scope="module")
def anny_model():
    import anny

    return anny.Anny(rig="game_engine", skinning_method="lbs")


@pytest.fixture(scope="module")
def default_body() -> BodyModel:
    return BodyModel.from_anny()


def test_the_default_body_has_the_standard_skeleton(default_body):
    assert default_body.skeleton.names == STANDARD.names
    torch.testing.assert_close(default_body.skeleton.offsets, STANDARD.offsets, rtol=0, atol=1e-3)
    assert abs(default_body.skeleton.sole - STANDARD.sole) < 1e-3
    torch.testing.assert_close(default_body.weights.sum(1), torch.ones(len(default_body.template)))
    motion = standing(1)
    skin = lbs(default_body, STANDARD, motion.root, motion.rot)[0]
    assert abs(float(skin[:, 2].min())) < 1e-3  # its soles are on the floor
    keypoints = {k: skin[v] for k, v in default_body.keypoint_vertices.items()}
    assert keypoints["left_eye"][0] < 0 < keypoints["right_eye"][0]  # facing +y, left is -x
    assert keypoints["nose"][1] == max(p[1] for k, p in keypoints.items() if "toe" not in k)
    assert keypoints["left_heel"][1] < 0 < keypoints["left_big_toe"][1]


def test_lbs_agrees_with_annys_own_skinning(default_body, anny_model, generator):
    """Random poses through anny's own forward: world bone orientations in its axes, fingers rigid with the hand."""
    body = default_body.to(torch.float64)
    root, rot = torch.randn(4, 3, generator=generator).double(), rotation.random((4, 22), generator).double()
    rot = rotation.slerp(torch.eye(3).double().expand_as(rot), rotation.nearest(rot), torch.full((4, 22), 0.5).double())
    _, world = fk(body.skeleton, root, rot)
    axes = _to_rest_frame(torch.eye(3).double()).mT  # rest frame from anny's axes
    turn = world @ body.bind_rot.mT @ axes
    bones = turn[:, _standard_owners(list(anny_model.bone_labels), list(anny_model.bone_parents))]
    rest = anny_model(phenotype_kwargs=AVERAGE_ADULT)
    heads = rest["rest_bone_heads"][0]
    pose = torch.eye(4).double().repeat(4, len(heads), 1, 1)
    pose[..., :3, :3] = bones @ rest["rest_bone_poses"][..., :3, :3]
    pelvis = anny_model.bone_labels.index("pelvis")
    pose[:, 0, :3, 3] = root - bones[:, 0] @ (heads[pelvis] - heads[0])
    expected = anny_model(pose, phenotype_kwargs=AVERAGE_ADULT, pose_parameterization="world-orient")
    away = (lbs(body, body.skeleton, root, rot) - expected["vertices"]).norm(dim=-1)
    assert away.max() < 1e-5
    positions = expected["bone_poses"][:, [anny_model.bone_labels.index("ball_l")], :3, 3]
    left_foot = fk(body.skeleton, root, rot)[0][:, [STANDARD.index("left_foot")]]
    torch.testing.assert_close(left_foot, positions, rtol=0, atol=1e-5)


def test_bones_of_a_known_adult_give_nearly_their_skin(default_body, anny_model):
    """Of anny's short adults the true skin is known; the bones alone tell most of it."""
    short = anny_model(phenotype_kwargs=AVERAGE_ADULT | {"height": 0.35})
    vertices, heads = (_to_rest_frame(short[f"rest_{name}"][0]).float() for name in ("vertices", "bone_heads"))
    owners = {joint: bone for bone, joint in body.JOINT_OF_BONE.items()}
    joints = heads[[anny_model.bone_labels.index(owners[name]) for name in STANDARD.names]]
    theirs = replace(STANDARD, offsets=_t_pose_offsets(joints, default_body.bind_rot, STANDARD.parents))
    bind, still = default_body.bind_rot, torch.zeros(1, 3)
    rot = torch.cat((bind[:1], bind[list(STANDARD.parents[1:])].mT @ bind[1:]))[None]
    people = (replace(default_body, template=vertices, joints=joints), tailored(default_body, theirs), default_body)
    truth, made, crushed = (lbs(person, theirs, still, rot)[0] for person in people)
    assert (made - truth).norm(dim=-1).mean() < 0.7 * (crushed - truth).norm(dim=-1).mean()
