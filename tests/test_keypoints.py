"""Keypoints of every detector: small files by hand against what is known of them, and the real ones where they are."""

import json
from pathlib import Path

import detected
import numpy as np
import pytest
import torch
from loaders import refused as told

from motionlab.errors import DataError
from motionlab.io import keypoints
from motionlab.io.detections import BODY_25B, COCO_17, HALPE_26, LAYOUTS, MEDIAPIPE_33, standard_name, to_body_25
from motionlab.observation import BODY_25, Observation2D
from tests.recorded import DATA

#: Real files lie among the recordings, or beside them, where no record of a notebook counts them.
FORMATS = next((f for folder in (DATA, DATA.parent) if (f := folder / "keypoint_formats").is_dir()), None)
needs_data = pytest.mark.skipif(FORMATS is None, reason="unpack keypoint_formats into MOTIONLAB_DATA or beside it")
#: What some files say of themselves, and what the others must be told.
SAID = {"mediapipe.json": {}, "mediapipe.csv": {"size": detected.SIZE}, "plain.npz": {}, "sports2d.trc": {}}
FPS = {"mediapipe.json": 25, "mediapipe.csv": 25, "plain.npz": 24, "sports2d.trc": 25}
IDS = {"alphapose_tracked.json": {7, 8}, "ultralytics.json": {5, 6}, "yolo.txt": {1, 2}, "vitpose.json": {3, 4}}
IDS["plain.npz"] = {4, 9}


