"""Keypoints and their footage put together: by frame, by number, by time stamp; and what does not belong together."""

import json
import subprocess
from pathlib import Path

import detected
import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from motionlab.errors import DataError
from motionlab.footage import clip
from motionlab.footage.clip import Clip
from motionlab.io import cameras, video
from motionlab.io.cameras import distorted

WIDE, HIGH, FRAMES = 64, 48, 61


def film(path: Path, frames: int = FRAMES, fps: float = 30.0) -> Path:
    """Picture k is as bright as k."""
    imageio.mimwrite(path, [np.full((HIGH, WIDE, 3), 4 * k % 250, np.uint8) for k in range(frames)], fps=fps, quality=9)
    return path


def keypoints(folder: Path, numbers, name: str = "clip_{:06d}_keypoints.json", scale: float = 0.05) -> Path:
    """One person whose points are 0.1 px farther to the right in every frame of the film, in files by number."""
    folder.mkdir(exist_ok=True)
    base = detected.points(25, people=1, frames=1)[0, 0]
    for n, number in enumerate(numbers):
        points = base * (scale, scale, 1) + (0.1 * number, 0, 0)
        text = json.dumps({"people": [{"pose_keypoints_2d": points.ravel().tolist()}]})
        (folder / name.format(number if "{:" in name else n)).write_text(text)
    return folder


def x_of(found: Clip) -> np.ndarray:
    """Where the nose is at 30 fps, in tenths of a pixel since the first frame."""
    seen = clip.observation(found, [found.footage.tracks[0].id])
    return ((seen.keypoints[0, :, 0, 0] - seen.keypoints[0, 0, 0, 0]) * 10).numpy()


def bright(found: Clip) -> np.ndarray:
    """The number of each picture of the film."""
    return np.array([round(float(p.mean()) / 4) for p in found.pictures(range(found.count))])


def test_every_second_frame_at_half_the_rate_is_the_whole_film(tmp_path):
    found = clip.open_clip(keypoints(tmp_path / "k", range(31)), film(tmp_path / "a.mp4"), fps=15)
    assert found.first == 0 and len(x_of(found)) == FRAMES == found.count
    assert np.allclose(x_of(found), np.arange(FRAMES) / 2, atol=1e-3)
    assert bright(found).tolist() == [*range(FRAMES)]
    first = clip.open_clip(tmp_path / "k", tmp_path / "a.mp4")  # control: without the rate they are the first second
    assert first.count == 31 and any("one in 2, say --fps 15" in note for note in first.notes)


@pytest.mark.parametrize("every", [2, 3, 5, 20])
@pytest.mark.parametrize("fps", [None, "its"])
def test_every_nth_frame_by_its_number(tmp_path, every, fps):
    rate = None if fps is None else 30 / every
    found = clip.open_clip(keypoints(tmp_path / "k", range(0, 61, every)), film(tmp_path / "a.mp4"), fps=rate)
    assert found.footage.frames == 1 + 60 // every * every and found.rate == found.footage.fps == 30
    frames = found.footage.tracks[0].frames
    assert frames.tolist() == [*range(0, 61, every)] and len(found.footage.tracks) == 1
    assert np.allclose(x_of(found)[frames], frames, atol=1e-3)


def test_images_of_coco_results_numbered_far_apart_are_frames_of_their_film(tmp_path):
    rows = [entry | {"image_id": 15 * entry["image_id"]} for entry in detected.results(17)]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    found = clip.open_clip(tmp_path / "a.json", film(tmp_path / "a.mp4"), size=detected.SIZE)
    assert found.footage.tracks[0].frames.tolist() == [0, 15, 30, 45]
    assert clip.open_clip(tmp_path / "a.json", fps=30).footage.frames == 4  # control: without a film, in a row


