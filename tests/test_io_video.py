"""Footage: a video and a folder of images give the same pictures; a camera that turns shows, people do not."""

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from motionlab.errors import DataError
from motionlab.io import video

WIDE, HIGH, FRAMES = 320, 240, 12


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A wall with a pattern, wider than a picture."""
    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 255, (HIGH // 8, 80, 3), np.uint8)
    return np.asarray(Image.fromarray(coarse).resize((640, HIGH), Image.Resampling.BICUBIC))


def filmed(wall: np.ndarray, speed: int) -> list[np.ndarray]:
    """A camera that turns by ``speed`` pixels a picture, before which a person walks."""
    found = []
    for frame in range(FRAMES):
        picture = wall[:, frame * speed : frame * speed + WIDE].copy()
        picture[60:220, 20 + 15 * frame : 80 + 15 * frame] = (30, 60, 200)
        found.append(picture)
    return found


BOXES = [[(20 + 15 * frame, 60, 80 + 15 * frame, 220)] for frame in range(FRAMES)]


def test_a_camera_that_turns_is_told_from_a_person_who_walks(wall):
    still, turned = (video.background_drift(filmed(wall, speed), BOXES) for speed in (0, 6))
    assert still.max() < video.MOVED / 2
    assert turned[-1] == pytest.approx(6 * (FRAMES - 1) / WIDE, rel=0.15) and (np.diff(turned) > 0).all()


def test_what_cannot_be_told_is_not(wall):
    blank = [np.full((HIGH, WIDE, 3), 200, np.uint8)] * 3
    hidden = [[(0, 0, WIDE, HIGH)]] * 3
    for pictures, boxes in ((blank, [[]] * 3), (filmed(wall, 6)[:3], hidden)):
        assert np.isnan(video.background_drift(pictures, boxes)[1:]).all()


def test_video_and_images_give_the_same_pictures(tmp_path, wall):
    pictures = filmed(wall, 6)
    imageio.mimwrite(tmp_path / "clip.mp4", pictures, fps=25, quality=9)
    (tmp_path / "images").mkdir()
    for frame, picture in enumerate(pictures):
        Image.fromarray(picture).save(tmp_path / "images" / f"image{frame + 5}.png")  # 5 to 16: by number, not by name
    one, other = video.open_video(tmp_path / "clip.mp4"), video.open_video(tmp_path / "images")
    assert (one.fps, one.size, one.frames) == (25.0, (WIDE, HIGH), FRAMES)
    assert (other.fps, other.size, other.frames) == (None, (WIDE, HIGH), FRAMES)
    wanted = [0, 3, 3, 7, 11, 14]
    for a, b, frame in zip(one.pictures(wanted), other.pictures(wanted), wanted, strict=True):
        assert np.array_equal(b, pictures[min(frame, FRAMES - 1)])
        assert np.abs(a.astype(int) - b).mean() < 6


def test_what_is_no_footage(tmp_path):
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "images").mkdir()
    for name, message in (
        ("text.mp4", "text.mp4"), ("empty.mp4", "empty"), ("images", "0 images"), ("none", "no such file")
    ):  # fmt: skip
        with pytest.raises(DataError, match=message) as caught:
            video.open_video(tmp_path / name)
        assert caught.value.remedy
    Image.new("RGB", (8, 8)).save(tmp_path / "images" / "0.png")
    Image.new("RGB", (8, 9)).save(tmp_path / "images" / "1.png")
    with pytest.raises(DataError, match="a picture of"):
        list(video.open_video(tmp_path / "images").pictures([0, 1]))
