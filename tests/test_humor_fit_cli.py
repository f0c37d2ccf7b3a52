"""``python -m motionlab fit``: outputs, reports, Ctrl-C, input that cannot be used; real input and its comparison."""

import json
import signal
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
import torch
from PIL import Image

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import fit
from motionlab.__main__ import main
from motionlab.checkpoint import SHIPPED
from motionlab.errors import DataError
from motionlab.humor import body_shape, pretrained, stages, testops
from motionlab.humor.energies import RGB, RGB_LIGHT
from motionlab.humor.shooting.feedback_solver import Plan
from motionlab.io import amass, bvh, gltf
from motionlab.io.cameras import load_camera
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D, at_rate, look_at, project
from motionlab.skeleton import STANDARD

CAMERA = look_at(torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9]), focal=900.0, width=1280, height=720)
FRAMES = 8


@pytest.fixture(scope="module")
def walk() -> Motion:
    motion = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(4)).motion.cut(20, 20 + FRAMES)
    return replace(motion, root=motion.root - motion.root[:1] * torch.tensor([1.0, 1.0, 0.0]))


def seen(motion: Motion) -> Observation2D:
    """Perfect detections."""
    pixels, _ = project(CAMERA, fit.landmarks_of(motion))
    return Observation2D(pixels, torch.ones(pixels.shape[:-1]), BODY_25, motion.fps, CAMERA)


def write_json(folder: Path, keypoints: torch.Tensor, confidence: torch.Tensor, first: int = 0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    table = torch.cat((keypoints, confidence[..., None]), -1).flatten(1)
    for frame, row in enumerate(table.tolist(), start=first):
        people = [{"pose_keypoints_2d": row}] if any(row[2::3]) else []
        (folder / f"view_{frame:04d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": people}))
    return folder


def write_camera(path: Path, camera: Camera = CAMERA, *, placed: bool = True) -> Path:
    content = {"intrinsics": camera.intrinsics.tolist(), "width": camera.width, "height": camera.height}
    if placed:
        content |= {"rotation": camera.rotation.tolist(), "translation": camera.translation.tolist()}
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def keypoints(tmp_path, walk) -> Path:
    observation = seen(walk)
    return write_json(tmp_path / "keypoints", observation.keypoints, observation.confidence)


def run(*words: object) -> int:
    return main(["fit", *map(str, words)])


def test_everything_is_written_and_said(tmp_path, keypoints, capsys):
    out = {suffix: tmp_path / f"fit.{suffix}" for suffix in ("npz", "bvh", "glb", "gif")}
    camera = write_camera(tmp_path / "camera.json")
    words = ("--camera", camera, "--out", out["npz"], "--bvh", out["bvh"], "--glb", out["glb"], "--video", "--quick")
    assert run("--keypoints", keypoints, *words) == 0
    motions = [amass.load(out["npz"]), bvh.load(out["bvh"]), gltf.load(out["glb"])]
    assert [m.frames for m in motions] == [FRAMES] * 3
    where = [m.positions[:, m.skeleton.indices(list(STANDARD.names))] for m in motions[1:]]
    assert (where[0] - where[1]).abs().max() < 1e-3
    with Image.open(out["gif"]) as film:
        assert film.n_frames == FRAMES // 2 and film.width == 480
    said = capsys.readouterr().out
    for word in ("reprojection", "acceleration", "contacts", "energy after stage 3", "joints2d"):
        assert word in said
    assert "assumed" not in said


def test_assumed_camera_is_said_and_images_lie_below(tmp_path, keypoints, capsys):
    pictures = tmp_path / "images"
    pictures.mkdir()
    for frame in range(FRAMES):
        Image.new("RGB", (640, 360), (200, 30 * frame, 40)).save(pictures / f"{frame:03d}.png")
    assert run("--keypoints", keypoints, "--out", tmp_path / "fit.npz", "--video", pictures, "--quick") == 0
    assert "camera assumed: focal length" in capsys.readouterr().out
    with Image.open(tmp_path / "fit.gif") as film:
        corner = film.convert("RGB").getpixel((2, 2))
    assert corner[0] > 150 and corner[2] < 90  # the picture, not the grey canvas


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
    assert run("--keypoints", keypoints, "--out", tmp_path / "fit.npz", *words) == 0
    lean, official = testops.Schedule.lean(), testops.Schedule.official(keypoints=True)
    assert asked == {
        "mode": mode, "weights": weights, "solver": solver, "schedule": lean if mode == "lean" else official
    }  # fmt: skip
    assert official.steps == (30, 80, 70) and official.inner == 20 and official.refine == (30, 55)  # as published
    assert amass.load(tmp_path / "fit.npz").frames == FRAMES


