import seeds
import torch

from motionlab.io import points


def test_joints_are_counted_off_by_the_groups(tmp_path):
    path = tmp_path / "biomech.csv"
    path.write_text(seeds.biomech_text())
    loaded = points.load_biomech(path, fps=50)
    assert loaded.names == ("CenterOfGravity", "LWrist") and loaded.fps == 50
    # millimetres; turned half about the vertical, into the world of the C3D file
    torch.testing.assert_close(loaded.positions[3], torch.tensor([[1.5, -2.0, 3.0], [-4.0, -5.0, 6.0]]) / 1000)


def test_projections_are_in_image_widths(tmp_path):
    path, camera = tmp_path / "projected00.csv", seeds.camera()
    path.write_text(seeds.projected_text().replace("0.21,0.25", "0.21,0.99"))
    seen = points.load_projected(path, camera=camera, fps=50)
    assert seen.names == ("Hips", "Head") and seen.camera is camera
    torch.testing.assert_close(seen.keypoints[1, 1], torch.tensor([0.11, 0.25]) * camera.width)
    assert seen.visible[:, 0].all() and seen.visible[:, 1].tolist() == [True, True, False, True]
    assert (seen.keypoints[2, 1] == 0).all()  # below the image
