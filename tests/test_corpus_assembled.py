"""The corpus of recordings: parsed once, kept whole or not at all, and honest about what it leaves out."""

import os
import shutil
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from safetensors.torch import save_file

from data_synth.actions import walk
from data_synth.subjects import SUBJECTS
from motionlab import checkpoint, corpus
from motionlab.errors import DataError, MissingData
from motionlab.io import bvh, recordings
from motionlab.motion import Motion
from studies.nb01_data.real_motion import kind_of


def performed(index: int, fps: float) -> Motion:
    """The same performance at any rate."""
    return walk(SUBJECTS[index], torch.Generator().manual_seed(index), seconds=3.0, fps=fps).motion


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    """Two walks and one with a teleport in the middle, as BVH at 24 frames per second."""
    place = tmp_path_factory.mktemp("texts")
    first = performed(0, 24.0)
    away = (torch.arange(first.frames) >= 40)[:, None] * torch.tensor([3.0, 0.0, 0.0])
    for name, motion in (("a", first), ("b", performed(1, 24.0)), ("c", replace(first, root=first.root + away))):
        bvh.save(place / name, motion)
    return {name: (place / name).read_text() for name in "abc"}


@pytest.fixture
def folder(tmp_path, texts):
    """mine/ann (for training) walks, mine/carla (validation) walks, too."""
    for who, name in (("ann", "a"), ("carla", "b")):
        put(tmp_path / "all", f"mine/{who}/walk_{name}.bvh", texts[name])
    return tmp_path / "all"


def put(folder: Path, file: str, content: str | bytes) -> Path:
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def assemble(folder, **how):
    return corpus.assemble(folder, kept=folder.parent / "kept", progress=False, **how)


@pytest.fixture
def loaded(monkeypatch):
    """Names of the files that were parsed, in their order."""
    names, load = [], recordings.io.LOADERS[".bvh"]
    monkeypatch.setitem(recordings.io.LOADERS, ".bvh", lambda path: (names.append(path.name), load(path))[1])
    return names


def same(one, two):
    """Two corpora with the same takes, to the bit."""
    labels = attrgetter("name", "person", "said", "fps", "missing")
    numbers = attrgetter("motion.root", "motion.rot", "motion.contacts")
    pairs = list(zip(one.takes, two.takes, strict=True))
    alike = all(labels(a) == labels(b) and all(map(torch.equal, numbers(a), numbers(b))) for a, b in pairs)
    return alike and one.rows == two.rows


# ------------------------------------------------------------------------------------------------ what comes out
def test_takes_are_the_performances_at_thirty_frames_with_contacts(folder):
    found = assemble(folder)
    for index, take in enumerate(found.takes):
        truth = performed(index, 30.0)  # never seen at 24
        frames = min(truth.frames, take.motion.frames)
        assert take.motion.fps == 30 and truth.frames - frames <= 1 and take.fps == pytest.approx(24.0)
        error = (take.motion.positions[:frames] - truth.positions[:frames]).norm(dim=-1)
        assert error.mean() < 0.002 and error.max() < 0.02
        hit = (take.motion.contacts[:frames] * truth.contacts[:frames]).sum()
        assert 2 * hit / (take.motion.contacts.sum() + truth.contacts.sum()) > 0.9
        assert take.motion.skeleton.sole == pytest.approx(truth.skeleton.sole, rel=0.1)
    assert [(t.name, t.person, t.part, t.said) for t in found.takes] == [
        ("mine/ann/walk_a from 0.0 s", "mine/ann", "train", "walk_a"),
        ("mine/carla/walk_b from 0.0 s", "mine/carla", "val", "walk_b"),
    ]


def test_faults_are_cut_and_counted(folder, texts):
    put(folder, "mine/dora/c.bvh", texts["c"])
    found = assemble(folder)
    (row,) = found.rows
    assert len(found.part("test")) == 2 and 0.2 < row.cut["teleport"] < 0.4 and row.recordings == 3
    assert row.kept + sum(row.cut.values()) == pytest.approx(row.seconds)
    assert row.kept == pytest.approx(sum(t.motion.seconds for t in found.takes))
    with pytest.raises(ValueError, match="train, val, test, got 'report'"):
        found.part("report")


