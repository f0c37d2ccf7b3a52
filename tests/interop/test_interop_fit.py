"""Other programs open what ``fit`` writes: Blender its scene and BVH, ffprobe its film, aitviewer its AMASS file."""

import shutil
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from walked import few_steps

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import __main__
from motionlab.footage import fit, scene_fit, scene_report
from motionlab.io import bvh, gltf, smpl
from motionlab.observation import BODY_25, look_at, project
from tests.interop.asking import apart, ask, blender, needs_python
from tests.interop.test_interop_amass import PELVIS, write_body
from tests.interop.test_interop_video import ffprobe
from tests.test_fit_draws import hidden_legs

pytestmark = pytest.mark.interop
FRAMES, FPS, SIZE = 8, 25, (640, 360)  # of the film; the motions have 30 frames per second
SHOWN = (0, 3, 8)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """The folder that ``fit --quick`` makes of a third of a second of a walk."""
    folder = tmp_path_factory.mktemp("fit")
    motion = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(4)).motion.cut(20, 20 + FRAMES)
    motion = replace(motion, root=motion.root - motion.root[:1] * torch.tensor([1.0, 1.0, 0.0]))
    at, to = torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9])
    points = project(look_at(at, to, focal=450.0, width=SIZE[0], height=SIZE[1]), fit.landmarks_of(motion))[0]
    table = torch.cat((points, torch.ones_like(points[..., :1])), -1)[:, None].numpy()
    np.savez(folder / "seen.npz", keypoints=table, names=np.array(BODY_25), fps=float(FPS), size=np.array(SIZE))
    imageio.mimwrite(folder / "clip.mp4", [np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)] * FRAMES, fps=FPS)
    words = ("fit", folder / "clip.mp4", "--keypoints", folder / "seen.npz", "--out", folder / "out", "--quick")
    assert __main__.main([str(word) for word in words]) == 0
    return folder / "out"


@needs_python
@pytest.mark.parametrize("name", ["scene.glb", "motion.bvh"])
def test_blender_plays_the_scene_and_the_bvh(scene, name):
    ours = {"scene.glb": gltf.load, "motion.bvh": bvh.load}[name](scene / name)
    found = blender(scene / name, 30, SHOWN)
    assert len(found["armatures"]) == found["actions"] == 1 and found["fps"] == ours.fps == 30
    assert len(found["meshes"]) == (name == "scene.glb")
    heads = np.array(
        [[frame[joint] for joint in ours.skeleton.names] for frame in next(iter(found["joints"].values()))]
    )
    assert np.abs(heads - ours.positions[list(SHOWN)].numpy()).max() < 1e-3
    assert np.abs(heads - ours.positions[[k + 1 for k in SHOWN[:-1]] + [0]].numpy()).max() > 5e-3  # negative control


@needs_python
def test_blender_plays_what_else_it_may_have_been(tmp_path, monkeypatch):
    """``fit --draws`` of somebody whose legs are hidden: everybody of draws.glb is an armature of their own."""
    monkeypatch.setattr(scene_report, "MAX_LATENT_CHI2", 1e9)  # the clip is short, and the fit a hasty one
    monkeypatch.setattr(scene_report, "MISFIT_WIDTH", 1e9)
    few_steps(monkeypatch)
    monkeypatch.setattr(scene_fit, "FULL_WORK", scene_fit.QUICK_WORK)
    fit.run_clip(hidden_legs(tmp_path), tmp_path / "out", draws=2)
    people = [gltf.load(tmp_path / "out/draws.glb", person=k) for k in (0, 1)]
    found = blender(tmp_path / "out/draws.glb", 30, (0, 3))
    assert len(found["armatures"]) == 2 and all(found["armatures"].values())
    for (name, heads), motion in zip(sorted(found["joints"].items()), people, strict=True):
        assert name.endswith(motion.name) and apart(heads, motion, (0, 3)).max() < 1e-3
    other = found["joints"][sorted(found["joints"])[1]]
    assert apart(other, people[0], (0, 3)).max() > 5e-3  # negative control


@pytest.mark.skipif(shutil.which("ffprobe") is None, reason="no ffprobe: apt-get install ffmpeg")
def test_ffprobe_counts_the_frames_of_the_film(scene):
    frames, rate, codec, pixels, *size = ffprobe(scene / "overlay.mp4")
    assert (frames, rate, codec, pixels) == (FRAMES, FPS, "h264", "yuv420p") and not any(side % 2 for side in size)


@needs_python
def test_aitviewer_puts_the_joints_where_the_amass_file_has_them(scene, tmp_path):
    """Its ``trans`` is the pelvis: a reader that adds SMPL's J_0 shows all of it moved by that, as the report says."""
    write_body(tmp_path)
    ours = smpl.load_motion(scene / "motion.npz")
    said = ask("aitviewer_reads.py", scene / "motion.npz", tmp_path, tmp_path / "joints.npz", 15).stdout
    assert "FPS 30.0" in said and "neutral" in said
    with np.load(tmp_path / "joints.npz") as found:
        joints = found["joints"][:, :22] - PELVIS.numpy()
    assert np.abs(joints - ours.positions.numpy()).max() < 1e-3
    assert np.abs(joints[1:] - ours.positions[:-1].numpy()).max() > 5e-3  # negative control