def written(path: Path, what: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(what if isinstance(what, str) else json.dumps(what))
    return path


def alphapose(*people: list[list[float]]) -> list:
    """A frame per person."""
    return [{"image_id": f"{n}.jpg", "keypoints": detected.flat(p)} for n, p in enumerate(people)]


def body(score: float | None = 0.8) -> list[list[float]]:
    return [[100 + 5 * k, 200 + 9 * k, score] for k in range(17)]


def refused(path: Path, *words: str, **how) -> None:
    with told(*words):
        keypoints.load(path, **{"fps": 30, **how})


def ids_of(found):
    return [track.id for track in found.tracks]


@pytest.mark.parametrize("name", detected.FORMATS)
def test_every_format_gives_the_points_that_were_written(tmp_path, name):
    _, count, people, first = detected.FORMATS[name]
    (tmp_path / name).write_bytes(detected.SEEDS[name])
    found = keypoints.load(tmp_path / name, **SAID.get(name, {"fps": 30, "size": detected.SIZE}))
    names = {"vitpose.json": tuple(map(standard_name, detected.VIT))}.get(name)
    assert found.names == (names or next(row for row in LAYOUTS.values() if len(row) == count))
    assert found.first == first and found.fps == pytest.approx(FPS.get(name, 30)) and len(found.tracks) == people
    assert {track.id for track in found.tracks} == IDS.get(name, set(range(people)))
    seen = found.people(ids_of(found))
    expected = torch.from_numpy(detected.points(count)[: found.frames, :people]).transpose(0, 1)
    order = seen.keypoints[:, 0, 0, 0].argsort()
    assert found.frames == (1 if name in ("yolo.txt", "openpose_1.0.json", "openpose_135.json") else detected.FRAMES)
    assert torch.allclose(seen.keypoints[order].double(), expected[..., :2], atol=1e-3)
    sure = torch.ones_like(expected[..., 2]) if name in detected.UNSCORED else expected[..., 2]
    assert torch.allclose(seen.confidence[order].double(), sure)


def test_one_more_layout_of_a_size_changes_nobodys_reading(tmp_path, monkeypatch):
    monkeypatch.setitem(LAYOUTS, "OTHER_17", COCO_17[::-1])
    path = written(tmp_path / "a.json", alphapose(body()))
    assert keypoints.load(path, fps=30, size=detected.SIZE).names == COCO_17
    assert keypoints.load(path, fps=30, size=detected.SIZE, layout="OTHER_17").names == COCO_17[::-1]


def test_layouts_name_the_points_as_their_authors_do():
    assert HALPE_26 == tuple(map(standard_name, detected.HALPE)) and MEDIAPIPE_33 == tuple(detected.BLAZE)
    openpose = """Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee RKnee LAnkle
        RAnkle UpperNeck HeadTop LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel""".split()
    assert BODY_25B == tuple(map(standard_name, openpose)) == LAYOUTS["BODY_135"][:25]
    assert LAYOUTS["COCO_18"][8] == "right_hip" and LAYOUTS["COCO_18"][14:] == BODY_25[15:19]
    assert standard_name("leftShoulder") == standard_name("l_shoulder") == "left_shoulder"
    whole = [LAYOUTS["WHOLEBODY_133"][k] for k in (17, 22, 23, 90, 91, 112)]
    assert whole == ["left_big_toe", "right_heel", "face_0", "face_67", "left_hand_0", "right_hand_0"]


def test_missing_points_of_body_25_are_middles_only_of_what_was_seen():
    seen = Observation2D(torch.rand(1, 33, 2), torch.ones(1, 33), MEDIAPIPE_33, 30.0)
    seen.confidence[0, MEDIAPIPE_33.index("left_hip")] = 0
    sure = dict(zip(BODY_25, to_body_25(seen).confidence[0].tolist(), strict=True))
    assert sure["neck"] == sure["left_big_toe"] == sure["right_heel"] == 1
    assert sure["mid_hip"] == sure["left_small_toe"] == 0
    bare = to_body_25(Observation2D(torch.ones(1, 1, 2), torch.ones(1, 1), ("nose",), 30.0))
    assert bare.confidence.sum() == 1  # no shoulders, no middle of them


@pytest.mark.parametrize("point", [[0, 0, 0.7], [5, None, 0.7], [7.5, 8.5, 0], [9, 9, 0.01], [9, float("nan"), 1]])
def test_missing_is_missing(tmp_path, point):
    path = written(tmp_path / "a.json", alphapose([*body()[:4], point, *body()[5:]], body()))
    found = keypoints.load(path, fps=30).person()
    assert found.visible.sum() == 33 and not found.visible[0, 4] and (found.keypoints[0, 4] == 0).all()
    assert keypoints.load(path, fps=30, lowest=0).person().visible[0, 4] == (point[2] == 0.01)


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
    found = keypoints.load(written(tmp_path / "a.json", alphapose(*map(body, scores))), fps=30)
    assert found.person().confidence[:, 0].tolist() == pytest.approx(expected, abs=1e-3)
    assert any(note in each for each in found.notes)


def test_what_a_file_does_not_say_is_asked_for_by_name(tmp_path):
    path = written(tmp_path / "a.txt", detected.yolo())
    refused(path, "pass fps=, or --fps", fps=None, size=detected.SIZE)
    refused(path, "pass size=(width, height), or --size")
    for size in ((0, 720), (1280,), ("a", 3), 5, (1e9, 2)):
        refused(path, "size", size=size)
    refused(path, "frames per second", fps=-1)
    refused(path, "pass layout=, or --layout: COCO_17", size=detected.SIZE, layout="BODY_25")
    refused(written(tmp_path / "b.json", alphapose(body()[:15])), "15 keypoints", "numpy.savez")


def test_three_dimensions_are_refused_for_that_reason(tmp_path):
    poses = detected.mmpose(17, detected.COCO)
    poses["instance_info"][2]["instances"][1]["keypoints"] = [[0.1, -0.2, 0.3]] * 17
    refused(written(tmp_path / "a.json", poses), "frame 3, person 1", "3 coordinates", "3-D")
    world = [{"x": np.sin(k), "y": np.cos(k), "z": 0.1, "visibility": 0.9} for k in range(33)]
    refused(written(tmp_path / "b.json", [{"pose_world_landmarks": world}]), "3-D", "metres")
    refused(written(tmp_path / "c.json", [[[p["x"], p["y"], p["z"]] for p in world]] * 3), "3-D", "world landmarks")
    both = {"pose_landmarks": [{**p, "x": 0.5, "y": 0.5} for p in world], "pose_world_landmarks": world}
    assert keypoints.load(written(tmp_path / "d.json", [both]), fps=30, size=(640, 480)).frames == 1


def test_pickles_are_refused_with_the_way_to_save_them_plainly(tmp_path):
    objects = np.array([None, {}], dtype=object)
    np.savez(tmp_path / "detectron2.npz", boxes=objects, keypoints=objects, metadata=objects)
    np.savez(tmp_path / "videopose.npz", positions_2d=objects)
    np.save(tmp_path / "a.npy", np.zeros((3, 17, 3)))
    for name, words in (("detectron2.npz", "never loaded"), ("videopose.npz", "positions_2d"), ("a.npy", "names")):
        refused(tmp_path / name, words, "numpy.savez")


def test_a_file_per_frame(tmp_path):
    for frame in (1, 2, 3):  # the tool counts from 1; in frame 4 it wrote nothing
        written(tmp_path / f"labels/clip_{frame}.txt", detected.yolo(frame - 1))
        written(tmp_path / f"labels/clip_{frame + 4}.txt", "\n".join([detected.yolo(0)] * 2))  # a second run wrote on
    written(tmp_path / "labels/classes.txt", "person")
    written(tmp_path / "labels/clip_7.txt", detected.yolo().replace(" 0.91 ", " "))  # without the box's confidence
    found = keypoints.load(tmp_path / "labels", fps=30, size=detected.SIZE)
    assert (found.first, found.frames, {track.id for track in found.tracks}) == (1, 7, {1, 2})
    assert found.people(ids_of(found)).visible.any(-1).tolist() == [[True] * 3 + [False] + [True] * 3] * 2
    for n, frame in enumerate(detected.mmpose()):  # image mode: the people alone
        written(tmp_path / f"images/{n:06d}.json", frame["instances"] if n != 2 else [])
    found = keypoints.load(tmp_path / "images", fps=30)
    assert found.people(ids_of(found)).visible.any(-1).sum(-1).tolist() == [3, 3]
    for other, words in ((detected.mmpose(), "holds 4 frames"), (detected.movenet()[0], "names other points")):
        written(tmp_path / "images/000009.json", other)
        refused(tmp_path / "images", "000009.json", words)


def test_people_who_are_not_there_leave_the_others_alone(tmp_path):
    """Pose2Sim writes {} or [] for a person whom it did not find, and NaN for a joint."""
    people = [{}, {"pose_keypoints_2d": detected.flat(body())}, {"pose_keypoints_2d": []}]
    for n in range(3):
        text = json.dumps({"people": people if n else [{}, {}]})
        written(tmp_path / f"a/cam.{n}.json", text.replace("100", "NaN", 1))
    found = keypoints.load(tmp_path / "a", fps=30)
    assert len(found.tracks) == 1 and found.person().visible.sum(-1).tolist() == [0, 16, 16]


def test_footage_lists_its_people_and_gives_some(tmp_path):
    table = detected.points(17, people=3, frames=8)
    table[4:, 2] = 0  # the third is there for half of the time
    np.savez(tmp_path / "a.npz", keypoints=table, names=detected.COCO, fps=30, ids=[5, 3, 8])
    found = keypoints.load(tmp_path / "a.npz")
    third = {"person": 8, "frames": 4, "share %": 50, "confidence": pytest.approx(table[:4, 2, :, 2].mean())}
    assert found.table()[2] == third | {"height px": pytest.approx(np.ptp(table[0, 2, :, 1]))}
    assert [row["share %"] for row in found.table()] == [100, 100, 50]
    largest = max(range(3), key=lambda k: np.ptp(table[0, k, :, 1]))
    assert np.allclose(found.person("largest").keypoints[0], table[0, largest, :, :2], atol=1e-3)
    assert found.person(8).visible.any(-1).tolist() == [True] * 4 + [False] * 4
    assert found.people([5, 3]).keypoints.shape == (2, 8, 17, 2)
    assert torch.equal(found.people([8, 3]).keypoints[0], found.person(8).keypoints)
    for call in (lambda: found.person(77), lambda: found.person("tall"), lambda: found.people([])):
        with pytest.raises(DataError, match="nobody has the id"):
            call()


def test_a_table_with_a_line_per_person(tmp_path):
    """Points in any order, two people by id, an empty cell, times in seconds with one frame missing."""
    head = "time;id;leftKnee_y;leftKnee_x;RAnkle_x;RAnkle_y;RAnkle_score;leftKnee_score"
    rows = [f"{time};{k};{300 + k};{100 * k};7;;0.9;0.8" for time in (0.5, 0.54, 0.58, 0.66) for k in (4, 2)]
    found = keypoints.load(written(tmp_path / "a.csv", "\n".join([head, *rows])))
    assert found.names == COCO_17 and found.fps == pytest.approx(25)
    assert [(track.id, track.frames.tolist()) for track in found.tracks] == [(4, [0, 1, 2, 4]), (2, [0, 1, 2, 4])]
    assert found.person(2).visible[0].nonzero().tolist() == [[COCO_17.index("left_knee")]]
    assert found.person(2).keypoints[0, COCO_17.index("left_knee")].tolist() == [200, 302]


def test_numbers_of_frames_and_images_are_bounded(tmp_path):
    results, frames = detected.results(17, first=10), detected.mmpose()
    results[-1]["image_id"] = frames[-1]["frame_id"] = 10**9
    found = keypoints.load(written(tmp_path / "a.json", results), fps=30)
    assert found.frames == 5 and "not as a film" in " ".join(found.notes)
    refused(written(tmp_path / "b.json", frames), "frame numbers run from 0 to 1000000000")
    results[-1]["image_id"], results[0]["image_id"] = "a/7.jpg", "b/7.jpg"
    refused(written(tmp_path / "c.json", results), "the same number")
    refused(written(tmp_path / "d.json", [{f"p{n}": {"x": 1, "y": 2}} for n in range(300)]), "300 different keypoints")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"version": 1.3}', ("no known layout",)),
        ("[[[1, 2], [3, 4]]]", ("no known layout",)),
        ("[]", ("nobody",)),
        ('[{"frame_id": -1, "instances": []}]', ("frame 0", "no frame's")),
        ('[{"frame_id": 1, "instances": []}, {"frame_id": 1, "instances": []}]', ("there twice",)),
        ('[{"image_id": 1, "keypoints": []}, {"image_id": 1}]', ("frame 1, person 1", '"keypoints" of every person')),
        ('[{"frame_id": 1, "instances": [{"bbox": []}]}]', ("frame 1, person 0", '"keypoints" of every person')),
        ('[{"image_id": 1, "keypoints": [1, 2]}]', ("frame 1, person 0", "x, y, confidence")),
        ("frame,person,keypoint,x,y\n0,0,0,1\n", ("line 2", "5 cells")),
        ("frame,person,keypoint,x,y\n0.5,0,0,1,1\n", ("line 2", "no frame number")),
        ("frame,person,keypoint,x,y\n0,0,0,1,one\n", ("line 2", "'one'")),
        ("a_x,a_y,a_x,a_y\n1,2,3,4\n", ("two keypoints have one name",)),
        ("0 0.5 0.5 0.1 0.1 " + "0.1 0.9 1 " * 17, ("person 0", "a person in it")),
        ("1e300 " * 56, ("not a usable number",)),
    ],
)
def test_malformed_files_say_what_where_and_what_to_do(tmp_path, text, words):
    refused(written(tmp_path / "a", text), *words)