def test_descriptions_say_what_is_done(folder, loaded):
    """A file without one is described by its name."""
    head = "id\tseconds\tdescription\n"
    put(folder, "mine/index.tsv", head + "walk_a\t3\tSalsa dance\n")
    found = assemble(folder).takes
    assert [(t.said, kind_of(t)) for t in found] == [("Salsa dance", "dance"), ("walk_b", "walk")]
    put(folder, "mine/index.tsv", head + "walk_a\t3\tclimb 3 steps\nwalk_b\t3\t\n")
    assert [(t.said, kind_of(t)) for t in assemble(folder).takes] == [("climb 3 steps", "climb"), ("", "other")]
    assert len(loaded) == 4  # the index is a part of what is kept
    for index in ("id\tseconds\nwalk_a\t3\n", "\0\1\2", b"\xff\xfe", "description\nwalk\n", ""):
        put(folder, "mine/index.tsv", index)
        assert {t.said for t in assemble(folder).takes} <= {"walk_a", "walk_b", ""}
    put(folder, "mine/index.tsv", head + 'walk_a\t3\t"' + "x" * 200_000)
    with pytest.raises(DataError, match=r"index\.tsv.*repair it, or take it away"):
        assemble(folder)


def test_repeated_takes_are_left_out_and_counted(folder, texts):
    before = assemble(folder)
    put(folder, "mine/ann/again.bvh", texts["a"])
    found = assemble(folder)
    assert len(found.takes) == 2 and found.rows[0].recordings == 3
    assert found.rows[0].kept == pytest.approx(before.rows[0].kept)
    assert found.rows[0].cut["repeated"] == pytest.approx(next(t.motion.seconds for t in before.takes))


# -------------------------------------------------------------------------------------------------- parsed once
def test_a_second_call_parses_nothing(folder, loaded):
    made = assemble(folder)
    assert loaded == ["walk_a.bvh", "walk_b.bvh"]
    assert same(made, assemble(folder)) and len(loaded) == 2
    assert len(assemble(folder, every=2).takes) == 1 and len(loaded) == 3


def test_only_a_source_that_changes_is_parsed_again(folder, texts, loaded):
    put(folder, "yours/dora/c.bvh", texts["c"])
    before = assemble(folder)
    loaded.clear()
    path = put(folder, "mine/carla/walk_b.bvh", texts["b"].replace("Frame Time: 0.04", "Frame Time: 0.05"))
    os.utime(path, ns=(1, 1))
    found = assemble(folder)
    assert loaded == ["walk_a.bvh", "walk_b.bvh"]
    assert found.takes[1].motion.seconds > 1.2 * before.takes[1].motion.seconds
    shutil.rmtree(folder / "mine" / "carla")
    assert len(assemble(folder).takes) == 3 and loaded[2:] == ["walk_a.bvh"]


# -------------------------------------------------------------------------------------------------- bad recordings
def line(text, at, change):
    """The BVH with one line of its frames changed."""
    lines = text.splitlines()
    lines[lines.index("MOTION") + at] = change(lines[lines.index("MOTION") + at])
    return "\n".join(lines) + "\n"


