"""Keypoints of every detector: small files by hand against what is known of them, and the real ones where they are."""

import json
import os
from pathlib import Path

import detected
import numpy as np
import pytest
import torch
from loaders import check_error

from motionlab.errors import DataError
from motionlab.io import keypoints
from motionlab.io.layouts import BODY_25B, COCO_17, HALPE_26, LAYOUTS, MEDIAPIPE_33, standard_name, to_body_25
from motionlab.observation import BODY_25, Observation2D

needs_data = pytest.mark.skipif(
    not os.environ.get("MOTIONLAB_DATA"), reason="set MOTIONLAB_DATA to the unpacked recordings"
)
#: What some files say of themselves, and what the others must be told.
SAID = {"mediapipe.json": {}, "mediapipe.csv": {"size": detected.SIZE}, "plain.npz": {}}
FPS = {"mediapipe.json": 25, "mediapipe.csv": 25, "plain.npz": 24}
IDS = {"alphapose_tracked.json": {7, 8}, "ultralytics.json": {5, 6}, "yolo.txt": {1, 2}, "vitpose.json": {3, 4}}


def written(path: Path, what: object) -> Path:
    path.write_text(what if isinstance(what, str) else json.dumps(what))
    return path


def alphapose(*people: list[list[float]], score: float = 0.8) -> list:
    """A frame per person."""
    return [{"image_id": f"{n}.jpg", "keypoints": detected.flat(p), "score": 2.0} for n, p in enumerate(people)]


def body(score: float = 0.8) -> list[list[float]]:
    return [[100 + 5 * k, 200 + 9 * k, score] for k in range(17)]


@pytest.mark.parametrize("name", detected.FORMATS)
def test_every_format_gives_the_points_that_were_written(tmp_path, name):
    _, count, people, scored, first = detected.FORMATS[name]
    (tmp_path / name).write_bytes(detected.SEEDS[name])
    found = keypoints.load(tmp_path / name, **SAID.get(name, {"fps": 30, "size": detected.SIZE}))
    names = {"vitpose.json": tuple(map(standard_name, detected.VIT))}.get(name)
    assert found.names == (names or {len(row): row for row in LAYOUTS.values()}[count])
    assert found.first == first and found.fps == pytest.approx(FPS.get(name, 30)) and len(found.tracks) == people
    assert {track.id for track in found.tracks} == IDS.get(name, {4, 9} if name == "plain.npz" else set(range(people)))
    seen = found.people(1.0)
    expected = torch.from_numpy(detected.points(count)[: found.frames, :people]).transpose(0, 1)
    order = seen.keypoints[:, 0, 0, 0].argsort()
    assert found.frames == (1 if name in ("yolo.txt", "openpose_1.0.json", "openpose_135.json") else detected.FRAMES)
    assert torch.allclose(seen.keypoints[order].double(), expected[..., :2], atol=1e-3)
    assert torch.allclose(seen.confidence[order].double(), expected[..., 2] if scored else torch.ones(1).double())


def test_layouts_name_the_points_as_their_authors_do(tmp_path):
    assert HALPE_26 == tuple(map(standard_name, detected.HALPE)) and MEDIAPIPE_33 == tuple(detected.BLAZE)
    openpose = """Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee RKnee LAnkle
        RAnkle UpperNeck HeadTop LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel""".split()
    assert BODY_25B == tuple(map(standard_name, openpose)) == LAYOUTS["BODY_135"][:25]
    assert standard_name("leftShoulder") == standard_name("l_shoulder") == "left_shoulder"
    assert standard_name("MidHip") == standard_name("pelvis") == "mid_hip" and standard_name("REar") == "right_ear"
    whole = LAYOUTS["WHOLEBODY_133"]
    assert (whole[17], whole[22], whole[23], whole[90], whole[91], whole[112]) == (
        "left_big_toe", "right_heel", "face_0", "face_67", "left_hand_0", "right_hand_0",
    )  # fmt: skip