def test_interrupted_fit_keeps_the_best_so_far(tmp_path, keypoints, capsys, monkeypatch):
    calls, terms = [], stages.motion_terms

    def interrupted(*arguments, **options):
        calls.append(1)
        if len(calls) == 4:
            signal.raise_signal(signal.SIGINT)
        return terms(*arguments, **options)

    monkeypatch.setattr(stages, "motion_terms", interrupted)
    assert run("--keypoints", keypoints, "--out", tmp_path / "fit.npz", "--quick") == 0
    assert amass.load(tmp_path / "fit.npz").frames == FRAMES
    assert "interrupted" in capsys.readouterr().out
    assert len(calls) < 10


def test_priors_from_files(tmp_path, keypoints, capsys, monkeypatch):
    """What the options say is what is loaded; an official prior without its pelvis is refused before the fit."""
    asked, real = [], pretrained.load_priors
    monkeypatch.setattr(pretrained, "load_priors", lambda **given: asked.append(given) or real(**given))
    few = testops.Schedule(steps=(1, 1, 1), inner=2, shooting=Plan(rounds=1, closures=2, leaps=0, trial=0))
    monkeypatch.setattr(testops.Schedule, "quick", lambda: few)
    shipped = {n: SHIPPED / f"{n}.safetensors" for n in ("humor_compact", "pose_prior_compact", "init_gmm_compact")}
    options = ("--prior", "--pose-prior", "--initial")
    words = [word for pair in zip(options, shipped.values(), strict=True) for word in pair]
    assert run("--keypoints", keypoints, "--out", tmp_path / "fit.npz", "--quick", *words) == 0
    assert list(asked[0].values()) == [*shipped.values(), None]
    torch.save({"model": {}}, tmp_path / "humor.pth")
    words = ("--keypoints", keypoints, "--out", tmp_path / "other.npz", "--quick", "--prior", tmp_path / "humor.pth")
    assert run(*words) == 2
    assert "J_0" in capsys.readouterr().err
    assert run(*words, "--pelvis", "0", "-0.2", "0.1") == 2
    assert asked[2]["pelvis"] == (0.0, -0.2, 0.1)
    assert "no state dict" in capsys.readouterr().err and not (tmp_path / "other.npz").exists()


def nobody(folder: Path, at: Observation2D) -> None:
    write_json(folder, at.keypoints, torch.zeros_like(at.confidence))


def only_hips(folder: Path, at: Observation2D) -> None:
    hips = torch.zeros_like(at.confidence)
    hips[:, [1, 9, 12]] = 1.0
    write_json(folder, at.keypoints, hips)


BAD = {
    "empty folder": (lambda folder, at: folder.mkdir(), "no numbered JSON"),
    "no folder": (lambda folder, at: None, "no such folder"),
    "nobody": (nobody, "nobody was detected"),
    "nothing that is used": (only_hips, "no keypoint that a fit uses"),
    "one frame": (lambda folder, at: write_json(folder, at.keypoints[:1], at.confidence[:1]), "one frame"),
}


@pytest.mark.parametrize("name", BAD)
def test_keypoints_that_cannot_be_used(tmp_path, walk, capsys, name):
    make, message = BAD[name]
    make(tmp_path / "keypoints", seen(walk))
    words = ("--layout", "BODY_25", "--out", tmp_path / "fit.npz", "--quick")
    assert run("--keypoints", tmp_path / "keypoints", *words) == 2
    said = capsys.readouterr().err
    assert message in said and "remedy" in said
    assert not (tmp_path / "fit.npz").exists()


