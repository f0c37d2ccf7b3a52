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


def test_a_cut_between_two_cameras_is_told_from_what_cannot_be_told(wall):
    other = wall[::-1, ::-1]
    pictures = [*filmed(wall, 0)[:6], *filmed(other, 0)[6:]]
    found = video.background_drift(pictures, BOXES)
    assert np.flatnonzero(np.isinf(found)).tolist() == [6] and np.nanmax(np.delete(found, 6)) < video.MOVED / 2
    first = video.background_drift([filmed(other, 0)[0], *filmed(wall, 0)[1:]], BOXES)
    assert np.flatnonzero(np.isinf(first)).tolist() == [1]
    hidden = [*BOXES[:6], [(0, 0, WIDE, HIGH)], *BOXES[7:]]
    found = video.background_drift(filmed(wall, 0), hidden)
    assert np.isnan(found[6:8]).all() and not np.isinf(found).any()  # control: for a moment nothing could be seen


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_a_film_that_was_not_downloaded_to_its_end_is_refused(tmp_path, wall, suffix):
    how = {"fps": 25, "quality": 9, "output_params": ["-movflags", "faststart", "-g", "5"]}
    imageio.mimwrite(tmp_path / f"whole{suffix}", filmed(wall, 6) * 5, **how)
    data = (tmp_path / f"whole{suffix}").read_bytes()
    assert video.open_video(tmp_path / f"whole{suffix}").notes == ()
    (tmp_path / f"half{suffix}").write_bytes(data[: len(data) * 6 // 10])
    with pytest.raises(DataError, match=r"of a film of 2\.4 s can be read") as caught:
        video.open_video(tmp_path / f"half{suffix}")
    assert "get the whole file" in caught.value.remedy


def test_paths_that_ffmpeg_would_take_for_something_else(tmp_path, wall, monkeypatch):
    monkeypatch.chdir(tmp_path)
    imageio.mimwrite(tmp_path / "a.mp4", filmed(wall, 6), fps=25)
    for name in ("clip-12:30:05.mp4", "-i.mp4", "http:a.mp4", "clip 100%d.mp4"):
        (tmp_path / name).write_bytes((tmp_path / "a.mp4").read_bytes())
        found = video.open_video(name)
        assert found.frames == FRAMES and len(list(found.pictures(range(FRAMES)))) == FRAMES
