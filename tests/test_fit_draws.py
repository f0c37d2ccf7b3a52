"""``fit --draws``: other motions that explain what was seen, in the files and the report of a fit."""

import pytest
from walked import few_steps, table, walk, write_npz

from motionlab.errors import DataError
from motionlab.footage import fit, scene_fit, scene_report
from motionlab.io import gltf
from motionlab.observation import BODY_25

FRAMES, DRAWS = 8, 3
LEGS = [n for n, name in enumerate(BODY_25) if any(part in name for part in ("knee", "ankle", "toe", "heel"))]


@pytest.fixture(autouse=True)
def few(monkeypatch) -> None:
    few_steps(monkeypatch)
    monkeypatch.setattr(scene_fit, "FULL_WORK", scene_fit.QUICK_WORK)


def hidden_legs(folder):
    """Keypoints of somebody who walks behind a table."""
    seen = table(walk(FRAMES))
    seen[:, :, LEGS, 2] = 0.0
    return write_npz(folder / "walk.npz", seen)


def test_draws_are_in_the_files_the_film_and_the_report(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_report, "MAX_LATENT_CHI2", 1e9)
    monkeypatch.setattr(scene_report, "MISFIT_WIDTH", 1e9)
    drawn = []
    real = fit.film.over_footage
    monkeypatch.setattr(fit.film, "over_footage", lambda *a, **k: drawn.append(k["ghosts"]) or real(*a, **k))
    out = tmp_path / "out"
    found = fit.run_clip(hidden_legs(tmp_path), out, draws=DRAWS)
    said = found["people"][0]["open"]
    assert any(line.startswith("left knee, 0.0 to 0.2 s: ") and line.endswith(" cm at 90 %") for line in said)
    assert said[0] in (out / "report.html").read_text() and "draws.glb" in found["files"]
    motions = [gltf.load(out / "draws.glb", person=k) for k in range(DRAWS)]
    assert all(motion.frames == FRAMES for motion in motions)
    places, hidden = drawn[0][0]
    assert places.shape == (DRAWS, FRAMES, 22, 2) and bool(hidden[:, 4].all())
    knees = [motion.positions[:, motion.skeleton.names.index("left_knee")] for motion in motions]
    assert (knees[0] - knees[1]).norm(dim=-1).mean() > 1e-3  # they differ
    without = fit.run_clip(hidden_legs(tmp_path), tmp_path / "none")
    assert "open" not in without["people"][0] and "draws.glb" not in without["files"]


def test_of_a_doubtful_fit_nothing_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_report, "MAX_LATENT_CHI2", -1.0)
    found = fit.run_clip(hidden_legs(tmp_path), tmp_path / "out", draws=DRAWS)
    assert found["people"][0]["open"] == ["no other motions are drawn: the fit is doubtful"]
    assert "draws.glb" not in found["files"]


@pytest.mark.parametrize("how", [{"quick": True}, {"solver": "rollout"}, {"draws": fit.DRAWS + 1}, {"draws": -1}])
def test_what_cannot_be_drawn_is_refused_before_the_fit(tmp_path, how):
    with pytest.raises(DataError, match="draws"):
        fit.run_clip(hidden_legs(tmp_path), tmp_path / "out", **({"draws": 4} | how))