def test_options_that_cannot_be_used(tmp_path, keypoints, capsys):
    small = replace(CAMERA, width=200, height=200)
    pictures = tmp_path / "images"
    pictures.mkdir()
    cases = {
        "detections lie outside": ("--camera", write_camera(tmp_path / "small.json", small)),
        "no width, height": ("--camera", tmp_path / "empty.json"),
        "0 images": ("--video", pictures),
        "expected a name that ends in .bvh": ("--bvh", tmp_path / "fit.txt"),
        "nobody fits": ("--person", "7"),
    }
    (tmp_path / "empty.json").write_text('{"intrinsics": [[900, 0, 640], [0, 900, 360], [0, 0, 1]]}')
    for message, words in cases.items():
        assert run("--keypoints", keypoints, "--out", tmp_path / "fit.npz", "--quick", *words) == 2
        said = capsys.readouterr().err
        assert message in said and "remedy" in said
    assert run("--keypoints", keypoints, "--out", tmp_path / "fit.json") == 2


def test_cameras_of_a_file(tmp_path):
    file = tmp_path / "Calib.qca.txt"
    root = ElementTree.Element("calibration")
    for serial, shift in (("cam_01", "0"), ("cam_02", "1000")):
        node = ElementTree.SubElement(root, "camera", serial=serial)
        ElementTree.SubElement(node, "fov_video", left="0", top="0", right="1279", bottom="719")
        turn = {f"r{i}{j}": str(float(i == j)) for i in (1, 2, 3) for j in (1, 2, 3)}
        ElementTree.SubElement(node, "transform", x=shift, y="0", z="0", **turn)
        numbers = {"focalLengthU": "64000", "focalLengthV": "64000", "centerPointU": "40960", "centerPointV": "23040"}
        ElementTree.SubElement(node, "intrinsic", **numbers)
    ElementTree.ElementTree(root).write(file)
    assert load_camera(file, "cam_02")[0].centre[0] == pytest.approx(1.0)
    camera, placed = load_camera(file, None, "somewhere/cam01_json")
    assert camera.centre[0] == pytest.approx(0.0) and placed
    for name, views in ((None, "somewhere/left"), (None, None), ("cam_09", None)):
        with pytest.raises(DataError, match="cam_01, cam_02") as caught:
            load_camera(file, name, views)
        assert caught.value.remedy
    lens, placed = load_camera(write_camera(tmp_path / "lens.json", placed=False))
    assert not placed and torch.equal(lens.intrinsics, CAMERA.intrinsics)
    bent = replace(CAMERA, rotation=2 * CAMERA.rotation)
    with pytest.raises(DataError, match="rotation matrix"):
        load_camera(write_camera(tmp_path / "bent.json", bent))


# ------------------------------------------------------------------------------------------ rates and comparisons
def test_at_rate_halves_and_interpolates(walk):
    observation = seen(walk)
    fast = replace(observation, fps=60.0)
    half = at_rate(fast)
    assert torch.equal(half.keypoints, observation.keypoints[::2]) and half.fps == 30
    same = at_rate(observation)
    assert torch.equal(same.keypoints, observation.keypoints)
    slow = at_rate(replace(observation, fps=15.0))
    assert slow.frames == 2 * FRAMES - 1
    middle = (observation.keypoints[:-1] + observation.keypoints[1:]) / 2
    assert torch.allclose(slow.keypoints[1::2], middle, atol=1e-3)


def as_fit(motion: Motion, cameras: list[Camera]) -> testops.Fitted:
    """A fit that found this motion."""
    batch = replace(motion, root=motion.root[None], rot=motion.rot[None], contacts=None)
    skeleton = replace(motion.skeleton, offsets=motion.skeleton.offsets.expand(1, 1, 22, 3))
    batch = replace(batch, skeleton=skeleton)
    nothing = torch.zeros(1, motion.frames, 9)
    betas = body_shape.from_skeleton(motion.skeleton)[None]
    return testops.Fitted(batch, {2: batch, 3: batch}, nothing, nothing, nothing, betas, cameras, {}, {})


def test_report_counts_only_what_was_seen(walk):
    observation = seen(walk)
    hidden = observation.confidence.clone()
    hidden[:, BODY_25.index("left_wrist")] = 0
    wrong = observation.keypoints.clone()
    wrong[:, BODY_25.index("left_wrist")] = 1e4
    wrong[:, BODY_25.index("right_knee")] += torch.tensor([3.0, 4.0])
    found = fit._report(as_fit(walk, [CAMERA]), replace(observation, keypoints=wrong, confidence=hidden), clip=0)
    assert found.pixels == pytest.approx(5 / 21, abs=1e-3)
    assert found.median_pixels < 0.01
    assert found.seen == pytest.approx(21 / 22)
