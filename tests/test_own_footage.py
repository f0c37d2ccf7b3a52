"""docs/own_footage.md: every command of the page is run, in a folder with a small clip of two people."""

import json
import re
import shlex
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import fit, scene_fit
from motionlab.__main__ import main
from motionlab.humor import testops
from motionlab.humor.shooting.feedback_solver import Plan
from motionlab.io import gltf
from motionlab.observation import look_at, project

PAGE = Path(__file__).resolve().parents[1] / "docs" / "own_footage.md"
COMMANDS = re.findall(r"^python -m (motionlab .*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
FRAMES, SIZE = 6, (1280, 720)


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """clip.mp4, keypoints/ of the two people in it, camera.json; videos/ and detections/ of two clips."""
    folder = tmp_path_factory.mktemp("desk")
    motion = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(4)).motion.cut(20, 20 + FRAMES)
    motion = replace(motion, root=motion.root - motion.root[:1] * torch.tensor([1.0, 1.0, 0.0]))
    other = replace(motion, root=motion.root + torch.tensor([-1.2, 0.4, 0.0]))
    camera = look_at(
        torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9]), focal=900.0, width=SIZE[0], height=SIZE[1]
    )
    people = torch.stack([project(camera, fit.landmarks_of(each))[0] for each in (motion, other)], 1)
    (folder / "keypoints").mkdir()
    for frame, points in enumerate(torch.cat((people, torch.ones_like(people[..., :1])), -1).flatten(2).tolist()):
        text = json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": row} for row in points]})
        (folder / "keypoints" / f"clip_{frame:012d}_keypoints.json").write_text(text)
    shades = np.random.default_rng(1).integers(0, 255, (72, 128, 3), np.uint8).repeat(10, 0).repeat(10, 1)
    imageio.mimwrite(folder / "clip.mp4", [shades] * FRAMES, fps=25)
    for name in ("a", "b"):
        shutil.copytree(folder / "keypoints", folder / "detections" / f"{name}_json")
        (folder / "videos").mkdir(exist_ok=True)
        shutil.copy(folder / "clip.mp4", folder / "videos" / f"{name}.mp4")
    content = {name: getattr(camera, name).tolist() for name in ("intrinsics", "rotation", "translation")}
    (folder / "camera.json").write_text(json.dumps(content | {"width": SIZE[0], "height": SIZE[1]}))
    return folder


def test_every_command_of_the_page_runs(desk, monkeypatch, capsys):
    plan = Plan(rounds=1, closures=2, leaps=0, trial=0)
    monkeypatch.setattr(scene_fit, "QUICK_WORK", testops.Schedule(steps=(1, 1, 1), inner=3, shooting=plan))
    monkeypatch.setitem(sys.modules, "rtmlib", None)  # as where the extra is not installed
    monkeypatch.chdir(desk)
    assert len(COMMANDS) == 8
    for command in COMMANDS:
        words = shlex.split(command)[1:]
        finds_keypoints = words[0] == "fit" and "--keypoints" not in words
        assert main(words) == (2 if finds_keypoints else 0), command
        said = capsys.readouterr()
        if finds_keypoints:
            assert "pip install -e '.[detect]'" in said.err and "--keypoints" in said.err
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
