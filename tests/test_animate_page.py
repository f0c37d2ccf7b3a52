"""docs/animate.md: every command of the page is run, in a folder like the checkout; the editor opens."""

import re
import shlex
import shutil

import pytest

from motionlab import examples, io, viz
from motionlab.__main__ import main
from tests.test_architecture import ROOT

PAGE = (ROOT / "docs" / "animate.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^((?:motionlab|cp) .*)$", PAGE, re.MULTILINE)


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """The walk where the page finds it, and motions/ with two of them; films have a few pictures."""
    (tmp_path / "motionlab").mkdir()
    (tmp_path / "motionlab" / "examples").symlink_to(examples.WALK.parent)
    (tmp_path / "motions").mkdir()
    for name in ("a.bvh", "b.bvh"):
        shutil.copy(examples.WALK, tmp_path / "motions" / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(viz, "draft", True)
    return tmp_path


def test_every_command_of_the_page_runs(desk, capsys):
    assert len(COMMANDS) == 16
    for command in COMMANDS:
        first, *words = shlex.split(command)
        if first == "cp":
            shutil.copy(*words)
            continue
        assert main(words) == 0, command
        said = capsys.readouterr().out
        if "--keys 0,30,60-last" in command:
            assert "139 of 197 frames keep the file's own numbers, byte for byte" in said
    assert io.load("loop.bvh").frames == 34
    assert io.load("longer/generated_0.bvh").frames == 227
    assert {path.name for path in (desk / "made").iterdir()} == {"generated_0.bvh", "generated_1.bvh", "both.mp4"}
    assert {path.name for path in (desk / "filled").iterdir()} == {"a.bvh", "b.bvh"}
    assert {path.name for path in desk.glob("*.mp4")} == {"walk.mp4", "between.mp4", "three.mp4"}
    assert (desk / "repaired.bvh").read_bytes() == (desk / "walk.bvh").read_bytes() != (desk / "calm.bvh").read_bytes()


def test_the_call_of_the_page_opens_the_editor(desk):
    shutil.copy(examples.WALK, desk)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    code = code.replace('"walk.bvh"', '"walk.bvh", backend="picture"').replace("filling.editor", "box = filling.editor")
    exec(code, names := {})
    assert names["box"].hands["player"].hand.max == 196
