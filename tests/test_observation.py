from dataclasses import replace

import pytest
import torch

from motionlab.errors import ShapeError
from motionlab.observation import BODY_25, Observation2D, look_at, project

F64 = torch.float64


def camera(**changes):
    view = {"focal": 1000.0, "width": 1920, "height": 1080} | changes
    return look_at(torch.tensor([0.0, -4.0, 1.5], dtype=F64), torch.tensor([0.0, 0.0, 1.0], dtype=F64), **view)


def test_the_target_is_in_the_middle_and_up_is_up():
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.5], [0.5, 0.0, 1.0]], dtype=F64)
    pixels, depth = project(camera(), points)
    torch.testing.assert_close(pixels[0], torch.tensor([960.0, 540.0], dtype=F64))
    assert pixels[1, 1] < 540 and pixels[2, 0] > 960  # y down in the image, x right
    torch.testing.assert_close(depth[0], torch.tensor([4.0, 0.5], dtype=F64).norm())


def test_projection_agrees_with_the_formula(generator):
    view = camera()
    points = torch.randn(3, 7, 3, generator=generator, dtype=F64)
    pixels, depth = project(view, points)
    for point, pixel, z in zip(points.reshape(-1, 3), pixels.reshape(-1, 2), depth.reshape(-1), strict=True):
        local = view.rotation @ point + view.translation
        torch.testing.assert_close(pixel, (view.intrinsics @ local / local[2])[:2])
        torch.testing.assert_close(z, local[2])
    one, far = project(view, points[1, 2])
    assert torch.equal(one, pixels[1, 2]) and torch.equal(far, depth[1, 2])
    torch.testing.assert_close(view.centre, torch.tensor([0.0, -4.0, 1.5], dtype=F64))
    torch.testing.assert_close(view.rotation @ view.rotation.mT, torch.eye(3, dtype=F64))
    torch.testing.assert_close(torch.linalg.det(view.rotation), torch.tensor(1.0, dtype=F64))


@pytest.mark.parametrize("target", [[0.0, -4.0, 1.5], [0.0, -4.0, 0.0]])
def test_a_view_without_a_horizon_is_refused(target):
    with pytest.raises(ShapeError, match="horizon"):
        look_at(torch.tensor([0.0, -4.0, 1.5]), torch.tensor(target), focal=1.0, width=1, height=1)


def test_observation_masks_by_confidence_alone():
    keypoints, confidence = torch.ones(4, 25, 2), torch.rand(4, 25) + 0.1
    confidence[1, 3] = 0
    seen = Observation2D(keypoints, confidence, BODY_25, 30.0)
    assert seen.frames == 4 and seen.visible.sum() == 99 and not seen.visible[1, 3]
    assert BODY_25[seen.index("mid_hip")] == "mid_hip" and len(set(BODY_25)) == 25
    with pytest.raises(KeyError, match="mid_hip"):
        seen.index("hip")


def test_misfitting_observations_are_refused():
    good = Observation2D(torch.ones(4, 25, 2), torch.ones(4, 25), BODY_25, 30.0)
    for change in ({"keypoints": torch.ones(4, 24, 2)}, {"confidence": torch.ones(3, 25)}, {"fps": -1.0}):
        with pytest.raises(ShapeError):
            replace(good, **change)
    with pytest.raises(ShapeError, match="intrinsics"):
        replace(camera(), intrinsics=torch.eye(4))
