"""Other programs open what ``fit`` writes: Blender its scene and BVH, ffprobe its film."""

import json
import shutil
import subprocess
from fractions import Fraction
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from walked import table, walk

from motionlab import __main__
from motionlab.io import bvh, gltf
from motionlab.observation import BODY_25, look_at
from tests.interop.asking import apart, blender, joints_of, needs_python

pytestmark = pytest.mark.interop
FRAMES, FPS, SIZE = 8, 25, (640, 360)  # of the film; the motions have 30 frames per second
SHOWN = (0, 3, 7)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """The folder that ``fit --quick`` makes of a third of a second of a walk."""
    folder = tmp_path_factory.mktemp("fit")
    at, to = torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9])
    seen = table(walk(FRAMES), camera=look_at(at, to, focal=450.0, width=SIZE[0], height=SIZE[1])).numpy()
    np.savez(folder / "seen.npz", keypoints=seen, names=np.array(BODY_25), fps=float(FPS), size=np.array(SIZE))
    imageio.mimwrite(folder / "clip.mp4", [np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)] * FRAMES, fps=FPS)
    words = ("fit", folder / "clip.mp4", "--keypoints", folder / "seen.npz", "--out", folder / "out", "--quick")
    assert __main__.main([str(word) for word in words]) == 0
    return folder / "out"


@needs_python
@pytest.mark.parametrize("name", ["scene.glb", "motion.bvh"])
def test_blender_plays_the_scene_and_the_bvh(scene, name):
    ours = {"scene.glb": gltf.load, "motion.bvh": bvh.load}[name](scene / name)
    found = blender(scene / name, 30, SHOWN)
    assert found["fps"] == ours.fps == 30 and len(found["meshes"]) == (name == "scene.glb")
    assert apart(joints_of(found), ours, SHOWN).max() < 1e-3
    assert apart(joints_of(found), ours, SHOWN, later=1).max() > 5e-3  # negative control


@pytest.mark.skipif(shutil.which("ffprobe") is None, reason="no ffprobe: apt-get install ffmpeg")
def test_ffprobe_counts_the_frames_of_the_film(scene):
    command = "ffprobe -v error -count_frames -select_streams v -show_streams -of json".split()
    said = subprocess.run([*command, scene / "overlay.mp4"], capture_output=True, text=True, check=True)
    (film,) = json.loads(said.stdout)["streams"]
    assert int(film["nb_read_frames"]) == FRAMES and Fraction(film["avg_frame_rate"]) == FPS  # decoded, not promised
    assert (film["codec_name"], film["pix_fmt"]) == ("h264", "yuv420p")  # what every browser and PowerPoint play
    assert not film["width"] % 2 and not film["height"] % 2
