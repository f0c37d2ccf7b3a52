"""The README's examples, each run exactly as printed, in a folder that holds what they read."""

import json
import re
from pathlib import Path

import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab.__main__ import _parser
from motionlab.fit import landmarks_of
from motionlab.io import bvh, gltf
from motionlab.observation import look_at, project
from motionlab.skeleton import STANDARD
from tests.test_architecture import notebooks

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)


WALK = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(4)).motion


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """A folder with walk.bvh and, of its first twelve frames, the keypoints in openpose_json/."""
    folder = tmp_path_factory.mktemp("desk")
    bvh.save(folder / "walk.bvh", WALK)
    camera = look_at(torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9]), focal=900.0, width=1280, height=720)
    pixels, _ = project(camera, landmarks_of(WALK.cut(0, 12)))
    (folder / "openpose_json").mkdir()
    for frame, points in enumerate(torch.cat((pixels, torch.ones_like(pixels[..., :1])), -1).flatten(1).tolist()):
        text = json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": points}]})
        (folder / "openpose_json" / f"view_{frame:04d}_keypoints.json").write_text(text)
    return folder


def test_there_are_four():
    assert len(EXAMPLES) == 4


def is_the_walk(names: dict) -> None:
    assert names["positions"].shape == (WALK.frames, 22, 3)
    assert torch.allclose(names["positions"], WALK.positions, atol=1e-5)


def is_a_fit_without_doubts(names: dict) -> None:
    assert names["positions"].shape == (1, 12, 22, 3) and names["positions"].isfinite().all()
    assert not names["found"].doubts.doubtful.any()


def is_a_repair_of_the_gap_alone(names: dict) -> None:
    cut, filled = names["cut"], names["filled"]
    assert cut.root.shape == filled.root.shape == (WALK.frames // 60, 60, 3)
    apart = (filled.positions - cut.positions).norm(dim=-1).amax((0, 2))  # the worst joint of every frame
    assert torch.cat((apart[:15], apart[45:])).max() < 1e-4 < apart[15:45].min() and apart.max() < 0.3


def is_a_file_for_viewers(names: dict) -> None:
    assert names["jitter"].shape == names["skating"].shape == () and names["jitter"] > 0 < names["skating"] < 1
    back = gltf.load("walk.glb")
    assert back.fps == WALK.fps and back.skeleton.names == STANDARD.names
    assert torch.allclose(back.positions, WALK.positions, atol=1e-5)


PROMISES = (is_the_walk, is_a_fit_without_doubts, is_a_repair_of_the_gap_alone, is_a_file_for_viewers)


@pytest.mark.parametrize(("number", "promise"), list(enumerate(PROMISES)))
def test_example_runs_as_printed_and_keeps_its_promise(number, promise, desk, monkeypatch):
    """Each stands alone: nothing of one is needed by another."""
    monkeypatch.chdir(desk)
    names: dict[str, object] = {}
    exec(compile(EXAMPLES[number], f"README example {number + 1}", "exec"), names)
    promise(names)


def test_control_a_wrong_example_fails(desk, monkeypatch):
    monkeypatch.chdir(desk)
    with pytest.raises(ImportError):
        exec(EXAMPLES[0].replace("import io", "import input_output"), {})


# ------------------------------------------------------------------------------------------------------ commands
def commands() -> list[tuple[str, str]]:
    """Where a command of the library is printed, in README, pages and text of notebooks, and what it says."""
    texts = {
        path.name: path.read_text(encoding="utf-8") for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
    }
    for path in notebooks(ROOT):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        texts[path.stem] = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return [(name, words) for name, text in texts.items() for words in re.findall(COMMAND, text)]


COMMAND = r"python -m motionlab ([^`\n#]+)"


def refused(words: str) -> bool:
    """Whether the command line does not understand a command, or cannot write what it is asked to."""
    try:
        options = _parser(words.split()[:1]).parse_args(words.split())
    except SystemExit:
        return True
    return words.startswith("fit ") and options.out is not None and bool(options.out.suffix)


def test_every_printed_command_is_understood(capsys):
    found = commands()
    assert len(found) > 15 and not [(name, words) for name, words in found if len(words.split()) > 1 and refused(words)]
    assert refused("fit FOLDER --out motion.npz") and refused("fit clip.mp4 --glb x.glb")  # as printed once