BAD = {
    "cut off": lambda text: text[: 2 * len(text) // 3],
    "binary": lambda text: bytes(range(256)) * 20,
    "empty": lambda text: "",
    "no number": lambda text: line(text, 20, lambda row: f"nan {row.split(' ', 1)[1]}"),
    "huge": lambda text: line(text, 20, lambda row: f"1e30 {row.split(' ', 1)[1]}"),
    "no body": lambda text: text.replace("left_", "a").replace("right_", "b"),
    "eternal": lambda text: line(text, 2, lambda row: "Frame Time: 90000"),  # at 30 fps, more than memory holds
}


def test_damaged_recordings_are_named_and_counted(folder, texts):
    clean = assemble(folder)
    for kind, spoil in BAD.items():  # of one name, and yet so many
        put(folder, f"mine/{kind}/bad.bvh", spoil(texts["a"]))
    found = assemble(folder)
    (row,) = found.rows
    assert set(row.refused) == {f"mine/{kind}/bad.bvh" for kind in BAD} and row.recordings == 2 + len(BAD)
    assert all("remedy" not in why and "bad.bvh" not in why and len(why) > 10 for why in row.refused.values())
    assert "  refused 1: the file is empty" in found.report() and "    mine/binary/bad.bvh" in found.report()
    assert len(found.takes) == 2 and row.kept == clean.rows[0].kept and row.seconds == clean.rows[0].seconds


def test_numbers_that_nobody_reaches_are_cut(folder, texts):
    put(folder, "mine/ann/far.bvh", line(texts["a"], 40, lambda row: f"1e17 {row.split(' ', 1)[1]}"))
    found = assemble(folder)
    assert not found.rows[0].refused and found.rows[0].cut["teleport"] > 0.2
    assert all(t.motion.root.abs().max() < 10 for t in found.takes)


def test_folders_with_nothing_to_learn_from(tmp_path, folder, texts):
    put(folder, "notes/read.me", "no recording")
    assert len(assemble(folder).takes) == 2  # what holds none is passed over, unless it is asked for
    with pytest.raises(MissingData, match="any recording in"):
        assemble(folder, sources=["notes"])
    with pytest.raises(MissingData, match=r"source 'other'.*There are: mine, notes"):
        assemble(folder, sources=["other"])
    with pytest.raises(MissingData, match="nowhere is missing"):
        assemble(tmp_path / "nowhere")
    put(tmp_path / "bad", "mine/ann/a.bvh", "")
    with pytest.raises(MissingData, match=r"usable motion .*1 recordings are refused, such as mine/ann/a.bvh: .*empty"):
        assemble(tmp_path / "bad")
    bvh.save(put(tmp_path / "short", "mine/ann/a.bvh", ""), performed(0, 24.0).cut(0, 20))
    with pytest.raises(MissingData, match="longer recordings"):
        assemble(tmp_path / "short")


# ------------------------------------------------------------------------------------------------ kept whole
def half_written(path, content):
    """A process that is killed while it writes."""
    path.with_name(f".{path.name}.1.part").write_bytes(content[: len(content) // 2])
    raise KeyboardInterrupt


@pytest.mark.parametrize("where", ["loader", "write", "rename"])
def test_a_kill_leaves_nothing_that_a_later_call_would_read(folder, tmp_path, monkeypatch, loaded, where):
    whole = corpus.assemble(folder, kept=tmp_path / "other", progress=False)
    loaded.clear()

    stop = Mock(side_effect=KeyboardInterrupt)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        if where == "loader":
            load = recordings.io.LOADERS[".bvh"]
            patch.setitem(recordings.io.LOADERS, ".bvh", lambda path: stop() if "b" in path.stem else load(path))
        elif where == "write":
            patch.setattr(checkpoint, "write_whole", half_written)
        else:
            patch.setattr(Path, "replace", stop)
        assemble(folder)
    assert not [path for path in (folder.parent / "kept").iterdir() if path.suffix == ".safetensors"]
    loaded.clear()
    assert same(assemble(folder), whole) and len(loaded) == 2
    assert same(assemble(folder), whole) and len(loaded) == 2


@pytest.mark.parametrize("damage", ["half", "empty", "text", "bit", "label", "bare"])
def test_a_damaged_kept_file_is_made_again(folder, loaded, damage):
    whole = assemble(folder)
    (kept,) = (folder.parent / "kept").iterdir()
    content = kept.read_bytes()
    kept.unlink()  # the corpus that was made of it has it mapped
    if damage == "bare":
        save_file({"root": torch.zeros(3, 3)}, kept)
    else:
        changed = {
            "half": content[: len(content) // 2], "empty": b"", "text": b"not what it was",
            "bit": content[:-5000] + bytes([content[-5000] ^ 1]) + content[-4999:],
            "label": content.replace(b"walk_a", b"walk_x"),
        }  # fmt: skip
        kept.write_bytes(changed[damage])
    assert same(assemble(folder), whole) and len(loaded) == 4
    assert same(assemble(folder), whole) and len(loaded) == 4
