"""Commands on folders of clips: each is what one alone gives, what is finished is skipped, what fails is named."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from walked import table, write_json

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab.__main__ import main
from motionlab.commands import batch
from motionlab.commands.footage import _clips_of
from motionlab.errors import DataError
from motionlab.footage import fit
from motionlab.io import bvh
from motionlab.observation import look_at

CAMERA = look_at(torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9]), focal=90.0, width=128, height=72)


def walk(seed: int, frames: int):
    return ACTIONS["walk"](SUBJECTS[seed], torch.Generator().manual_seed(seed)).motion.cut(20, 20 + frames)


# ------------------------------------------------------------------------------------------------------ inbetween
@pytest.fixture
def motions(tmp_path):
    """Three BVH files of 30 frames."""
    folder = tmp_path / "motions"
    folder.mkdir()
    for k in range(3):
        bvh.save(folder / f"walk{k}.bvh", walk(k, 30))
    return folder


def inbetween(source, out, *words):
    return main(["inbetween", str(source), "--keys", "0,15,last", "--method", "curves", "--out", str(out), *words])


def test_a_folder_in_two_processes_is_what_each_file_alone_gives(motions, tmp_path, capsys):
    assert inbetween(motions, tmp_path / "made", "--jobs", "2") == 0
    said = capsys.readouterr().out
    assert "3 clips: 3 done" in said and said.count("byte for byte") == 1 and "(3 clips)" in said
    for path in motions.iterdir():
        assert inbetween(path, tmp_path / "one.bvh") == 0
        made = (tmp_path / "made" / path.name).read_text()
        assert made == (tmp_path / "one.bvh").read_text() != path.read_text()


def test_a_cluster_gives_what_one_process_gives(motions, tmp_path, monkeypatch, cluster, capsys):
    monkeypatch.setattr(batch, "PATIENCE", 10 * batch.PATIENCE)  # a busy machine
    monkeypatch.chdir(tmp_path)  # the workers stand elsewhere
    assert inbetween("motions", "made", "--cluster", cluster[0]) == 0
    assert inbetween("motions", "serial") == 0
    assert capsys.readouterr().out.count("3 clips: 3 done") == 2
    for path in motions.iterdir():
        assert (tmp_path / "made" / path.name).read_bytes() == (tmp_path / "serial" / path.name).read_bytes()


def test_what_is_made_is_skipped_and_what_fails_is_named(motions, tmp_path, capsys):
    (motions / "broken.bvh").write_text("HIERARCHY\nROOT")
    assert inbetween(motions, tmp_path / "made") == 1
    said = capsys.readouterr()
    assert "4 clips: 3 done, 1 failed" in said.out and "failed: broken.bvh" in said.err
    assert "Traceback" not in said.err and "remedy" not in said.out and said.err.count("remedy") == 1
    bvh.save(motions / "broken.bvh", walk(3, 30))  # mended
    assert inbetween(motions, tmp_path / "made") == 0
    said = capsys.readouterr().out
    assert "4 clips: 1 done, 3 finished before" in said and "perhaps made with other options" in said


def test_files_of_a_folder_that_are_passed_over_are_counted(motions, tmp_path, capsys):
    for name in ("take.amc", "notes.txt", "walk0.BAK"):
        (motions / name).write_text("x")
    (motions / "older").mkdir()
    assert inbetween(motions, tmp_path / "made") == 0
    assert "note: 3 of 6 files were passed over: not .bvh .npz .glb .npy" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("motions/walk0.bvh", "one.bvh", "--jobs", "2"), "one motion is not shared out"),
        (("motions", "one.bvh"), "goes into a folder"),
        (("motions", "motions/../motions"), "the motions would be written over"),
        (("motions/walk0.bvh", "motions/../motions/walk0.bvh"), "this is the file that was opened"),
        (("motions/walk0.bvh", "one.fbx"), "use one of .bvh, .npz, .glb"),
        (("empty", "made"), "no motion (.bvh, .npz, .glb, .npy) in this folder"),
        (("motions", "made", "--cluster", "tcp://127.0.0.1:1"), "no Dask scheduler answers"),
    ],
)
def test_folders_that_cannot_be_used(motions, tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.setattr(batch, "PATIENCE", 0.3)
    (tmp_path / "empty").mkdir()
    before = {path: path.read_bytes() for path in motions.iterdir()}
    assert inbetween(tmp_path / words[0], tmp_path / words[1], *words[2:]) == 2
    assert said in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in motions.iterdir()}


# ------------------------------------------------------------------------------------------------------------ fit
def make_footage(folder):
    """videos/ with two folders of images, keypoints/ with the folders of a detector."""
    for k, name in enumerate(("cam1", "cam1_2")):
        frames = table(walk(k, 6), camera=CAMERA)
        videos = folder / "videos" / name
        videos.mkdir(parents=True)
        write_json(folder / "keypoints" / f"{name}_json", frames, name)
        for frame in range(len(frames)):
            Image.fromarray(np.full((72, 128, 3), 40 * frame, np.uint8)).save(videos / f"{frame:04d}.png")
    return folder


@pytest.fixture
def footage(tmp_path):
    return make_footage(tmp_path)


def fit_each(folder, *words):
    how = ["--each", "--quick", "--fps", "30", "--out", str(folder / "scenes"), *words]
    return main(["fit", str(folder / "videos"), "--keypoints", str(folder / "keypoints"), *how])


def arrays(folder):
    """What the motions of a folder's clips are, to the bit."""
    found = {}
    for path in sorted(folder.glob("*/motion.npz")):
        with np.load(path) as archive:
            found[path.parent.name] = {key: archive[key].tobytes() for key in archive}
    return found


