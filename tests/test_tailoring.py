"""A body on other people's bones: it stays a human body, and its joints are theirs."""

from dataclasses import replace

import pytest
import torch

from motionlab import io
from motionlab.body import BodyModel, lbs, tailored
from motionlab.retarget import retarget
from motionlab.skeleton import STANDARD, Skeleton, fk
from tests.recorded import DATA, needs_data

#: Where rigs have what they move (pelvis at the origin; x left, y up, z forward, metres), and how long limbs are
#: against the body's.
PLACES = {
    "neck below the shoulders": ({"hip": (0.09, -0.1, 0.04), "spine1": (0, 0.01, 0), "spine2": (0, 0.12, -0.01),
                                  "spine3": (0, 0.23, -0.01), "neck": (0, 0.35, -0.01), "head": (0, 0.53, -0.01),
                                  "collar": (0, 0.35, -0.01), "shoulder": (0.2, 0.4, -0.02)}, 0.93),
    "low spine, narrow shoulders": ({"hip": (0.09, 0.03, -0.01), "spine1": (0, 0.21, -0.01), "spine2": (0, 0.26, 0),
                                    "spine3": (0, 0.32, -0.01), "neck": (0, 0.55, -0.03), "head": (0, 0.62, -0.02),
                                    "collar": (0.03, 0.52, -0.06), "shoulder": (0.12, 0.5, -0.05)}, 0.93),
    "a small person": ({"hip": (0.06, -0.02, 0), "spine1": (0, 0.16, 0), "spine2": (0, 0.2, 0), "spine3": (0, 0.25, 0),
                        "neck": (0, 0.41, 0), "head": (0, 0.48, 0), "collar": (0.05, 0.38, 0),
                        "shoulder": (0.1, 0.38, 0)}, 0.87),
    "no collars": ({"hip": (0.085, 0, 0), "spine1": (0, 0.09, 0), "spine2": (0, 0.16, 0), "spine3": (0, 0.24, 0),
                    "neck": (0, 0.46, 0), "head": (0, 0.56, 0.04), "collar": (0.11, 0.39, -0.01),
                    "shoulder": (0.18, 0.48, -0.02)}, 0.95),
}  # fmt: skip


def rig(places: dict, limbs: float = 1.0) -> Skeleton:
    """The standard skeleton with some joints elsewhere in its rest pose; what hangs on them comes along."""
    offsets, rest = limbs * STANDARD.offsets, [torch.zeros(3)]
    for joint, (name, parent) in enumerate(zip(STANDARD.names[1:], STANDARD.parents[1:], strict=True), start=1):
        side, _, part = name.rpartition("_")
        if part in places:
            mirror = torch.tensor([-1.0 if side == "right" else 1.0, 1.0, 1.0])
            offsets[joint] = torch.tensor(places[part]) * mirror - rest[parent]
        rest.append(rest[parent] + offsets[joint])
    return replace(STANDARD, offsets=offsets)


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel.from_anny()


def posed(body: BodyModel, skeleton: Skeleton) -> torch.Tensor:
    """The skin (V, 3) on a skeleton in the pose in which the body was modelled, arms half down."""
    bind = body.bind_rot
    rot = torch.cat((bind[:1], bind[list(STANDARD.parents[1:])].mT @ bind[1:]))
    return lbs(body, skeleton, torch.zeros(1, 3), rot[None])[0]


def longest(body: BodyModel, skin: torch.Tensor, of: torch.Tensor) -> float:
    """How far an edge of the mesh (of 6 mm or more) is stretched at most, against another skin, past what the whole
    body grew."""
    a, b = body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).unbind(1)
    length = (of[a] - of[b]).norm(dim=-1)
    ratio = ((skin[a] - skin[b]).norm(dim=-1) / length)[length > 0.006]
    return float(ratio.max() / ratio.median())


@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
def test_nothing_is_torn_and_the_neck_is_above_the_shoulders(body: BodyModel, places: tuple) -> None:
    theirs = rig(*places)
    made = tailored(body, theirs)
    skin, crushed, straight = posed(made, theirs), posed(body, theirs), posed(body, body.skeleton)
    assert longest(body, skin, straight) < 1.6 < longest(body, crushed, straight)

    def height(name: str, skin: torch.Tensor) -> float:
        """Of the flesh that a joint moves most, wherever the joint is."""
        return float(skin[body.weights.argmax(1) == STANDARD.index(name), 1].mean())

    head, shoulder = height("head", straight), height("left_shoulder", straight)
    grown = (height("head", skin) - height("left_shoulder", skin)) / (head - shoulder)
    assert 0.75 < grown < 1.1
    assert height("neck", skin) > height("left_shoulder", skin)


@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
def test_the_flesh_of_limbs_is_around_the_person_s_joints(body: BodyModel, places: tuple) -> None:
    """A knee's ring of skin lies around the knee: as near to it as on the body itself."""
    theirs = rig(*places)
    skin, own = posed(tailored(body, theirs), theirs), posed(body, body.skeleton)

    def bound(skeleton: Skeleton) -> torch.Tensor:
        turn = torch.cat((body.bind_rot[:1], body.bind_rot[list(STANDARD.parents[1:])].mT @ body.bind_rot[1:]))
        return fk(skeleton, torch.zeros(3), turn)[0]

    for name in ("knee", "ankle", "elbow", "wrist"):
        joint = STANDARD.index(f"left_{name}")
        ring = (body.weights[:, [joint, STANDARD.parents[joint]]] > 0.3).all(1)
        here = skin[ring].mean(0) - bound(theirs)[joint]
        usual = own[ring].mean(0) - bound(body.skeleton)[joint]
        assert torch.linalg.vector_norm(here - usual) < 0.008, name


def test_soles_are_where_the_skeleton_has_them(body: BodyModel) -> None:
    low = rig({"foot": (0.126, -0.965, 0.13)})  # ankles nearer to the floor by 4 cm
    floor = float(low.rest_positions()[:, 1].min()) - low.sole
    skin = posed(tailored(body, low), low)
    assert float(skin[:, 1].min()) == pytest.approx(floor, abs=0.008)
    assert float(posed(body, low)[:, 1].min()) < floor - 0.01  # as it was: the heels sink in


def test_a_larger_body_is_the_body_enlarged(body: BodyModel) -> None:
    made = tailored(body, body.skeleton.scaled(1.15))
    assert tailored(body, body.skeleton) is body
    torch.testing.assert_close(made.template, 1.15 * (body.template - body.joints[0]), atol=2e-5, rtol=0)
    torch.testing.assert_close(made.joints, 1.15 * (body.joints - body.joints[0]), atol=2e-5, rtol=0)


def test_other_joints_are_left_to_who_poses_them(body: BodyModel) -> None:
    other = Skeleton(("a", "b"), (-1, 0), torch.zeros(2, 3))
    assert tailored(body, other) is body


@needs_data
@pytest.mark.parametrize("found", ["cmu_amc/*.amc", "bandai_namco/**/*.bvh", "deepmimic/*walk1.txt"])
def test_recorded_people(body: BodyModel, found: str) -> None:
    path = next(iter(sorted(DATA.glob(found))))
    theirs = retarget(io.load(path)).motion.skeleton
    straight = posed(body, body.skeleton)
    assert longest(body, posed(tailored(body, theirs), theirs), straight) < 1.6
    assert longest(body, posed(body, theirs), straight) > 1.9