#: Files of ``keypoint_formats``: detector, layout, frames, first, people who are there for half of them, and points
#: seen of all people; as their SOURCE.txt says it, where it does. In the last somebody is there twice in two frames.
REAL = {
    "alphapose/halpe26_first200frames.json": ("AlphaPose", "HALPE_26", 200, 1, 1, 5200),
    "coco_results/person_keypoints_val2014_fakekeypoints100_results.json": ("COCO results", "COCO_17", 47, 0, 0, None),
    "mediapipe/masked_piper_sample_body_first120.csv": ("MediaPipe", "MEDIAPIPE_33", 120, 0, 1, None),
    "mediapipe/pose_squats.full.json": ("MediaPipe", "MEDIAPIPE_33", 65, 0, 1, 65 * 33),
    "mmpose/wholebody133_FOOTBALL.json": ("MMPose", "WHOLEBODY_133", 62, 0, 1, None),
    "movenet/pose_1.json": ("MoveNet", "COCO_17", 120, 0, 1, 120 * 17),
    "openpose_body25_3people/output_json": ("OpenPose", "BODY_25", 125, 0, 3, 9375 - 4768),
    "openpose_body25_hands_face/slp_sample": ("OpenPose", "BODY_25", 9, 0, 1, None),
    "openpose_body25b_2people/pose/cam01_json": ("OpenPose", "BODY_25B", 100, 0, 3, None),
    "openpose_body25b_2people/pose-associated/cam01_json": ("OpenPose", "BODY_25B", 30, 0, 2, None),
    "openpose_coco18_v1.0/random_keypoints.json": ("OpenPose", "COCO_18", 1, 0, 2, None),
    "pose2sim_halpe26/cam03": ("RTMPose as OpenPose", "HALPE_26", 100, 1, 1, 2600),
    "ultralytics/roboflow_labels_1_13_14": ("Ultralytics", "COCO_17", 129, 0, 2, 129 * 2 * 17 - 55),
    "ultralytics/yolo_person_index_csv_first250frames.csv": ("CSV table", "COCO_17", 250, 0, 2, 8534 - 2341 - 21),
}


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_real_files_hold_what_their_source_says(name):
    detector, layout, frames, first, people, points = REAL[name]
    path = FORMATS / name
    found = keypoints.load(path, fps=30, size=(1280, 720))
    assert (found.detector, found.names, found.frames, found.first) == (detector, LAYOUTS[layout], frames, first)
    assert sum(len(track.frames) > frames / 2 for track in found.tracks) == people
    assert points in (None, sum(int((track.points[..., 2] > 0).sum()) for track in found.tracks))