def test_missing_points_of_body_25_are_middles_only_of_what_was_seen():
    seen = Observation2D(torch.rand(1, 33, 2), torch.ones(1, 33), MEDIAPIPE_33, 30.0)
    seen.confidence[0, MEDIAPIPE_33.index("left_hip")] = 0
    full = to_body_25(seen, midpoints=True)
    sure = dict(zip(BODY_25, full.confidence[0].tolist(), strict=True))
    assert sure["neck"] == sure["left_big_toe"] == sure["right_heel"] == 1
    assert sure["mid_hip"] == sure["left_small_toe"] == 0
    bare = to_body_25(Observation2D(torch.ones(1, 1, 2), torch.ones(1, 1), ("nose",), 30.0), midpoints=True)
    assert bare.confidence.sum() == 1  # no shoulders, no middle of them


@pytest.mark.parametrize(
    ("point", "why"),
    [([0, 0, 0.7], "zero"), ([5, None, 0.7], "null"), ([7.5, 8.5, 0], "no confidence"), ([9, 9, 0.01], "unsure")],
)
def test_missing_is_missing(tmp_path, point, why):
    person = body()
    person[4] = point
    path = written(tmp_path / "a.json", alphapose(person, body()))
    found = keypoints.load(path, fps=30).person()
    assert not found.visible[0, 4] and (found.keypoints[0, 4] == 0).all()
    assert found.visible.sum() == 33
    path = written(tmp_path / "b.json", path.read_text().replace("200", "NaN", 1))
    assert not keypoints.load(path, fps=30).person().visible[0, 0]
    if why == "unsure":
        assert keypoints.load(path, fps=30, lowest=0).person().visible[0, 4]


@pytest.mark.parametrize(
    ("scores", "expected", "note"),
    [
        ((0.5, 1.05), (0.5, 1.0), "above 1 count 1"),
        ((-2.0, 4.0), (0.119, 0.982), "logits"),
        ((0, 1, 2), (0, 1, 1), "flags"),
        ((20.0, 80.0), (0.25, 1.0), "divided by 80"),
        ((None, None), (1.0, 1.0), "no confidences"),
    ],
)
def test_scores_of_any_scale_become_confidences_and_a_note_says_so(tmp_path, scores, expected, note):
    people = [body(score) for score in scores]
    found = keypoints.load(written(tmp_path / "a.json", alphapose(*people)), fps=30)
    assert found.person().confidence[:, 0].tolist() == pytest.approx(expected, abs=1e-3)
    assert any(note in each for each in found.notes)


def refused(path: Path, *words: str, **how) -> None:
    with pytest.raises(DataError) as caught:
        keypoints.load(path, **{"fps": 30, **how})
    check_error(caught.value, *words)


def test_what_a_file_does_not_say_is_asked_for_by_name(tmp_path):
    path = written(tmp_path / "a.txt", detected.yolo())
    refused(path, "pass fps=, or --fps", fps=None, size=detected.SIZE)
    refused(path, "pass size=(width, height), or --size")
    for size in ((0, 720), (1280,), ("a", 3), 5, (1e9, 2)):
        refused(path, "size", size=size)
    refused(path, "frames per second", fps=-1)
    refused(path, "layout", size=detected.SIZE, layout="BODY_25")
    refused(written(tmp_path / "b.json", alphapose(body()[:15])), "15 keypoints", "pass layout=")


