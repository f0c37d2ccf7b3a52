"""docs/animate.md: every command of the page is run, in a folder with a short walk; the editor opens."""

import re
import shlex
import shutil

import pytest

from motionlab import io
from motionlab.__main__ import main
from motionlab.io import bvh
from tests.test_animate import mixamo, walk
from tests.test_architecture import ROOT

PAGE = (ROOT / "docs" / "animate.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^python -m (motionlab .*)$", PAGE, re.MULTILINE)


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """walk.bvh, and motions/ with two of them."""
    bvh.save(tmp_path / "walk.bvh", mixamo(walk(90, 30.0)))
    (tmp_path / "motions").mkdir()
    for name in ("a", "b"):
        shutil.copy(tmp_path / "walk.bvh", tmp_path / "motions" / f"{name}.bvh")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_command_of_the_page_runs(desk, capsys):
    assert len(COMMANDS) == 10
    for command in COMMANDS:
        assert main(shlex.split(command)[1:]) == 0, command
        said = capsys.readouterr().out
        if "--keys 0,30,60-last" in command:
            assert "32 of 90 frames have the file's own numbers, byte for byte" in said
    assert io.load("longer/generated_0.bvh").frames == 120 and len(list((desk / "made").iterdir())) == 2
    assert {path.name for path in (desk / "filled").iterdir()} == {"a.bvh", "b.bvh"}
    assert (desk / "repaired.bvh").read_bytes() == (desk / "walk.bvh").read_bytes() != (desk / "calm.bvh").read_bytes()


def test_the_call_of_the_page_opens_the_editor(desk):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    code = code.replace('"walk.bvh"', '"walk.bvh", backend="picture"').replace("animate.editor", "box = animate.editor")
    exec(code, names := {})
    assert names["box"].hands["player"].hand.max == 89
