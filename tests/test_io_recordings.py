import json

import numpy as np
import pytest
import seeds

from motionlab import __main__, io
from motionlab.errors import DataError, MissingData
from motionlab.io import bvh, smpl
from motionlab.io.points import Positions
from motionlab.io.recordings import inventory, passed_over, recordings
from motionlab.motion import Motion
from motionlab.observation import Observation2D
from tests.figures import standing
from tests.recorded import DATA, needs_data


def test_a_folder_of_ones_own_works(tmp_path):
    bvh.save(tmp_path / "walk.bvh", standing(6))
    deep = tmp_path / "mine" / "take 1"
    deep.mkdir(parents=True)
    smpl.save_motion(deep / "poses.npz", standing(6))
    (deep / "marks.trc").write_text(seeds.trc_text())
    for n in range(3):
        points = [float(v) for v in np.random.default_rng(n).uniform(1, 9, 54)]
        (deep / f"{n}.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": points}]}))
    (deep / "notes.txt").write_text("nothing")
    found = list(recordings(tmp_path, reading={"fps": 25}))
    assert [(r.source, r.path.name) for r in found] == [
        ("mine", "take 1"), ("mine", "marks.trc"), ("mine", "poses.npz"), (tmp_path.name, "walk.bvh"),
    ]  # fmt: skip
    kinds = {type(loader(path)) for _, path, loader in found}
    assert kinds == {Observation2D, Motion, Positions}
    rows = {(row.source, row.kind): row for row in inventory(tmp_path, video_fps=25)}
    assert rows["mine", "openpose"].fps == (25, 25) and rows["mine", "openpose"].points == (18, 18)
    assert rows[tmp_path.name, "bvh"].minutes == pytest.approx(6 / 30 / 60)
    assert rows["mine", "npz"].clips == rows["mine", "trc"].clips == 1


def test_a_bad_file_stops_nothing_and_is_named(tmp_path):
    for name in ("a", "c"):
        bvh.save(tmp_path / f"{name}.bvh", standing(6))
    (tmp_path / "b.bvh").write_text("HIERARCHY nothing")
    (tmp_path / "lost.amc").write_text(":DEGREES\n1\nroot 0 0 0 0 0 0\n")
    rows = {row.kind: row for row in inventory(tmp_path)}
    assert rows["bvh"].clips == 2 and rows["bvh"].fps == (30, 30)
    assert rows["bvh"].minutes == pytest.approx(2 * 6 / 30 / 60) and rows["bvh"].seen == 1
    for kind, file in (("bvh", "b.bvh"), ("amc", "lost.asf")):
        (error,) = rows[kind].unread
        assert isinstance(error, DataError | MissingData) and file in str(error)
    assert (rows["amc"].clips, rows["amc"].minutes, rows["amc"].points) == (0, 0, (0, 0))
    (tmp_path / "b.bvh").unlink()
    assert [row.unread for row in inventory(tmp_path) if row.kind == "bvh"] == [()]


def test_a_json_file_that_may_not_be_opened_is_named(tmp_path, monkeypatch):
    bvh.save(tmp_path / "a.bvh", standing(6))
    (tmp_path / "locked.json").write_text("{}")
    usual = type(tmp_path).open

    def refuse(self, *args, **kwargs):
        if self.name == "locked.json":
            raise PermissionError(13, "Permission denied")
        return usual(self, *args, **kwargs)

    monkeypatch.setattr(type(tmp_path), "open", refuse)
    rows = {row.kind: row for row in inventory(tmp_path)}
    assert rows["bvh"].clips == 1 and "locked.json" in str(rows["json"].unread[0])


def test_what_is_missing_says_how_to_get_it(tmp_path):
    with pytest.raises(MissingData, match="MOTIONLAB_DATA"):
        list(recordings(tmp_path / "nowhere"))
    with pytest.raises(MissingData, match="any recording"):
        list(recordings(tmp_path))
    (tmp_path / "mine").mkdir()
    with pytest.raises(MissingData, match="There are: mine"):
        list(recordings(tmp_path, "yours"))


def test_an_npz_of_no_known_layout_says_its_keys(tmp_path):
    np.savez(tmp_path / "c.npz", weights=np.zeros(3))
    with pytest.raises(DataError, match="its keys are weights"):
        io.load(tmp_path / "c.npz")


@needs_data
def test_every_recording_of_the_data_set_loads():
    left_out = {
        "anidance",
        "cmu_library",
        "cmu_native",
    }  # points that nothing reads; of two a sample is tested elsewhere
    rows = {
        (r.source, r.kind): r
        for name in sorted({path.name for path in DATA.iterdir()} - left_out)
        for r in inventory(DATA, name)
    }
    clips = {"bandai_namco": 213, "cmu_amc": 17, "deepmimic": 29, "reactidle": 4, "captury_falls": 3}
    assert {name: sum(r.clips for r in rows.values() if r.source == name) for name in clips} == clips
    minutes = {"bandai_namco": 18.4, "cmu_amc": 5.8, "deepmimic": 4.5, "reactidle": 7.0}
    for name, expected in minutes.items():
        assert sum(r.minutes for r in rows.values() if r.source == name) == pytest.approx(expected, abs=0.06)


def test_what_is_passed_over_is_said_with_the_reason(tmp_path, capsys):
    bvh.save(tmp_path / "walk.bvh", standing(6))
    for name in ("a.fbx", "b.fbx", "notes.md", "02.asf", "talk.json"):
        (tmp_path / name).write_text("{}")
    lines = "\n".join(passed_over(tmp_path))
    for words in (
        "2 .fbx, such as a.fbx: in Blender: import FBX, export BVH",
        "1 .md",
        "02.asf: name the .amc",
        "talk.json",
    ):
        assert words in lines
    assert "walk.bvh" not in lines
    assert __main__.main(["data", str(tmp_path)]) == 0
    assert "passed over" in capsys.readouterr().out
    with pytest.raises(DataError, match="import FBX, export BVH"):
        io.load(tmp_path / "a.fbx")


def test_what_is_said_of_files_goes_to_the_loaders_that_take_it(tmp_path):
    bvh.save(tmp_path / "walk.bvh", standing(6))
    (given,) = (r for r in recordings(tmp_path, reading={"unit": "m", "up": "y"}) if r.path.suffix == ".bvh")
    assert given.loader(given.path).notes == ()
    (row,) = inventory(tmp_path, reading={"fps": 12.0, "animation": 1})
    assert row.fps == (12, 12) and not row.unread


def test_one_file_is_a_folder_of_one(tmp_path, capsys):
    bvh.save(tmp_path / "a.bvh", standing(6))
    bvh.save(tmp_path / "b.bvh", standing(6))
    (tmp_path / "c.md").write_text("none")
    assert __main__.main(["data", str(tmp_path / "a.bvh")]) == 0
    said = capsys.readouterr().out
    assert "1 clips" in said and "up axis y detected" in said and "b.bvh" not in said
    assert __main__.main(["data", str(tmp_path / "c.md")]) == 2 and "c.md" in capsys.readouterr().err