@needs_data
@pytest.mark.parametrize("name", ["mmpose/h36m17_3d_with_meta_info_demo.json", "mediapipe/pose_squats_3d.full.json"])
def test_real_three_dimensional_files_are_refused(name):
    refused(FORMATS / name, "3-D")


# ------------------------------------------------------------------------------------------ what people bring
def test_ids_that_change_and_people_who_are_there_twice_are_one_person(tmp_path):
    table, frames = detected.points(17, people=2, frames=12), []
    for n, both in enumerate(table):
        people = [{"keypoints": p[:, :2].tolist(), "keypoint_scores": p[:, 2].tolist()} for p in both]
        people.append({**people[1], "keypoints": (both[1, :, :2] + 1).tolist()})
        ids = (0 if n < 5 else 7, 3, 4)
        here = [one | {"track_id": k} for one, k in zip(people, ids, strict=True)]
        frames.append({"frame_id": n, "instances": here})
    found = keypoints.load(written(tmp_path / "a.json", frames), fps=30)
    assert sorted((track.id, len(track.frames)) for track in found.tracks) == [(0, 12), (3, 12)]
    assert np.allclose(found.person(0).keypoints, table[:, 0, :, :2]) and found.person(3).keypoints.shape[0] == 12
    assert any("0, 7 are taken for one person" in note for note in found.notes)
    assert any("3, 4 lie on each other" in note for note in found.notes)


