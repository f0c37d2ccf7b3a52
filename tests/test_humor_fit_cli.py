"""``python -m motionlab fit``: outputs, reports, Ctrl-C, input that cannot be used; real input and its comparison."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import walked
from PIL import Image
from walked import CAMERA, aside, few_steps, short_windows, table, write_camera, write_json, write_npz

from motionlab.__main__ import main
from motionlab.checkpoint import SHIPPED
from motionlab.footage import fit, scene_fit, scene_report
from motionlab.humor import body_shape, feedback_solver, pretrained, testops
from motionlab.humor.energies import RGB, RGB_LIGHT
from motionlab.io import bvh, gltf, smpl, video
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Observation2D, project
from motionlab.skeleton import BALLS, STANDARD

FRAMES = 8
FOOT = ("ankle", "heel", "big_toe", "small_toe")


@pytest.fixture(scope="module")
def walk() -> Motion:
    return walked.walk(FRAMES)


def seen(motion: Motion) -> Observation2D:
    """Perfect detections."""
    points = table(motion)[:, 0]
    return Observation2D(points[..., :2], points[..., 2], BODY_25, motion.fps, CAMERA)


@pytest.fixture
def keypoints(tmp_path, walk) -> Path:
    return write_json(tmp_path / "keypoints", table(walk))


def run(*words: object) -> int:
    return main(["fit", *map(str, words)])


def record(out: Path) -> dict:
    return json.loads((out / "fit.json").read_text())


@pytest.fixture
def few(monkeypatch) -> None:
    few_steps(monkeypatch, inner=4, closures=3)


def test_everything_is_written_and_said(tmp_path, keypoints, capsys):
    out, camera = tmp_path / "out", write_camera(tmp_path / "camera.json")
    assert run("--keypoints", keypoints, "--fps", 30, "--camera", camera, "--out", out, "--quick") == 0
    files = {"motion.npz", "motion.bvh", "scene.glb", "overlay.mp4", "report.html", "fit.json"}
    assert {path.name for path in out.iterdir()} == files and fit.is_finished(out)
    motions = [smpl.load_motion(out / "motion.npz"), bvh.load(out / "motion.bvh"), gltf.load(out / "scene.glb")]
    assert [m.frames for m in motions] == [FRAMES] * 3
    where = [m.positions[:, m.skeleton.indices(list(STANDARD.names))] for m in motions[1:]]
    assert (where[0] - where[1]).abs().max() < 1e-3
    balls = motions[0].positions[:, STANDARD.indices(BALLS), 2].amin(-1)
    assert balls.quantile(0.02) == pytest.approx(STANDARD.sole, abs=1e-3)  # on the standard body, on the floor
    said, bars = capsys.readouterr()
    assert "it/s" not in bars  # nobody watches: a line for each stage instead
    begun = [line.split(":")[0] for line in bars.splitlines() if line.endswith(" ...")]
    assert begun == ["is the camera still? ...", "stage 1 of 3", "stage 2 of 3", "stage 3 of 3", "film ..."]
    assert "not known whether" not in said  # the feet were seen
    for word in ("reprojection", "surprise of the prior", "AMASS", "camera given, and its place"):
        assert word in said
    found = record(out)
    person = found["people"][0]
    assert person["pixels"]["median"] < 20 and len(person["pixels"]["by_time"]) == FRAMES
    assert person["missing_by_joint"]["left_wrist"] == 0 and set(found["files"]) == files - {"fit.json"}
    assert torch.allclose(torch.tensor(found["camera"]["rotation"]), CAMERA.rotation, atol=1e-5)
    page = (out / "report.html").read_text()
    assert "<svg" in page and "overlay.mp4" in page and "http" not in page  # no network


def test_the_film_has_the_frames_of_the_images_and_lies_over_them(tmp_path, keypoints, few, capsys):
    pictures = tmp_path / "images"
    pictures.mkdir()
    for frame in range(FRAMES):
        Image.new("RGB", (640, 360), (200, 30 * frame, 40)).save(pictures / f"{frame}.png")
    out = tmp_path / "out"
    assert run(pictures, "--keypoints", keypoints, "--fps", 25, "--out", out, "--quick", "--size", "1280x720") == 0
    assert "camera assumed: focal length" in capsys.readouterr().out
    film = video.open_video(out / "overlay.mp4")
    shown = list(film.pictures(range(film.frames)))
    assert len(shown) == FRAMES and film.fps == 25
    corners = np.array([picture[-6, 6] for picture in shown], int)
    assert (np.abs(corners - [[200, 30 * frame, 40] for frame in range(FRAMES)]) < 25).all()


@pytest.mark.parametrize(
    "words, mode, solver, weights",
    [((), "lean", "shooting", RGB_LIGHT), (("--solver", "rollout"), "official", "rollout", RGB)],
)
def test_the_fast_solver_unless_the_original_schedule_is_asked_for(
    tmp_path, keypoints, monkeypatch, words, mode, solver, weights
):
    """The steps, unknowns and weights that a fit is given; it then takes few steps."""
    asked = {}

    class Track(testops._Track):
        def __init__(self, schedule, *rest):
            asked["schedule"] = schedule
            super().__init__(testops.Schedule.quick(), *rest)

        def motion_stage(self, problem, unknown, by):
            asked.update(mode=problem.mode, weights=problem.weights, solver=by)
            return super().motion_stage(problem, unknown, by)

    monkeypatch.setattr(testops, "_Track", Track)
    assert run("--keypoints", keypoints, "--fps", 30, "--out", tmp_path / "out", *words) == 0
    lean, official = scene_fit.FULL_WORK, testops.Schedule.official(keypoints=True)
    assert asked == {
        "mode": mode, "weights": weights, "solver": solver, "schedule": lean if mode == "lean" else official
    }  # fmt: skip
    assert official.steps == (30, 80, 70) and official.inner == 20 and official.refine == (30, 55)  # as published
    assert smpl.load_motion(tmp_path / "out" / "motion.npz").frames == FRAMES


def test_interrupted_fit_keeps_the_best_so_far(tmp_path, keypoints, capsys, monkeypatch):
    calls, terms = [], feedback_solver.rolled_terms

    def interrupted(*arguments, **options):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return terms(*arguments, **options)

    monkeypatch.setattr(feedback_solver, "rolled_terms", interrupted)
    out = tmp_path / "out"
    assert run("--keypoints", keypoints, "--fps", 30, "--out", out, "--quick") == 0
    assert smpl.load_motion(out / "motion.npz").frames == FRAMES
    assert "the best so far" in capsys.readouterr().out
    assert record(out)["stopped"] and not fit.is_finished(out)
    assert len(calls) < 10


def test_priors_from_files(tmp_path, keypoints, capsys, monkeypatch, few):
    """What the options say is what is loaded; an official prior without its pelvis is refused before the fit."""
    asked, real = [], pretrained.load_priors
    monkeypatch.setattr(pretrained, "load_priors", lambda **given: asked.append(given) or real(**given))
    shipped = {n: SHIPPED / f"{n}.safetensors" for n in ("humor_real", "pose_prior_real", "init_gmm_real")}
    options = ("--prior", "--pose-prior", "--initial")
    words = [word for pair in zip(options, shipped.values(), strict=True) for word in pair]
    common = ("--keypoints", keypoints, "--fps", 30, "--quick")
    assert run(*common, "--out", tmp_path / "out", *words) == 0
    assert list(asked[0].values()) == [*shipped.values(), None]
    torch.save({"model": {}}, tmp_path / "humor.pth")
    words = (*common, "--out", tmp_path / "other", "--prior", tmp_path / "humor.pth")
    assert run(*words) == 2
    assert "J_0" in capsys.readouterr().err
    assert run(*words, "--pelvis", "0", "-0.2", "0.1") == 2
    assert asked[2]["pelvis"] == (0.0, -0.2, 0.1)
    assert "no state dict" in capsys.readouterr().err and not (tmp_path / "other" / "fit.json").exists()


# ----------------------------------------------------------------------------------------- people, and long footage
def two_people(folder: Path, motion: Motion) -> Path:
    """One in all frames, and a second, 1.5 m to the left, who is there in the last four."""
    both = table(motion, aside(motion, -1.5, 0.5))
    both[:-4, 1, :, 2] = 0
    return write_npz(folder / "two.npz", both)


def test_people_are_listed_and_fitted_into_one_scene(tmp_path, walk, few, capsys):
    file, out = two_people(tmp_path, walk), tmp_path / "out"
    assert run("--keypoints", file, "--people") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:3]]
    assert [row[1:3] for row in rows] == [[str(FRAMES), "100.0"], ["4", "50.0"]]
    assert run("--keypoints", file, "--person", "all", "--quick", "--out", out) == 0
    found = record(out)
    ids = [row["id"] for row in found["people"]]
    assert len(ids) == 2 and [row["frames"] for row in found["keypoints"]["people"]] == [FRAMES, 4]
    motions = [bvh.load(out / f"motion_{each}.bvh") for each in ids]
    assert [m.frames for m in motions] == [FRAMES, FRAMES] and not (out / "motion.bvh").exists()
    apart = (motions[0].root - motions[1].root)[-1]
    assert apart[0] > 0.7  # side by side under one camera: the second stands to the left
    skins = [gltf.load(out / "scene.glb", person=k) for k in (0, 1)]
    for each, motion in zip(skins, motions, strict=True):
        assert (each.root - motion.root).abs().max() < 1e-3
    assert run("--keypoints", file, "--person", str(ids[1]), "--quick", "--out", out) == 0
    assert (out / "motion.bvh").exists() and not (out / f"motion_{ids[0]}.bvh").exists()  # what was there is replaced


@pytest.fixture
def windows(monkeypatch) -> None:
    """Several a clip, and no films: others look at these."""
    short_windows(monkeypatch)
    monkeypatch.setattr(fit.film, "over_footage", lambda motions, camera, pictures, path, *_, **__: path.touch())


def test_a_long_clip_stopped_in_the_middle_goes_on(tmp_path, windows, few, monkeypatch):
    """Ctrl-C in the second of three windows: the first is kept; a rerun fits two, and ends where a whole run does."""
    folder = write_json(tmp_path / "long", table(walked.walk(20)))
    whole, out, calls, real = tmp_path / "whole", tmp_path / "out", [], testops.fit
    common = ("--keypoints", folder, "--fps", 30, "--quick", "--out")
    assert run(*common, whole) == 0

    def counted(*arguments, **options):
        calls.append(1)
        if len(calls) == 3:  # the first is the camera's
            raise KeyboardInterrupt
        return real(*arguments, **options)

    monkeypatch.setattr(testops, "fit", counted)
    assert run(*common, out) == 130
    assert not fit.is_finished(out) and {*out.iterdir()} == {out / "windows"}
    assert len(list((out / "windows").iterdir())) == 1
    calls[:] = [1] * 4
    assert run(*common, out) == 0 and len(calls) == 4 + 3  # the camera and two windows
    assert not (out / "windows").exists() and record(out)["windows"] == 3
    with np.load(whole / "motion.npz") as a, np.load(out / "motion.npz") as b:
        assert all(np.array_equal(a[key], b[key]) for key in a)
    rows = [{**record(folder), "seconds": 0.0} for folder in (whole, out)]
    assert rows[0] == rows[1]


def test_the_floor_is_where_feet_rest_that_are_in_contact(walk):
    """One frame with the feet far below the others decides nothing; without contacts the lowest feet do."""
    up = torch.full((FRAMES,), 0.2)
    up[3] = 0.0
    own = replace(walk, root=walk.root + torch.stack((0 * up, 0 * up, up), -1), contacts=torch.zeros(FRAMES, 9))
    resting = own.contacts.clone()
    resting[:, [own.skeleton.contact_names.index(name) for name in BALLS]] = 1
    there = torch.ones(1, FRAMES, dtype=torch.bool)
    lifts = []
    for contacts in (resting, own.contacts):
        (moved,), camera, up = scene_fit._on_the_floor([replace(own, contacts=contacts)], there, CAMERA)
        pixels = [project(c, fit.landmarks_of(m))[0] for c, m in ((CAMERA, own), (camera, moved))]
        assert (pixels[0] - pixels[1]).abs().max() < 0.1  # the camera moves with the scene
        lifts.append(float(up[2]))
    assert lifts[0] < -0.17 and lifts[1] - lifts[0] > 0.1


@pytest.mark.parametrize("solver", ["shooting", "rollout"])
def test_somebody_who_leaves_and_returns(tmp_path, windows, few, solver):
    frames = table(walked.walk(26))
    frames[6:20, ..., 2] = 0
    folder = write_json(tmp_path / "keypoints", frames)
    found = fit.run_clip(folder, tmp_path / "out", fps=30, quick=True, solver=solver)
    assert found["windows"] == 4 and found["people"][0]["spans_s"] == [[0.0, 7 / 30], [19 / 30, 26 / 30]]
    assert bvh.load(tmp_path / "out" / "motion.bvh").frames == 26
    assert found["people"][0]["pixels"]["by_time"][10] is None


def test_windows_of_one_motion_are_joined_to_it(walk):
    """Two windows that agree give the motion back; bones that differ become their mean, the feet as high as before."""
    whole = walk.cut(0, 8)
    betas = body_shape.from_skeleton(walk.skeleton)
    parts = [
        {"start": at, "root": whole.root[at : at + 5], "rot": whole.rot[at : at + 5], "contacts": torch.ones(5, 9),
         "betas": betas} for at in (0, 3)
    ]  # fmt: skip
    same = scene_fit._joined(parts, 8, 30.0)
    own = replace(whole, skeleton=same.skeleton)
    assert (same.positions - own.positions).abs().max() < 1e-4 and same.contacts.all()
    parts[1]["betas"] = betas + 1.0
    low = scene_fit._joined(parts, 8, 30.0).positions[..., 2].amin(-1)
    assert (low[:3] - own.positions[:3, :, 2].amin(-1)).abs().max() < 1e-4


def test_keypoints_that_cannot_be_used(tmp_path, walk, capsys):
    frames = table(walk)
    short = write_json(tmp_path / "short", frames[:1])
    frames[..., scene_fit.USED, 2] = 0
    unused = write_json(tmp_path / "unused", frames)
    for folder, message in ((short, "one frame"), (unused, "shows 4 keypoints")):
        words = ("--keypoints", folder, "--layout", "BODY_25", "--fps", 30, "--out", tmp_path / "out", "--quick")
        assert run(*words) == 2
        said = capsys.readouterr().err
        assert message in said and "remedy" in said
        assert not (tmp_path / "out" / "fit.json").exists()


def test_options_that_cannot_be_used(tmp_path, keypoints, capsys):
    small = replace(CAMERA, width=640, height=360)
    pictures = tmp_path / "images"
    pictures.mkdir()
    (tmp_path / "empty.json").write_text('{"intrinsics": [[900, 0, 640], [0, 900, 360], [0, 0, 1]]}')
    (tmp_path / "text.mp4").write_text("no video")
    out = ("--out", tmp_path / "out")
    cases = {
        "detections lie outside": ("--camera", write_camera(tmp_path / "small.json", small), *out),
        "no width, height": ("--camera", tmp_path / "empty.json", *out),
        "0 images": (pictures, *out),
        "text.mp4": (tmp_path / "text.mp4", *out),
        "nobody has the id 7": ("--person", "7", *out),
        "give a folder, such as --out": ("--out", tmp_path / "fit.npz"),
        "name a folder": (),
    }
    for message, words in cases.items():
        assert run("--keypoints", keypoints, "--fps", 30, "--quick", *words) == 2
        said = capsys.readouterr().err
        assert message in said and "remedy" in said
    assert run("--keypoints", keypoints, *out) == 2
    assert "--fps" in capsys.readouterr().err  # which option says it
    Image.new("RGB", (640, 360)).save(pictures / "0.png")
    assert run(pictures, "--keypoints", keypoints, "--fps", 30, *out) == 2
    assert "1 frames, but the keypoints reach frame 7" in capsys.readouterr().err
    assert run(*out) == 2
    assert "--keypoints" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run("--keypoints", keypoints, "--size", "1280", *out)
    assert not list((tmp_path / "out").glob("*.*"))


# ------------------------------------------------------------------------------------------ what the record counts


def test_the_record_counts_only_what_was_seen(walk):
    observation = seen(walk)
    hidden = observation.confidence.clone()
    hidden[:, BODY_25.index("left_wrist")] = 0
    wrong = observation.keypoints.clone()
    wrong[:, BODY_25.index("left_wrist")] = 1e4
    wrong[:, BODY_25.index("right_knee")] += torch.tensor([3.0, 4.0])
    given = replace(observation, keypoints=wrong[None], confidence=hidden[None])
    there = torch.ones(1, FRAMES, dtype=torch.bool)
    found = scene_fit.SceneFit((walk,), there, given, CAMERA, torch.zeros(1), {}, 1, (), ())
    pixels = project(CAMERA, fit.landmarks_of(walk))[0][None]
    away, weight = fit.pixel_distances(pixels, given)
    row = scene_report.person_row(0, 7, found, away[0], weight[0])
    assert row["pixels"]["mean"] == pytest.approx(5 / 21, abs=1e-3)
    assert row["pixels"]["median"] < 0.01 and row["pixels"]["by_joint"]["right_knee"] == pytest.approx(5, abs=1e-2)
    assert scene_report.not_known(row) == []
    hidden[:, [BODY_25.index(f"{side}_{part}") for side in ("left", "right") for part in FOOT]] = 0
    unseen = replace(found, seen=replace(given, confidence=hidden[None]))
    said = scene_report.not_known(scene_report.person_row(0, 7, unseen, away[0], weight[0]))
    assert len(said) == 1 and "0 % of the frames" in said[0]
    assert row["detected"] == pytest.approx(21 / 22) and row["missing_by_joint"]["left_wrist"] == 1
