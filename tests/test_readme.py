"""The README's examples, each run exactly as printed, in a folder that holds what they read."""

import json
import re
from pathlib import Path

import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab.fit import landmarks_of
from motionlab.io import bvh
from motionlab.observation import look_at, project

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """A folder with walk.bvh and, of its first twelve frames, the keypoints in openpose_json/."""
    folder = tmp_path_factory.mktemp("desk")
    walk = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(4)).motion
    bvh.save(folder / "walk.bvh", walk)
    camera = look_at(torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9]), focal=900.0, width=1280, height=720)
    pixels, _ = project(camera, landmarks_of(walk.cut(0, 12)))
    (folder / "openpose_json").mkdir()
    for frame, points in enumerate(torch.cat((pixels, torch.ones_like(pixels[..., :1])), -1).flatten(1).tolist()):
        text = json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": points}]})
        (folder / "openpose_json" / f"view_{frame:04d}_keypoints.json").write_text(text)
    return folder


def test_there_are_four():
    assert len(EXAMPLES) == 4


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_example_runs_as_printed(number, desk, monkeypatch):
    """Each stands alone: nothing of one is needed by another."""
    monkeypatch.chdir(desk)
    names: dict[str, object] = {}
    exec(compile(EXAMPLES[number], f"README example {number + 1}", "exec"), names)
    tensors = [value for value in names.values() if isinstance(value, torch.Tensor)]
    assert all(value.isfinite().all() for value in tensors)


def test_control_a_wrong_example_fails(desk, monkeypatch):
    monkeypatch.chdir(desk)
    with pytest.raises(ImportError):
        exec(EXAMPLES[0].replace("import io", "import input_output"), {})