def test_a_label_file_that_is_empty_shows_nobody(tmp_path):
    for n in range(6):
        text = "" if n == 2 else "\n" if n == 4 else detected.yolo(n % 4)
        written(tmp_path / f"labels/clip_{n}.txt", text)
    found = keypoints.load(tmp_path / "labels", fps=30, size=detected.SIZE)
    assert found.frames == 6 and found.people(ids_of(found)).visible.any(-1)[0].tolist() == [
        n not in (2, 4) for n in range(6)
    ]
    refused(written(tmp_path / "alone.txt", ""), "empty")
    (tmp_path / "labels/clip_3.txt").write_text("0 0.5")  # control: what is damaged is refused
    refused(tmp_path / "labels", "clip_3.txt", size=detected.SIZE)


def test_a_table_of_sports2d_is_read_in_pixels_and_refused_in_metres(tmp_path):
    names = "Hip RHip RKnee RAnkle RBigToe RSmallToe RHeel LHip LKnee LAnkle LBigToe Neck Head Nose".split()
    table = detected.points(len(names), people=1)[:, 0, :, :2]
    table[1, 2] = 0
    found = keypoints.load(written(tmp_path / "px.trc", detected.trc(table, names)))
    assert (found.detector, found.fps, found.frames) == ("Sports2D", 25, len(table))
    assert found.names[:2] == ("mid_hip", "right_hip") and found.names[-2:] == ("head_top", "nose")
    assert np.allclose(found.person().keypoints, table, atol=1e-3) and not found.person().visible[1, 2]
    assert found.person().visible.sum() == table[..., 0].size - 1
    refused(written(tmp_path / "m.trc", detected.trc(table, names, 0.003)), "metres", "pixels")
    refused(written(tmp_path / "z.trc", detected.trc(table, names).replace("\t0.0", "\t900.0")), "3-D")
    refused(written(tmp_path / "short.trc", "PathFileType\t4"), "five header lines")
    refused(written(tmp_path / "bad.trc", detected.trc(table, names).replace("2\t0.080", "two\t0.080")), "two")


