"""Calibrations, judged by where they project: made by hand, then Pose2Sim's and Captury's own."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from motionlab.io import calibration, captury, openpose, trc
from motionlab.observation import Camera, look_at, project

needs_data = pytest.mark.skipif(
    not os.environ.get("MOTIONLAB_DATA"), reason="set MOTIONLAB_DATA to the unpacked recordings"
)


def some_camera() -> Camera:
    eye, target = torch.tensor([2.0, -3.0, 1.7]), torch.tensor([0.1, 0.2, 0.9])
    return look_at(eye, target, focal=1500.0, width=1920, height=1088)


def qualisys_text(camera: Camera, serial: str = "cam_01") -> str:
    rows = np.diag([1.0, -1.0, -1.0]) @ camera.rotation.double().numpy()
    turn = " ".join(f'r{i + 1}{j + 1}="{rows[i, j]}"' for i in range(3) for j in range(3))
    x, y, z = (camera.centre.double() * 1000).tolist()
    k = camera.intrinsics.double().numpy() * 64
    return f"""<?xml version='1.0' encoding='ASCII'?>
<calibration><cameras><camera serial="{serial}">
  <fov_video left="0" top="0" right="{camera.width - 1}" bottom="{camera.height - 1}"/>
  <transform {turn} x="{x}" y="{y}" z="{z}"/>
  <intrinsic focalLengthU="{k[0, 0]}" focalLengthV="{k[1, 1]}" centerPointU="{k[0, 2]}" centerPointV="{k[1, 2]}"/>
</camera></cameras></calibration>"""


def captury_text(camera: Camera) -> str:
    """The same camera in Captury's words: y up, (x, y, z)_file = (-x, z, y)_world, millimetres."""
    turn = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    right, down, _ = camera.rotation.double().numpy() @ turn.T
    origin = turn @ camera.centre.double().numpy() * 1000
    width, height = 10.0, 10.0 * camera.height / camera.width
    k = camera.intrinsics.double().numpy() * width / camera.width
    line = lambda values: " ".join(f"{v:.9f}" for v in values)  # noqa: E731
    return f"""tc camera calibration v0.3
camera\t0\tCamera
\tframe\t0
\t\tsensorSize\t {width:.9f} {height:.9f}\t# in mm
\t\tfocalLength\t {k[0, 0]:.9f}\t# in mm
\t\tpixelAspect\t {k[1, 1] / k[0, 0]:.9f}\t# y / x
\t\tcenterOffset\t {k[0, 2] - width / 2:.9f} {k[1, 2] - height / 2:.9f}\t# in mm
\t\torigin\t{line(origin)}
\t\tup\t{line(-down)}
\t\tright\t{line(right)}
"""


@pytest.mark.parametrize("kind", ["qualisys", "captury"])
def test_written_cameras_project_as_before(tmp_path, kind):
    camera, path = some_camera(), tmp_path / "camera"
    if kind == "qualisys":
        path.write_text(qualisys_text(camera))
        loaded = calibration.load_qualisys(path)["cam_01"]
    else:
        path.write_text(captury_text(camera))
        (loaded,) = calibration.load_captury(path, width=1920)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 0.0])
    torch.testing.assert_close(project(loaded, points)[0], project(camera, points)[0], atol=0.01, rtol=0)
    assert (loaded.width, loaded.height) == (1920, 1088)


@needs_data
def test_captury_joints_fall_on_captury_projections():
    """Its own projections, of its own joints, through its own cameras: equal to the digits in the file."""
    pairs = {"LAnkle": "LeftFoot", "RKnee": "RightLeg", "LHip": "LeftUpLeg", "RShoulder": "RightArm", "Head": "Head"}
    for take in sorted((Path(os.environ["MOTIONLAB_DATA"]) / "captury_falls").glob("video*")):
        joints = captury.load_biomech(take / "biomech.csv", fps=50)
        for index, camera in enumerate(calibration.load_captury(take / "camera.calib", width=1920)):
            seen = captury.load_projected(take / f"projected{index:02}.csv", camera=camera, fps=50)
            pixels, depth = project(camera, joints.select(list(pairs)).positions)
            there = seen.keypoints[:, [seen.index(name) for name in pairs.values()]]
            assert (depth > 0).all() and seen.visible.all()
            assert (pixels - there).norm(dim=-1).max() < 0.01


PAIRS = {f"{s}{part}": f"{side}_{part.lower()}" for s, side in (("L", "left"), ("R", "right"))
         for part in ("Hip", "Knee", "Ankle", "Heel", "Shoulder", "Elbow", "Wrist")}  # fmt: skip


def triangulate(cameras: list[Camera], pixels: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Linear triangulation (N, 3) of pixels (C, N, 2), weighted by confidence (C, N)."""
    rows = []
    for camera, uv, w in zip(cameras, pixels.double(), weight.double(), strict=True):
        p = camera.intrinsics.double() @ torch.cat((camera.rotation, camera.translation[:, None]), 1).double()
        rows += [w[:, None] * (uv[:, :1] * p[2] - p[0]), w[:, None] * (uv[:, 1:] * p[2] - p[1])]
    x = torch.linalg.svd(torch.stack(rows, 1)).Vh[:, -1]
    return x[:, :3] / x[:, 3:]


@needs_data
def test_pose2sim_views_meet_at_its_own_result():
    """SOURCE.txt: triangulating the four views gives 1.8 cm median distance to the TRC, 90 % below 7.8 cm."""
    root = Path(os.environ["MOTIONLAB_DATA"]) / "pose2sim_openpose"
    truth = trc.load(root / "ref3d/Balancing_for_IK.trc").select(list(PAIRS)).positions
    cameras = list(calibration.load_qualisys(root / "Calib.qca.txt").values())
    views = [openpose.load(root / f"single_balancing/cam0{n}_json", fps=60, layout="BODY_25B") for n in (1, 2, 3, 4)]
    pick = [views[0].index(name) for name in PAIRS.values()]
    pixels = torch.stack([view.keypoints[:, pick].flatten(0, 1) for view in views])
    weight = torch.stack([view.confidence[:, pick].flatten() for view in views])
    error = (triangulate(cameras, pixels, weight) - truth.flatten(0, 1)).norm(dim=-1)
    assert error.median() < 0.022 and error.quantile(0.9) < 0.09
    turned = trc.load(root / "ref3d/Balancing_for_IK.trc", axes="x-zy").select(list(PAIRS)).positions
    assert (triangulate(cameras, pixels, weight) - turned.flatten(0, 1)).norm(dim=-1).median() > 0.5
