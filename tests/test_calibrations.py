"""Calibrations of many tools say the same camera; its lens is taken out; and what cannot be meant is refused."""

import json

import calibrated
import numpy as np
import pytest
import torch
from calibrated import LENS, PLACED, PLAIN, SHIFT, SIZE, K
from loaders import refused as told

from motionlab.errors import DataError
from motionlab.io import cameras
from motionlab.io.cameras import for_images, load_camera
from motionlab.observation import Camera


def loaded(path, content: object, **how) -> tuple[Camera, bool]:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return load_camera(path, **how)


def refused(path, content: object, *words: str, **how) -> None:
    with told(*words):
        loaded(path, content, **how)


def check(camera: Camera, placed: bool, there: bool, coefficients=LENS) -> None:
    assert placed == there and (camera.width, camera.height) == SIZE
    assert torch.allclose(camera.intrinsics, torch.tensor(K)) and np.allclose(camera.distortion[:5], coefficients)
    expected = (PLACED["rotation"], SHIFT) if there else (np.eye(3), np.zeros(3))
    for found, wanted in zip((camera.rotation, camera.translation), expected, strict=True):
        assert np.allclose(found.numpy(), wanted, atol=1e-6)


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("name", calibrated.FORMATS)
def test_every_tool_says_the_same_camera(tmp_path, name, mark):
    content, there = calibrated.FORMATS[name]
    check(*loaded(tmp_path / name, mark + content), there)


@pytest.mark.parametrize(("model", "count"), [("OPENCV", 4), ("SIMPLE_RADIAL", 1), ("PINHOLE", 0)])
def test_models_of_colmap(tmp_path, model, count):
    camera, placed = loaded(tmp_path / "cameras.txt", calibrated.colmap(model))
    assert camera.distortion == tuple(LENS[:count]) and not placed and camera.intrinsics[0, 0] == K[0][0]
    refused(tmp_path / "cameras.txt", calibrated.colmap("FOV"), "line 4", "COLMAP's FOV", "undistort")
    refused(tmp_path / "cameras.txt", calibrated.colmap("PINHOLE").replace(" 350.0", ""), "3 parameters of PINHOLE")


def test_easymocap_writes_two_files_without_a_size(tmp_path):
    inner, outer = calibrated.easymocap(("01", "02"))
    refused(tmp_path / "intri.yml", inner, "no width, height", "--size", name="02")
    check(*load_camera(tmp_path / "intri.yml", "02", size=SIZE), False)
    (tmp_path / "extri.yml").write_text(outer)
    for name in ("intri.yml", "extri.yml"):
        check(*load_camera(tmp_path / name, "02", size=SIZE), True)
    check(*load_camera(tmp_path / "intri.yml", None, "somewhere/video_2", size=SIZE), True)
    (tmp_path / "intri.yml").write_text(f"{inner}W_02: {SIZE[0]}\nH_02: {SIZE[1]}\n")
    check(*load_camera(tmp_path / "intri.yml", "02"), True)
    (tmp_path / "intri.yml").unlink()
    with pytest.raises(DataError, match="no such file"):
        load_camera(tmp_path / "extri.yml", "02", size=SIZE)


def test_several_cameras_are_told_by_name(tmp_path):
    text = calibrated.pose2sim("cam_01") + calibrated.pose2sim("cam_02").split("[metadata]")[0].replace("1.4", "1.7")
    for how in ({"name": "cam_02"}, {"views": "x/cam02_json"}):
        assert loaded(tmp_path / "a.toml", text, **how)[0].translation[1] == pytest.approx(1.7)
    for how in ({}, {"views": "somewhere/left"}, {"name": "cam_09"}):
        refused(tmp_path / "a.toml", text, "cam_01, cam_02", **how)
    refused(tmp_path / "a.toml", text, "which of its cameras", "--camera-name")
    assert loaded(tmp_path / "b.json", [PLAIN, PLAIN | PLACED], name="1")[1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"intrinsics": [[0.7, 0, 0.5], [0, 1.25, 0.5], [0, 0, 1]]}, ("pixels for an image", "in pixels")),
        ({"intrinsics": [[4.2, 0, 650], [0, 4.2, 350], [0, 0, 1]]}, ("pixels for an image",)),  # in mm
        ({"intrinsics": [[-900, 0, 650], [0, 900, 350], [0, 0, 1]]}, ("focal lengths of -900",)),
        ({"intrinsics": [[900, 0, 650], [0, 900, 350], [0, 0, 2]]}, ("0 0 1",)),
        ({"intrinsics": [[900, 90, 650], [0, 900, 350], [0, 0, 1]]}, ("skewed",)),
        ({"intrinsics": [[900, 0, 2650], [0, 900, 350], [0, 0, 1]]}, ("far outside",)),
        ({"width": 720, "height": 1280}, ("middle of an image of 1280 x 720", "exchange width and height")),
        ({"width": 1e9}, ("width, height",)),
        ({"width": "wide"}, ("width, height",)),
        ({"distortion": [0.1, 0.2, 0.3]}, ("3 coefficients",)),
        ({"distortion": [*LENS, 0, 0, 0, 0.1, 0, 0, 0]}, ("12 coefficients",)),
        ({"model": "fisheye"}, ("a fisheye lens", "undistort")),
        ({"fisheye": True}, ("a fisheye lens",)),
        ({"fisheye_model": 1}, ("a fisheye lens",)),
        ({"lens": "OPENCV_FISHEYE"}, ("a fisheye lens",)),
        ({"camera_model": "KannalaBrandt4"}, ("a fisheye lens",)),
        (PLACED | {"translation": [x * 1000 for x in SHIFT]}, ("5216 m from the origin", "metres")),
        (PLACED | {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, ("rotation matrix",)),
        ({"rotation": [1.5, 0, 0]}, ("no translation",)),
    ],
)
def test_what_cannot_be_meant_is_refused(tmp_path, change, words):
    refused(tmp_path / "a.json", PLAIN | change, *words)