@pytest.mark.parametrize("unit", [0.002, 1.0, 900.0])
def test_coordinates_about_the_hip_are_refused_in_any_unit(tmp_path, unit):
    table = detected.points(17, people=1)
    table[..., :2] -= table[:, :, 11:12, :2] + 0.5
    table[..., :2] *= unit
    np.savez(tmp_path / "a.npz", keypoints=table, names=detected.COCO, fps=30)
    refused(tmp_path / "a.npz", "around zero", "pixels")
    table[..., :2] += 700 * unit  # control: the same, inside an image
    np.savez(tmp_path / "a.npz", keypoints=table, names=detected.COCO, fps=30)
    assert keypoints.load(tmp_path / "a.npz", size=(1280, 720)).frames == 4


def test_points_that_were_put_onto_the_border_are_not_seen(tmp_path):
    table = detected.points(17, people=1, frames=20)
    inside = table.copy()
    table[5:, 0, 13:, 1], table[5:, 0, 12, 0] = 719.0, 0.0
    np.savez(tmp_path / "a.npz", keypoints=table, names=detected.COCO, fps=30)
    found, notes = keypoints.load(tmp_path / "a.npz").within((1280, 720))
    assert "border" in notes[0] and found.person().visible.sum() == 20 * 17 - 15 * 5
    assert not found.person().visible[5:, 12:].any() and found.person().visible[:5].all()
    np.savez(tmp_path / "a.npz", keypoints=inside, names=detected.COCO, fps=30)
    whole = keypoints.load(tmp_path / "a.npz")
    assert whole.within((1280, 720)) == (whole, [])  # control: nothing is there
    inside[3, 0, 4, 1] = 719.0  # control: one may be
    np.savez(tmp_path / "a.npz", keypoints=inside, names=detected.COCO, fps=30)
    assert keypoints.load(tmp_path / "a.npz").within((1280, 720))[1] == []
    inside[..., 1] = 719.0
    np.savez(tmp_path / "a.npz", keypoints=inside, names=detected.COCO, fps=30)
    with pytest.raises(DataError, match="nothing is left"):
        keypoints.load(tmp_path / "a.npz").within((1280, 720))


def test_annotations_of_coco_are_read_with_names_and_size_of_their_own(tmp_path):
    images = [{"id": 7 + n, "file_name": f"{n:05d}.jpg", "width": 640, "height": 480} for n in range(3)]
    flags = [[x, y, 2] for x, y, _ in body()]
    people = [{"id": n, "image_id": 7 + n, "category_id": 1, "keypoints": np.ravel(flags).tolist()} for n in (0, 2)]
    kinds = [{"id": 1, "name": "person", "keypoints": [*COCO_17]}]
    content = {"images": images, "annotations": people, "categories": kinds}
    found = keypoints.load(written(tmp_path / "a.json", content), fps=30)
    assert found.names == COCO_17 and found.size == (640, 480) and found.frames == 3
    assert found.tracks[0].frames.tolist() == [0, 2]
    np.testing.assert_allclose(found.tracks[0].points[0, :, :2], np.array(flags)[:, :2])
    refused(written(tmp_path / "b.json", content | {"annotations": [{"image_id": 1, "keypoints": []}]}))


@pytest.mark.parametrize("several", [False, True])
def test_tables_of_deeplabcut(tmp_path, several):
    head = [["scorer", *["net"] * 51], ["bodyparts", *(name for name in COCO_17 for _ in range(3))]]
    head += [["coords", *["x", "y", "likelihood"] * 17]]
    head[1:1] = [["individuals", *["one"] * 51]] if several else []
    rows = [[str(n), *(str(x + n) if k < 2 else "0.8" for p in body() for k, x in enumerate(p))] for n in range(3)]
    found = keypoints.load(written(tmp_path / "a.csv", "\n".join(map(",".join, [*head, *rows]))), fps=30)
    assert found.names == COCO_17 and found.frames == 3
    np.testing.assert_allclose(found.tracks[0].points[1], np.add(body(), (1, 1, 0)), atol=1e-5)


def test_confidences_by_other_names_are_not_lost(tmp_path):
    points = np.array(body(0.7))
    np.savez(tmp_path / "a.npz", keypoints=points[None, :, :2], scores=points[None, :, 2], fps=30)
    people = [{"keypoints": {"x": [*points[:, 0]], "y": [*points[:, 1]], "confidence": [*points[:, 2]]}}]
    for path in (tmp_path / "a.npz", written(tmp_path / "b.json", [people, people])):
        np.testing.assert_allclose(keypoints.load(path, fps=30).tracks[0].points[0], points, atol=1e-5)
