"""Calibrations, judged by where they project: made by hand, then Pose2Sim's and Captury's own."""

import pytest
import seeds
import torch

from motionlab.io import keypoints, points
from motionlab.io.cameras import load_cameras
from motionlab.observation import Camera, project
from studies.nb05_testops import falls
from studies.shared import captury
from tests.recorded import DATA, needs_data


@pytest.mark.parametrize("kind", ["qualisys", "captury"])
def test_written_cameras_project_as_before(tmp_path, kind):
    camera, path = seeds.camera(), tmp_path / "camera"
    if kind == "qualisys":
        path.write_text(seeds.qualisys_text())
        loaded = load_cameras(path)["cam_01"]
    else:
        path.write_text(seeds.captury_text())
        (loaded,) = load_cameras(path).values()
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 0.0])
    torch.testing.assert_close(project(loaded, points)[0], project(camera, points)[0], atol=0.01, rtol=0)
    assert (loaded.width, loaded.height) == (1920, 1088)


@needs_data
def test_captury_joints_fall_on_captury_projections():
    """Its own projections, of its own joints, through its own cameras: equal to the digits in the file."""
    pairs = {"LAnkle": "LeftFoot", "RKnee": "RightLeg", "LHip": "LeftUpLeg", "RShoulder": "RightArm", "Head": "Head"}
    for take in sorted((DATA / "captury_falls").glob("video*")):
        joints = captury.joints(take / "biomech.csv", pairs)
        for index, camera in enumerate(load_cameras(take / "camera.calib").values()):
            seen = falls.projected(take / f"projected{index:02}.csv", camera)
            pixels, depth = project(camera, joints)
            there = seen.keypoints[:, [seen.index(name) for name in pairs.values()]]
            assert (depth > 0).all() and seen.visible.all()
            assert (pixels - there).norm(dim=-1).max() < 0.01


def of(figure: points.Positions, names) -> torch.Tensor:
    return figure.positions[:, [figure.names.index(name) for name in names]]


@needs_data
def test_captury_tables_and_c3d_share_a_world():
    for take in sorted((DATA / "captury_falls").glob("video*")):
        knees, markers = captury.joints(take / "biomech.csv", ("LKnee", "RKnee")), points.load_c3d(take / "mocap.c3d")
        for side, knee in zip("LR", knees.unbind(1), strict=True):
            middle = of(markers, [f"Q_{side}KneeIn", f"Q_{side}KneeOut"]).mean(1)
            assert (middle - knee).norm(dim=-1).median() < 0.015


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
    root = DATA / "pose2sim_openpose"
    truth = of(points.load_trc(root / "ref3d/Balancing_for_IK.trc"), PAIRS)
    there = list(load_cameras(root / "Calib.qca.txt").values())
    views = [
        keypoints.load_person(root / f"single_balancing/cam0{n}_json", fps=60, layout="BODY_25B") for n in (1, 2, 3, 4)
    ]
    pick = [views[0].index(name) for name in PAIRS.values()]
    pixels = torch.stack([view.keypoints[:, pick].flatten(0, 1) for view in views])
    weight = torch.stack([view.confidence[:, pick].flatten() for view in views])
    error = (triangulate(there, pixels, weight) - truth.flatten(0, 1)).norm(dim=-1)
    assert error.median() < 0.022 and error.quantile(0.9) < 0.09
    turned = of(points.load_trc(root / "ref3d/Balancing_for_IK.trc", axes="x-zy"), PAIRS)
    assert (triangulate(there, pixels, weight) - turned.flatten(0, 1)).norm(dim=-1).median() > 0.5
