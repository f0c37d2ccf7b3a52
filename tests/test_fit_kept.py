"""What ``fit`` keeps when it is stopped or the film cannot be drawn, and which folders count as finished."""

import errno
import json
import os
import re
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from walked import CAMERA, few_steps, short_windows, table, walk, write_json, write_npz

from motionlab.errors import DataError
from motionlab.footage import fit, scene_fit, scene_report
from motionlab.humor import testops
from motionlab.humor.priors import InitGmm
from motionlab.io import smpl
from motionlab.observation import BODY_25, Observation2D
from motionlab.viz.palette import ROLE

LONG, SHORT = 20, 6


@pytest.fixture(autouse=True)
def few(monkeypatch) -> None:
    few_steps(monkeypatch)
    short_windows(monkeypatch)


def keypoints(folder: Path, frames: int) -> Path:
    return write_npz(folder / f"walk{frames}.npz", table(walk(frames)))


def record(out: Path) -> dict:
    return json.loads((out / fit.RESULT).read_text())


def spoil(monkeypatch, error: BaseException):
    """The film ends in an error; gives how to undo that."""
    drawn = fit.film.over_footage

    def broken(motions, camera, pictures, path, *arguments, **options):
        assert (path.parents[1] / "scene.glb").exists()  # the fit is in its place before a film is begun
        path.write_bytes(b"half a film")
        raise error

    monkeypatch.setattr(fit.film, "over_footage", broken)
    return lambda: monkeypatch.setattr(fit.film, "over_footage", drawn)


no_fit = Mock(side_effect=AssertionError("fitted again"))