def test_three_dimensions_are_refused_for_that_reason(tmp_path):
    poses = detected.mmpose(17, detected.COCO)
    for frame in poses["instance_info"]:
        for person in frame["instances"]:
            person["keypoints"] = [[0.1, -0.2, 0.3]] * 17
    refused(written(tmp_path / "a.json", poses), "3 coordinates", "3-D")
    world = [{"x": np.sin(k), "y": np.cos(k), "z": 0.1, "visibility": 0.9} for k in range(33)]
    refused(written(tmp_path / "b.json", [{"pose_world_landmarks": world}]), "3-D", "metres")
    refused(written(tmp_path / "c.json", [[[p["x"], p["y"], p["z"]] for p in world]] * 3), "3-D", "world landmarks")
    both = {"pose_landmarks": [{**p, "x": 0.5, "y": 0.5} for p in world], "pose_world_landmarks": world}
    assert keypoints.load(written(tmp_path / "d.json", [both]), fps=30, size=(640, 480)).frames == 1


def test_pickles_are_refused_with_the_way_to_save_them_plainly(tmp_path):
    boxes = np.array([None, np.zeros((1, 4, 17))], dtype=object)
    np.savez(tmp_path / "detectron2.npz", keypoints=boxes, boxes=boxes, metadata=np.array({"w": 1}, dtype=object))
    refused(tmp_path / "detectron2.npz", "pickled", "never loaded", "numpy.savez")
    np.savez(tmp_path / "videopose.npz", positions_2d=np.array({}, dtype=object))
    refused(tmp_path / "videopose.npz", "positions_2d", "numpy.savez")
    np.save(tmp_path / "a.npy", np.zeros((3, 17, 3)))
    refused(tmp_path / "a.npy", "numpy.savez")


def test_a_file_per_frame(tmp_path):
    labels = tmp_path / "labels"
    labels.mkdir()
    for frame in (1, 2, 3):  # the tool counts from 1; in frame 4 it wrote nothing
        written(labels / f"clip_{frame}.txt", detected.yolo(frame - 1))
        written(labels / f"clip_{frame + 4}.txt", "\n".join([detected.yolo(0)] * 2))  # a second run wrote on
    written(labels / "classes.txt", "person")
    found = keypoints.load(labels, fps=30, size=detected.SIZE)
    assert (found.first, found.frames, len(found.tracks)) == (1, 7, 2)
    assert found.people(0).visible.any(-1).tolist() == [[True] * 3 + [False] + [True] * 3] * 2
    (tmp_path / "images").mkdir()
    for n, frame in enumerate(detected.mmpose()):  # image mode: the people alone
        written(tmp_path / "images" / f"{n:06d}.json", frame["instances"] if n != 2 else [])
    assert keypoints.load(tmp_path / "images", fps=30).people(0).visible.any(-1).sum(-1).tolist() == [3, 3]
    written(tmp_path / "images" / "000009.json", detected.mmpose())
    refused(tmp_path / "images", "000009.json", "holds 4 frames")
    written(tmp_path / "images" / "000009.json", detected.movenet(detected.COCO)[0])
    refused(tmp_path / "images", "names other points")


def test_people_who_are_not_there_keep_the_others_places(tmp_path):
    """Pose2Sim writes {} or [] for a person whom it did not find, and NaN for a joint."""
    other = {"pose_keypoints_2d": detected.flat(body())}
    text = json.dumps({"people": [{}, other, {"pose_keypoints_2d": []}]}).replace("100", "NaN", 1)
    (tmp_path / "a").mkdir()
    for n in range(3):
        written(tmp_path / "a" / f"cam.{n}.json", text if n else '{"people": [{}, {}]}')
    found = keypoints.load(tmp_path / "a", fps=30)
    assert len(found.tracks) == 1 and found.tracks[0].frames.tolist() == [1, 2]
    assert found.person().visible.sum(-1).tolist() == [0, 16, 16]