def test_a_folder_of_images_numbered_far_apart(tmp_path):
    (tmp_path / "images").mkdir()
    for n in range(9):
        Image.new("RGB", (WIDE, HIGH), (20 * n,) * 3).save(tmp_path / "images" / f"image{7 + 10 * n}.png")
    found = clip.open_clip(keypoints(tmp_path / "k", range(27, 80, 10)), tmp_path / "images", fps=30)
    assert (found.first, found.footage.frames, found.count) == (2, 6, 6)
    assert [round(float(p.mean()) / 20) for p in found.pictures(range(6))] == [2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("begin", [0, 1])
@pytest.mark.parametrize("more", [-2, -1, 0, 1])
def test_a_film_of_a_frame_more_or_less(tmp_path, more, begin):
    found = clip.open_clip(keypoints(tmp_path / "k", range(begin, begin + 20)), film(tmp_path / "a.mp4", 20 + more))
    assert found.first == 0 and found.count == min(20, 20 + more) and len(x_of(found)) == 20
    assert any("ends" in note for note in found.notes) == (more < 0)
    assert bright(found).tolist() == [*range(found.count)]


def test_keypoints_of_the_end_of_a_film_stay_there(tmp_path):
    found = clip.open_clip(keypoints(tmp_path / "k", range(30, 62)), film(tmp_path / "a.mp4", 60))
    assert found.first == 29 and any("begin at frame 29" in note for note in found.notes)


def test_a_film_that_is_too_short_is_refused(tmp_path):
    with pytest.raises(DataError, match="17 frames, but the keypoints reach frame 19"):
        clip.open_clip(keypoints(tmp_path / "k", range(20)), film(tmp_path / "a.mp4", 17))


# ------------------------------------------------------------------------------------------------------- variable rates
#: Frames come every 40 ms, then every 20, 80 and 33 or 34.
PACES = ((0, 0, 40.0), (10, 400, 20.0), (25, 700, 80.0), (30, 1100, 33.5))  # first frame, its ms, ms for one more
COUNT = 51
STAMPS = np.array([next(t + (n - a) * d for a, t, d in PACES[::-1] if n >= a) // 1 for n in range(COUNT)])


@pytest.fixture(scope="module")
def uneven(tmp_path_factory) -> Path:
    """A film whose picture k is as bright as k, at ``STAMPS`` ms."""
    folder, formula = tmp_path_factory.mktemp("uneven"), "0"
    for a, t, d in PACES:
        formula = f"if(gte(N,{a}),floor({t}+(N-{a})*{d}),{formula})"
    even = film(folder / "even.mp4", COUNT)
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(even), "-fps_mode", "passthrough"]
    words += ["-vf", f"settb=1/1000,setpts='{formula}'", "-enc_time_base", "1:1000"]
    subprocess.run([*words, "-video_track_timescale", "1000", str(folder / "a.mp4")], check=True)
    return folder / "a.mp4"


def test_pictures_of_a_variable_rate_are_its_frames(uneven):
    found = video.open_video(uneven)
    assert found.frames == COUNT and np.allclose(found.times, STAMPS / 1000, atol=1e-3)
    assert [round(float(p.mean()) / 4) for p in found.pictures(range(found.frames))] == [*range(found.frames)]
    assert "rate varies, from 12.5 to 50" in found.notes[0]
    even = video.open_video(uneven.with_name("even.mp4"))
    assert even.times is None and not even.notes  # control


@pytest.mark.parametrize("fps", [None, 30])
def test_keypoints_are_put_at_the_time_stamps(tmp_path, uneven, fps):
    found = clip.open_clip(keypoints(tmp_path / "k", range(COUNT)), uneven, fps=fps)
    assert any("put at the footage's time stamps" in note for note in found.notes)
    grid = np.arange(len(x_of(found))) / 30
    assert np.allclose(x_of(found), np.interp(grid, STAMPS / 1000, np.arange(COUNT)), atol=1e-2)
    assert len(grid) == int(STAMPS[-1] * 0.03) + 1
    seconds = np.arange(found.count) / found.rate
    shown = np.searchsorted(STAMPS / 1000, seconds + 1e-3, "right") - 1
    assert np.abs(bright(found) - shown).max() <= 1 and (bright(found) == shown).mean() > 0.9


def test_keypoints_of_a_copy_at_an_even_rate_are_put_by_time(tmp_path, uneven):
    count = round(STAMPS[-1] / 1000 * 25)
    found = clip.open_clip(keypoints(tmp_path / "k", range(count)), uneven, fps=25)
    assert found.times is None and np.allclose(np.diff(x_of(found)), 25 / 30, atol=1e-2)


# -------------------------------------------------------------------------------------------------- the image's size
def test_keypoints_of_images_of_another_size_are_refused(tmp_path):
    def checked(scale: float, **how) -> None:
        path = keypoints(tmp_path / f"k{scale}", range(20), scale=scale)
        found = clip.open_clip(path, film(tmp_path / "a.mp4", 20), **how)
        clip.in_image(found, [0])

    checked(0.1)
    with pytest.raises(DataError, match="lie outside its image of 64 x 48") as caught:
        checked(0.2)
    assert "--size" in caught.value.remedy
    checked(0.2, size=(128, 96))


def test_a_lens_is_taken_out_and_its_size_and_border_are_minded(tmp_path):
    k = [[500.0, 0, 640], [0, 500, 360], [0, 0, 1]]
    content = {"intrinsics": k, "width": 1280, "height": 720, "distortion": [-0.2, 0.03, 0, 0]}
    (tmp_path / "lens.json").write_text(json.dumps(content))
    path = keypoints(tmp_path / "k", range(20), scale=1.0)
    found = clip.with_camera(clip.open_clip(path, fps=30), tmp_path / "lens.json")
    straight = clip.straightened(found)
    before, after = (each.footage.tracks[0].points for each in (found, straight))
    assert np.abs(before - after)[..., :2].max() > 20 and np.array_equal(before[..., 2], after[..., 2])
    assert np.allclose(distorted(after[..., :2], found.camera), before[..., :2], atol=0.1)
    assert any("lens is taken out" in note for note in straight.notes)
    (tmp_path / "none.json").write_text(json.dumps(content | {"distortion": [0, 0, 0, 0]}))
    plain = clip.with_camera(clip.open_clip(path, fps=30), tmp_path / "none.json")
    assert clip.straightened(plain) is plain
    (tmp_path / "bad.json").write_text(json.dumps(content | {"distortion": [-250.0, 0, 0, 0]}))
    with pytest.raises(DataError, match="of the keypoints are"):
        clip.straightened(clip.with_camera(clip.open_clip(path, fps=30), tmp_path / "bad.json"))
    with pytest.raises(DataError, match="images of 1280 x 720"):
        clip.with_camera(clip.open_clip(path, fps=30, size=(720, 1280)), tmp_path / "lens.json")
    assert np.isnan(cameras.undistorted(np.array([9e5, 9e5]), found.camera)).all()


def test_keypoints_that_fill_a_quarter_of_an_image_without_footage_are_doubted(tmp_path):
    content = {"intrinsics": [[300.0, 0, 160], [0, 300, 120], [0, 0, 1]], "width": 320, "height": 240}
    (tmp_path / "camera.json").write_text(json.dumps(content))
    path = keypoints(tmp_path / "k", range(20), scale=0.2)  # 40 to 60, 40 to 80
    told = clip.read_clip(path, fps=30, camera=tmp_path / "camera.json")[0].notes
    assert sum("left upper quarter" in note and "--size 160x120" in note for note in told) == 1
    found = clip.read_clip(path, fps=30, camera=tmp_path / "camera.json", size=(160, 120))[0]
    assert found.camera.width == 160 and float(found.camera.intrinsics[0, 0]) == 150
    larger = clip.read_clip(keypoints(tmp_path / "m", range(20), scale=0.5), fps=30, camera=tmp_path / "camera.json")[0]
    assert not any("quarter" in note for note in (*found.notes, *larger.notes))
