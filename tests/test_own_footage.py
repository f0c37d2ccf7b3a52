"""docs/own_footage.md: every command of the page is run, in a folder with a small clip of two people."""

import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from walked import SIZE, aside, few_steps, table, walk, write_camera, write_json

from motionlab.__main__ import main
from motionlab.footage import fit, scene_fit
from motionlab.io import gltf

PAGE = Path(__file__).resolve().parents[1] / "docs" / "own_footage.md"
COMMANDS = re.findall(r"^python -m (motionlab .*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
FRAMES = 6


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """clip.mp4, keypoints/ of the two people in it, camera.json; videos/ and detections/ of two clips."""
    folder = tmp_path_factory.mktemp("desk")
    motion = walk(FRAMES)
    write_json(folder / "keypoints", table(motion, aside(motion, -1.2, 0.4)), "clip")
    shades = np.random.default_rng(1).integers(0, 255, (72, 128, 3), np.uint8).repeat(10, 0).repeat(10, 1)
    imageio.mimwrite(folder / "clip.mp4", [shades] * FRAMES, fps=25)
    for name in ("a", "b"):
        shutil.copytree(folder / "keypoints", folder / "detections" / f"{name}_json")
        (folder / "videos").mkdir(exist_ok=True)
        shutil.copy(folder / "clip.mp4", folder / "videos" / f"{name}.mp4")
    write_camera(folder / "camera.json")
    return folder


def test_every_command_of_the_page_runs(desk, monkeypatch, capsys):
    few_steps(monkeypatch)
    monkeypatch.setattr(scene_fit, "FULL_WORK", scene_fit.QUICK_WORK)
    monkeypatch.setitem(sys.modules, "rtmlib", None)  # as where the extra is not installed
    monkeypatch.chdir(desk)
    assert len(COMMANDS) == 9
    for command in COMMANDS:
        words = shlex.split(command)[1:]
        finds_keypoints = words[0] == "fit" and "--keypoints" not in words
        assert main(words) == (2 if finds_keypoints else 0), command
        said = capsys.readouterr()
        if finds_keypoints:
            assert "pip install -c constraints.txt -e '.[detect]'" in said.err and "--keypoints" in said.err
    rows = json.loads((desk / "scene" / fit.RESULT).read_text())
    assert (
        rows["footage"]["fps"] == 25 and rows["keypoints"]["size"] == list(SIZE) and not rows["moving_camera"]["moved"]
    )
    assert len(json.loads((desk / "everybody" / fit.RESULT).read_text())["people"]) == 2
    assert json.loads((desk / "placed" / fit.RESULT).read_text())["camera"]["source"] == "given, and its place"
    assert all(fit.is_finished(desk / "scenes" / name) for name in ("a", "b"))
    named = set(re.findall(r"^\| `([\w.]+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert named == {path.name for path in (desk / "scene").iterdir()} - {"walk.glb"}  # the table lists what is there
    assert gltf.load(desk / "scene" / "walk.glb").frames == gltf.load(desk / "scene" / "scene.glb").frames