def test_footage_lists_its_people_and_gives_some(tmp_path):
    table = detected.points(17, people=3, frames=8)
    table[4:, 2] = 0  # the third is there for half of the time
    np.savez(tmp_path / "a.npz", keypoints=table, names=detected.COCO, fps=30)
    found = keypoints.load(tmp_path / "a.npz")
    rows = found.table()
    assert [row["frames"] for row in rows] == [8, 8, 4] and [row["share %"] for row in rows] == [100, 100, 50]
    third = next(track for track in found.tracks if len(track.frames) == 4)
    assert rows[2] == {
        "person": third.id, "frames": 4, "share %": 50,
        "confidence": pytest.approx(table[:4, 2, :, 2].mean()), "height px": pytest.approx(np.ptp(table[0, 2, :, 1])),
    }  # fmt: skip
    largest = max(range(3), key=lambda k: np.ptp(table[0, k, :, 1]))
    assert np.allclose(found.person("largest").keypoints[0], table[0, largest, :, :2], atol=1e-3)
    assert found.person(third.id).visible.any(-1).tolist() == [True] * 4 + [False] * 4
    assert found.people(0.9).keypoints.shape == (2, 8, 17, 2) and found.people().keypoints.shape[0] == 3
    both = found.people([third.id, rows[0]["person"]])
    assert torch.equal(both.keypoints[0], found.person(third.id).keypoints) and both.names == COCO_17
    for call, word in (
        (lambda: found.person(77), "nobody has id 77"), (lambda: found.person("tallest"), "longest"),
        (lambda: found.people(1.1), "ask for 1.000"), (lambda: found.people([]), "no ids"),
    ):  # fmt: skip
        with pytest.raises(DataError) as caught:
            call()
        check_error(caught.value, word)


def test_a_table_with_a_line_per_person(tmp_path):
    """Points in any order, two people by id, an empty cell, times in seconds with one frame missing."""
    head = "time;id;leftKnee_y;leftKnee_x;RAnkle_x;RAnkle_y;RAnkle_score;leftKnee_score"
    rows = [f"{time};{k};{300 + k};{100 * k};7;;0.9;0.8" for time in (0.5, 0.54, 0.58, 0.66) for k in (4, 2)]
    found = keypoints.load(written(tmp_path / "a.csv", "\n".join([head, *rows])))
    knee, ankle = found.names.index("left_knee"), found.names.index("right_ankle")
    assert found.names == COCO_17 and found.fps == pytest.approx(25)
    assert [(track.id, track.frames.tolist()) for track in found.tracks] == [(4, [0, 1, 2, 4]), (2, [0, 1, 2, 4])]
    second = found.person(2)
    assert second.keypoints[0, knee].tolist() == [200, 302] and not second.visible[:, ankle].any()


def test_numbers_of_frames_and_images_are_bounded(tmp_path):
    results = detected.coco()
    results[-1]["image_id"] = 10**9
    found = keypoints.load(written(tmp_path / "a.json", results), fps=30)
    assert found.frames == 5 and "not as a film" in " ".join(found.notes)
    frames = detected.mmpose()
    frames[-1]["frame_id"] = 10**9
    refused(written(tmp_path / "b.json", frames), "frame numbers run from 0 to 1000000000")
    results[-1]["image_id"], results[0]["image_id"] = "a/7.jpg", "b/7.jpg"
    refused(written(tmp_path / "c.json", results), "the same number")
    named = [{f"point {n}": {"x": 1, "y": 2}} for n in range(300)]
    refused(written(tmp_path / "d.json", named), "300 different keypoints")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"version": 1.3}', ("no known layout",)),
        ("[[[1, 2], [3, 4]]]", ("no known layout",)),
        ("[]", ("nobody",)),
        ('[{"frame_id": -1, "instances": []}]', ("frame 0", "no frame number")),
        ('[{"frame_id": 1, "instances": []}, {"frame_id": 1, "instances": []}]', ("there twice",)),
        ('[{"image_id": 1, "keypoints": [1, 2]}]', ("entry 0", "x, y, confidence")),
        ("[" * 90_000, ("cannot be read",)),
        ("frame,person,keypoint,x,y\n0,0,0,1\n", ("line 2", "5 cells")),
        ("frame,person,keypoint,x,y\n0.5,0,0,1,1\n", ("line 2", "no frame number")),
        ("a_x,a_y,a_x,a_y\n1,2,3,4\n", ("two keypoints have one name",)),
        ("one,two\n1,2\n", ("no known layout",)),
        ("0 0.5 0.5 0.1 0.1 " + "0.1 0.9 1 " * 17, ("person 0", "a person in it")),
        ("0 1 2", ("3 numbers",)),
        ("1e300 " * 56, ("not a usable number",)),
    ],
)
def test_malformed_files_say_what_where_and_what_to_do(tmp_path, text, words):
    refused(written(tmp_path / "a", text), *words)


