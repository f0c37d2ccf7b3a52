"""`make lab` works on copies: they follow what is tracked, and what a person wrote stays."""

import json

from suite import copies


def write(path, text, output=""):
    cell = {"cell_type": "code", "source": [text], "outputs": [output]}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"cells": [cell]}), encoding="utf-8")


def test_copies_follow_unless_a_person_edited_them(tmp_path):
    tracked, lab = tmp_path / "notebooks", tmp_path / "lab"
    (tracked / "results").mkdir(parents=True)
    (tracked / "claims.toml").write_text("a = 1")
    for name in ("run.ipynb", "edited.ipynb", "both.ipynb"):
        write(tracked / name, "old")
    before = (tracked / "edited.ipynb").read_bytes()
    assert copies.refresh(lab, tracked) == []
    assert (lab / "claims.toml").read_text() == "a = 1" and (lab / "results").is_dir()
    write(lab / "run.ipynb", "old", output="42")
    write(lab / "edited.ipynb", "mine")
    write(lab / "both.ipynb", "mine")
    assert copies.refresh(lab, tracked) == []
    assert "42" in (lab / "run.ipynb").read_text() and (tracked / "edited.ipynb").read_bytes() == before
    write(tracked / "run.ipynb", "new")
    write(tracked / "both.ipynb", "new")
    for _ in range(2):  # it is said each time
        assert copies.refresh(lab, tracked) == ["both.ipynb"]
    names = [path.name for path in lab.glob("*.ipynb")]
    text = {name: json.loads((lab / name).read_text())["cells"][0]["source"] for name in names}
    assert text == {"run.ipynb": ["new"], "edited.ipynb": ["mine"], "both.ipynb": ["mine"]}
    (lab / "both.ipynb").rename(lab / "my own.ipynb")
    assert copies.refresh(lab, tracked) == []
    assert json.loads((lab / "both.ipynb").read_text())["cells"][0]["source"] == ["new"]