def test_a_portrait_camera_is_no_swapped_one(tmp_path):
    k = [[900.0, 0, 355], [0, 900.0, 645], [0, 0, 1]]
    camera, _ = loaded(tmp_path / "a.json", PLAIN | {"intrinsics": k, "width": 720, "height": 1280})
    assert (camera.width, camera.height) == (720, 1280)


def test_a_camera_for_images_of_another_size(tmp_path):
    camera, _ = loaded(tmp_path / "a.json", PLAIN)
    half, notes = for_images(camera, (640, 360), tmp_path / "a.json")
    assert torch.allclose(half.intrinsics[:2], camera.intrinsics[:2] / 2) and (half.width, half.height) == (640, 360)
    assert half.intrinsics[2, 2] == 1 and "scaled to those of 640 x 360" in notes[0]
    for same in (SIZE, (1280, 728)):  # some codecs fill up
        assert for_images(camera, same, tmp_path) == (camera, [])
    for other in ((720, 1280), (640, 480)):
        with told("images of 1280 x 720", f"{other[0]} x {other[1]}"):
            for_images(camera, other, tmp_path / "a.json")


# ---------------------------------------------------------------------------------------------------------------- lens
WIDE = (-0.25, 0.05, 0.001, -0.001, -0.003, 0.01, 0.002, 0.001)


def camera_of(coefficients) -> Camera:
    return Camera(torch.tensor(K), torch.eye(3), torch.zeros(3), *SIZE, tuple(coefficients))


def bent(point: np.ndarray, k) -> np.ndarray:
    """OpenCV's formula, number by number."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *[0.0] * (8 - len(k)))
    x, y = (point[0] - K[0][2]) / K[0][0], (point[1] - K[1][2]) / K[1][1]
    r = x**2 + y**2
    share = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    x, y = x * share + 2 * p1 * x * y + p2 * (r + 2 * x**2), y * share + p1 * (r + 2 * y**2) + 2 * p2 * x * y
    return np.array([x * K[0][0] + K[0][2], y * K[1][1] + K[1][2]])


@pytest.mark.parametrize("coefficients", [LENS, WIDE[:1], WIDE[:4], WIDE, (0.2, 0.1)])
def test_a_lens_is_taken_out_as_opencv_puts_it_in(coefficients):
    camera, draw = camera_of(coefficients), np.random.default_rng(0)
    straight = draw.uniform((0, 0), SIZE, (40, 2))
    curved = np.array([bent(point, coefficients) for point in straight])
    assert np.abs(curved - straight).max() > 5  # it does something
    assert np.allclose(cameras.distorted(straight, camera), curved, atol=1e-6)
    assert np.abs(cameras.undistorted(curved, camera) - straight).max() < 0.1
    assert cameras.undistorted(curved.reshape(5, 8, 2), camera).shape == (5, 8, 2)


def test_where_a_lens_puts_nothing_no_point_comes_from():
    """With k1 = -0.25 alone nothing lies beyond r' = 2/3 sqrt(1 / 0.75)."""
    camera = camera_of((-0.25,))
    edge = 2 / 3 * np.sqrt(1 / 0.75) * K[0][0]
    found = cameras.undistorted(np.array([[K[0][2] + edge * share, K[1][2]] for share in (0.99, 1.01, 3.0)]), camera)
    assert np.isfinite(found[0]).all() and np.isnan(found[1:]).all()


def test_pictures_are_straightened():
    """A line that the lens bends is straight again; without a lens nothing happens."""
    camera = camera_of((-0.25, 0.05))
    high, wide = SIZE[1] // 2, SIZE[0] // 2
    there = np.stack(np.meshgrid(np.arange(wide), np.arange(high)), -1) * 2.0
    before = cameras.undistorted(there, camera)
    picture = (np.abs(before[..., 1] - 100) < 6).astype(np.uint8)[..., None].repeat(3, -1) * 255
    (after,) = cameras.straight([picture], camera)
    rows = [np.flatnonzero(after[:, x, 0]).mean() for x in range(60, wide - 60, 20)]
    old = [np.flatnonzero(picture[:, x, 0]).mean() for x in range(60, wide - 60, 20)]
    assert np.ptp(rows) < 1.1 and np.ptp(old) > 5 and rows[0] == pytest.approx(50, abs=1)
    (same,) = cameras.straight([picture], camera_of((0.0,)))
    assert np.array_equal(same, picture)