#: Files of ``keypoint_formats``: what they need, detector, layout, frames, first, people seen in half of them, share of
#: the points seen of the longest; as their SOURCE.txt says it, or None for a reason to be refused.
REAL = {
    "alphapose/halpe26_first200frames.json": ("AlphaPose", "HALPE_26", 200, 1, 1, 1.0),
    "coco_results/person_keypoints_val2014_fakekeypoints100_results.json": ("COCO results", "COCO_17", 47, 0, 0, None),
    "mediapipe/masked_piper_sample_body_first120.csv": ("MediaPipe", "MEDIAPIPE_33", 120, 0, 1, 0.71),
    "mediapipe/pose_squats.full.json": ("MediaPipe", "MEDIAPIPE_33", 65, 0, 1, 1.0),
    "mmpose/wholebody133_FOOTBALL.json": ("MMPose", "WHOLEBODY_133", 62, 0, 1, 0.92),
    "movenet/pose_1.json": ("MoveNet", "COCO_17", 120, 0, 1, 1.0),
    "openpose_body25_3people/output_json": ("OpenPose", "BODY_25", 125, 0, 3, None),
    "openpose_body25_hands_face/slp_sample": ("OpenPose", "BODY_25", 9, 0, 1, 0.48),
    "openpose_body25b_2people/pose/cam01_json": ("OpenPose", "BODY_25B", 100, 0, 3, None),
    "openpose_body25b_2people/pose-associated/cam01_json": ("OpenPose", "BODY_25B", 30, 0, 2, None),
    "openpose_coco18_v1.0/random_keypoints.json": ("OpenPose", "COCO_18", 1, 0, 2, None),
    "pose2sim_halpe26/cam03": ("RTMPose as OpenPose", "HALPE_26", 100, 1, 1, 1.0),
    "ultralytics/roboflow_labels_1_13_14": ("Ultralytics", "COCO_17", 129, 0, 2, None),
    "ultralytics/yolo_person_index_csv_first250frames.csv": ("CSV table", "COCO_17", 250, 0, 2, None),
}


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_real_files_hold_what_their_source_says(name):
    detector, layout, frames, first, people, share = REAL[name]
    path = Path(os.environ["MOTIONLAB_DATA"]) / "keypoint_formats" / name
    found = keypoints.load(path, fps=30, size=(1280, 720))
    assert (found.detector, found.names, found.frames, found.first) == (detector, LAYOUTS[layout], frames, first)
    assert sum(len(track.frames) > frames / 2 for track in found.tracks) == people
    if share is not None:
        assert float(found.person().visible.float().mean()) == pytest.approx(share, abs=0.01)
    if name == "openpose_body25_3people/output_json":
        assert int((~found.people(1.0).visible).sum()) == 4768
    if name == "coco_results/person_keypoints_val2014_fakekeypoints100_results.json":
        assert sum(len(track.frames) for track in found.tracks) == 125
    if name.endswith("first250frames.csv"):
        assert sum(int((track.points[..., 2] > 0).sum()) for track in found.tracks) == 8534 - 2341


@needs_data
@pytest.mark.parametrize("name", ["mmpose/h36m17_3d_with_meta_info_demo.json", "mediapipe/pose_squats_3d.full.json"])
def test_real_three_dimensional_files_are_refused(name):
    refused(Path(os.environ["MOTIONLAB_DATA"]) / "keypoint_formats" / name, "3-D")