@pytest.fixture(scope="module")
def two_at_once(tmp_path_factory):
    """Two clips, and what two processes make of them."""
    folder = make_footage(tmp_path_factory.mktemp("footage"))
    assert fit_each(folder, "--jobs", "2") == 0
    return folder


def test_each_clip_of_a_folder_becomes_a_scene_and_finished_ones_are_skipped(
    two_at_once, tmp_path, monkeypatch, capsys
):
    """What is made again, alone, is what it was beside another."""
    scenes, before = two_at_once / "scenes", arrays(two_at_once / "scenes")
    for name in ("cam1", "cam1_2"):
        record = json.loads((scenes / name / fit.RESULT).read_text())
        assert f"{name}_json" in record["keypoints"]["path"] and record["footage"]["path"].endswith(name)
    shutil.move(scenes / "cam1", tmp_path)
    assert fit_each(two_at_once) == 0
    assert "2 clips: 1 done, 1 finished before" in capsys.readouterr().out
    assert arrays(scenes) == before and len(before) == 2 and before["cam1"] != before["cam1_2"]
    found = []

    def no_run(function, clips, *, finished, **how):
        found.append([finished(clip) for clip in clips])
        return batch.Batch({}, (), {})

    monkeypatch.setattr(batch, "run_many", no_run)
    assert fit_each(two_at_once) == fit_each(two_at_once, "--person", "all") == 0
    assert found == [[True, True], [False, False]]  # made with other options is not finished


def test_clips_are_put_together_by_their_names(footage):
    found = _clips_of(footage / "keypoints", footage / "videos")
    both = [(name, a.name, b.name) for name, (a, b) in found.items()]
    assert both == [(name, f"{name}_json", name) for name in ("cam1", "cam1_2")]
    assert _clips_of(None, footage / "videos")["cam1"] == (None, footage / "videos" / "cam1")
    assert _clips_of(footage / "keypoints", None)["cam1_json"] == (footage / "keypoints" / "cam1_json", None)
    for name in ("cam1.npz", "cam1.csv"):  # two for one video
        (footage / "keypoints" / name).touch()
    with pytest.raises(DataError, match="one name"):
        _clips_of(footage / "keypoints", footage / "videos")
    (footage / "keypoints" / "cam1.csv").unlink()
    with pytest.raises(DataError, match=r"the keypoints of cam1: cam1\.npz, cam1_json"):
        _clips_of(footage / "keypoints", footage / "videos")
    (footage / "keypoints" / "cam1.npz").rename(footage / "keypoints" / "cam12.npz")
    with pytest.raises(DataError, match=r"no video is called as cam12\.npz"):
        _clips_of(footage / "keypoints", footage / "videos")
    (footage / "keypoints" / "cam12.npz").unlink()
    shutil.rmtree(footage / "keypoints" / "cam1_json")
    with pytest.raises(DataError, match="the keypoints of cam1: none"):
        _clips_of(footage / "keypoints", footage / "videos")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--each", "--people"), "lists the people of one clip"),
        (("--jobs", "2"), "give folders of clips and --each"),
        (("--each", "--keypoints", "nowhere"), "no such folder"),
    ],
)
def test_options_of_many_clips_that_cannot_be_used(footage, monkeypatch, capsys, words, said):
    monkeypatch.chdir(footage)
    assert main(["fit", "videos", "--keypoints", "keypoints", "--out", "scenes", *words]) == 2
    assert said in capsys.readouterr().err
    assert main(["fit", "--each", "--out", "scenes"]) == 2
    assert "no folder of clips" in capsys.readouterr().err


def test_paths_of_options_are_the_same_where_workers_stand(footage, monkeypatch):
    asked = []
    monkeypatch.setattr(batch, "run_many", lambda function, *_, **__: asked.append(function) or batch.Batch({}, (), {}))
    monkeypatch.chdir(footage)
    options = {"--camera": "camera", "--prior": "prior", "--pose-prior": "pose_prior", "--initial": "initial"}
    fit_each(footage, *(word for option in options for word in (option, "a.npz")))
    assert {asked[0].keywords["how"][name] for name in options.values()} == {footage / "a.npz"}