def test_windows_stay_until_the_film_of_long_footage_is_drawn(tmp_path, monkeypatch):
    file, out = keypoints(tmp_path, LONG), tmp_path / "out"
    mend = spoil(monkeypatch, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        fit.run_clip(file, out, quick=True)
    assert smpl.load_motion(out / "motion.npz").frames == LONG and "the film is not drawn yet" in record(out)["notes"]
    assert len(list((out / "windows").iterdir())) == record(out)["windows"] == 3 and not fit.is_finished(out)
    mend()
    fits, real = [], testops.fit
    monkeypatch.setattr(testops, "fit", lambda *a, **k: fits.append(1) or real(*a, **k))
    assert fit.run_clip(file, out, quick=True)["finished"] and fit.is_finished(out)
    assert len(fits) == 1  # for the camera; no window is fitted again
    assert (out / "overlay.mp4").exists() and not (out / "windows").exists()


def test_a_film_that_cannot_be_drawn_is_a_note(tmp_path, monkeypatch):
    file, out = keypoints(tmp_path, SHORT), tmp_path / "out"
    fit.run_clip(file, out, quick=True)
    assert (out / "overlay.mp4").exists()
    spoil(monkeypatch, RuntimeError("bad X server connection"))
    found = fit.run_clip(file, out, quick=True)
    assert "the film could not be drawn: RuntimeError: bad X server connection" in found["notes"]
    assert {path.name for path in out.iterdir()} == {*found["files"], fit.RESULT}
    assert not (out / "overlay.mp4").exists() and smpl.load_motion(out / "motion.npz").frames == SHORT
    assert found["notes"] == record(out)["notes"] and "the film is not drawn yet" not in found["notes"]
    assert fit.is_finished(out)  # the same call would not draw it either
    page = (out / "report.html").read_text()
    assert "<video" not in page and "Dots are detections" not in page and "There is no film" in page


# ----------------------------------------------------------------------------------------------- what was asked
def test_a_folder_is_finished_only_for_the_options_it_was_made_with(tmp_path, monkeypatch):
    file, out = keypoints(tmp_path, SHORT), tmp_path / "out"
    fit.run_clip(file, out, quick=True, person="all")
    made = {"keypoints": file, "quick": True, "person": "all"}
    assert fit.is_finished(out) and fit.is_finished(out, made | {"camera": None})
    others = {"quick": False, "person": "longest", "solver": "rollout", "fps": 25.0, "size": (640, 480)}
    others |= {name: tmp_path / "other" for name in ("camera", "prior", "pose_prior", "initial", "video")}
    others |= {"layout": "COCO_17", "camera_name": "left", "pelvis": [0.0, 0.0, 0.0]}
    for name, value in others.items():
        assert not fit.is_finished(out, made | {name: value}), name


def test_a_folder_is_not_finished_once_the_keypoints_are_newer(tmp_path):
    folder, out = write_json(tmp_path / "seen", table(walk(SHORT))), tmp_path / "out"
    made = {"keypoints": folder, "fps": 30, "quick": True}
    fit.run_clip(out=out, **made)
    assert fit.is_finished(out, made) and not fit.is_finished(tmp_path / "none", made)
    later = (out / fit.RESULT).stat().st_mtime + 10
    os.utime(max(folder.iterdir()), (later, later))
    assert not fit.is_finished(out, made) and fit.is_finished(out)


def test_a_window_is_kept_under_all_that_goes_into_its_fit(kit):
    seen = Observation2D(torch.zeros(1, 8, 25, 2), torch.ones(1, 8, 25), BODY_25, 30.0, CAMERA)
    first = kit.initial
    moved = InitGmm(first.weights, first.means + 1, first.covariances)
    both = (scene_fit.SceneFitConfig(priors) for priors in (kit, replace(kit, initial=moved)))
    names = {scene_fit._key(seen, CAMERA, config) for config in both}
    assert len(names) == 2


def test_the_report_says_who_has_which_colour_and_how_many_are_not_listed(tmp_path, monkeypatch):
    drawn = {}

    def film(motions, camera, pictures, path, *_, roles, **__):
        drawn["roles"] = roles
        raise RuntimeError("no film")

    monkeypatch.setattr(fit.film, "over_footage", film)
    found = fit.run_clip(keypoints(tmp_path, SHORT), tmp_path / "out", quick=True)
    person, seen = found["people"][0], found["keypoints"]["people"][0]
    crowd = {**found["keypoints"], "people": [seen | {"person": k} for k in range(45)]}
    page = scene_report.page(found | {"people": [person | {"id": k} for k in range(9)], "keypoints": crowd})
    assert "<p>and 5 more</p>" in page and "more</p>" not in (tmp_path / "out" / "report.html").read_text()
    marks = re.findall(r'color: (#\w+)">&#9679;</span> Person (\d)<', page)
    assert [int(k) for _, k in marks] == [*range(9)] and marks[0][0] == marks[8][0]
    assert len({ink for ink, _ in marks}) == 8 and marks[0][0] == ROLE[drawn["roles"][0]]  # as in the film
    assert page.count(f'fill="{marks[1][0]}">person 1<') == 1  # and in the chart


# ------------------------------------------------------------------------------------------------- where it is written
@pytest.mark.parametrize("name", ["report.html", "scene.glb", "motion.bvh", "fit.json", "overlay.mp4"])
def test_files_that_no_fit_wrote_are_not_overwritten(tmp_path, monkeypatch, name):
    file, out = keypoints(tmp_path, SHORT), tmp_path / "out"
    out.mkdir()
    (out / name).write_text('{"mine": 1}')
    with monkeypatch.context() as patch:
        patch.setattr(fit, "fit_people", no_fit)
        with pytest.raises(DataError, match=f"{name} would be overwritten") as caught:
            fit.run_clip(file, out, quick=True)
    assert "--out" in caught.value.remedy and (out / name).read_text() == '{"mine": 1}'
    (out / name).rename(out / "mine.html")
    spoil(monkeypatch, RuntimeError("no film"))
    for _ in range(2):  # control: those of an earlier fit are
        fit.run_clip(file, out, quick=True)
    assert (out / "mine.html").exists()


def test_what_cannot_be_written_is_said_in_a_sentence(tmp_path, monkeypatch):
    file, out = keypoints(tmp_path, SHORT), tmp_path / "out"
    monkeypatch.setattr(fit.gltf, "save", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(DataError, match="cannot be written: No space left on device"):
        fit.run_clip(file, out, quick=True)
    assert not list(out.glob("*.*"))
    monkeypatch.setattr(fit, "fit_people", no_fit)
    refused = Mock(side_effect=OSError(errno.EROFS, "Read-only file system"))
    monkeypatch.setattr(tempfile, "TemporaryFile", refused)
    with pytest.raises(DataError, match="cannot be written: Read-only file system") as caught:
        fit.run_clip(file, out, quick=True)
    assert "--out" in caught.value.remedy


def test_a_cut_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_fit, "MAX_FRAMES", 120)  # one window, not twenty
    draw = np.random.default_rng(0)
    walls = [draw.integers(0, 255, (45, 80, 3), np.uint8).repeat(4, 0).repeat(4, 1) for _ in range(2)]
    imageio.mimwrite(tmp_path / "clip.mp4", [walls[n >= 24] for n in range(48)], fps=12, quality=9)
    spoil(monkeypatch, RuntimeError("no film"))
    file = keypoints(tmp_path, 48)
    found = fit.run_clip(file, tmp_path / "out", video=tmp_path / "clip.mp4", fps=12, quick=True)
    assert found["moving_camera"]["moved"] and found["moving_camera"]["cuts_s"] == [2.0]
    assert any("THE FILM IS CUT before 2.0 s" in line for line in scene_report.lines(found))
