"""What every writer promises: the file whole or not at all, and only what can be read again."""

import os
from dataclasses import replace

import pytest
import torch

from motionlab.errors import DataError, ShapeError
from motionlab.files import write_whole
from motionlab.io import bvh, gltf, smpl
from suite.findings import Record, save_record
from tests.figures import standing

SAVERS = {".bvh": bvh.save, ".npz": smpl.save_motion, ".glb": gltf.save}


@pytest.mark.parametrize("suffix", SAVERS)
def test_numbers_that_no_reader_takes_are_not_written(tmp_path, suffix):
    path, motion = tmp_path / f"a{suffix}", standing()
    holed = motion.root.clone()
    holed[1, 2] = torch.nan
    with pytest.raises(DataError, match=r"frame 1.*finite.*remedy"):
        SAVERS[suffix](path, replace(motion, root=holed))
    with pytest.raises(ShapeError, match="without frames"):
        SAVERS[suffix](path, motion.cut(0, 0))
    with pytest.raises(ShapeError, match="one clip"):
        SAVERS[suffix](path, replace(motion, root=motion.root[None], rot=motion.rot[None]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SAVERS)
def test_a_place_that_cannot_be_written_is_named(tmp_path, suffix):
    folder = tmp_path / f"folder{suffix}"
    folder.mkdir()
    for path in (tmp_path / "nowhere" / f"a{suffix}", folder):
        with pytest.raises(DataError, match=r"cannot be written.*remedy") as caught:
            SAVERS[suffix](path, standing())
        assert caught.value.path == path
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.skipif(os.name != "posix", reason="permission bits are POSIX's")
@pytest.mark.parametrize("suffix", SAVERS)
def test_others_may_read_what_an_ordinary_file_would_let_them(tmp_path, suffix):
    (tmp_path / "ordinary").touch()
    SAVERS[suffix](tmp_path / f"a{suffix}", standing())
    assert (tmp_path / f"a{suffix}").stat().st_mode == (tmp_path / "ordinary").stat().st_mode


@pytest.mark.parametrize("how", [*({"unit": unit} for unit in ("ell", 0, -1.0, float("nan"))), {"order": "XXY"}])
def test_bvh_in_no_known_unit_or_order_is_refused(tmp_path, how):
    with pytest.raises(ValueError, match=next(iter(how))):
        bvh.save(tmp_path / "a.bvh", standing(), **how)
    assert not list(tmp_path.iterdir())


class Unwell(Exception):
    """Not an OSError: whatever interrupts a writer."""


def test_a_name_that_no_file_can_have_is_refused_in_words(tmp_path):
    with pytest.raises(DataError, match="name too long"):
        write_whole(tmp_path / f"{'x' * 300}.bvh", "new")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), Unwell()])
@pytest.mark.parametrize("write", [lambda p: write_whole(p, "new"), lambda p: save_record(p, Record("01", "x", ()))])
def test_the_old_file_stays_whole_when_writing_fails(tmp_path, monkeypatch, write, failure):
    path = tmp_path / "a.json"
    path.write_text("old")

    def half(self, content):
        with self.open("wb") as file:
            file.write(content[: len(content) // 2])
        raise failure

    monkeypatch.setattr("pathlib.Path.write_bytes", half)
    with pytest.raises(DataError if isinstance(failure, OSError) else Unwell):
        write(path)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
