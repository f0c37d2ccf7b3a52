import json
from pathlib import Path

import numpy as np
import pytest

from motionlab.errors import DataError
from motionlab.io import keypoints
from motionlab.io.detections import LAYOUTS, to_body_25
from motionlab.observation import BODY_25
from tests.recorded import DATA, needs_data


def figure(names=BODY_25, height: float = 200.0) -> np.ndarray:
    """A standing person (K, 2) in pixels about the middle of the hips; face and fingers lie around the nose."""
    place = {"nose": (0, -0.9), "neck": (0, -0.7), "upper_neck": (0, -0.75), "head_top": (0, -1), "mid_hip": (0, 0)}
    rows = {"eye": (0.03, -0.93), "ear": (0.06, -0.91), "shoulder": (0.2, -0.7), "elbow": (0.25, -0.35)}
    rows |= {"wrist": (0.25, 0), "hip": (0.1, 0), "knee": (0.1, 0.5), "ankle": (0.1, 1), "big_toe": (0.12, 1.05)}
    rows |= {"foot_index": rows["big_toe"], "small_toe": (0.15, 1.05), "heel": (0.1, 1.03)}
    for part, (x, y) in rows.items():
        place |= {f"left_{part}": (x, y), f"right_{part}": (-x, y)}
    return np.array([place.get(name, (0, -0.9)) for name in names]) * height / 2


def write(folder: Path, frames: dict[int, list[np.ndarray]], name="clip_{:012d}_keypoints.json") -> Path:
    """One file per frame number; people are (K, 3)."""
    folder.mkdir(exist_ok=True)
    for number, people in frames.items():
        entries = [{"person_id": [-1], "pose_keypoints_2d": p.reshape(-1).round(3).tolist()} for p in people]
        (folder / name.format(number)).write_text(json.dumps({"version": 1.3, "people": entries}))
    return folder


def person(x: float, y: float = 300.0, confidence: float = 0.8, names=BODY_25, height: float = 200.0) -> np.ndarray:
    points = figure(names, height) + np.array([x, y])
    return np.concatenate([points, np.full((len(points), 1), confidence)], axis=1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_are_told_apart_and_mapped_by_name(tmp_path, layout):
    names = LAYOUTS[layout]
    folder = write(tmp_path / "a", {n: [person(100 + n, names=names)] for n in range(3)})
    observed = keypoints.load_person(folder, fps=30)
    assert observed.names == names
    full = to_body_25(observed)
    for k, name in enumerate(BODY_25):
        if name in names or name.replace("big_toe", "foot_index") in names:
            expected = figure([name])[0] + np.array([100, 300])
            np.testing.assert_allclose(full.keypoints[0, k].numpy(), expected, atol=1e-3)
        elif name not in ("neck", "mid_hip"):
            assert (full.confidence[:, k] == 0).all() and (full.keypoints[:, k] == 0).all()
    np.testing.assert_allclose(full.keypoints[0, full.index("mid_hip")].numpy(), (100, 300), atol=1e-3)
    assert (full.confidence[:, full.index("neck")] > 0).all()


def test_25_points_without_a_face_are_refused_unless_the_layout_is_given(tmp_path):
    faceless = person(100)
    faceless[[0, 15, 16, 17, 18], 2] = 0
    folder = write(tmp_path / "a", {0: [faceless]})
    with pytest.raises(DataError, match="layout cannot be told"):
        keypoints.load_person(folder, fps=30)
    assert keypoints.load_person(folder, fps=30, layout="BODY_25").frames == 1


def test_frames_are_ordered_by_number_and_gaps_are_empty(tmp_path):
    folder = write(tmp_path / "a", {n: [person(100 + n)] for n in (8, 9, 10, 12)}, name="cam.{}.json")
    observed = keypoints.load_person(folder, fps=30)
    nose = observed.keypoints[:, 0, 0].tolist()
    assert observed.frames == 5
    assert [round(x) for x in nose] == [108, 109, 110, 0, 112]
    assert observed.confidence[3].sum() == 0


def test_files_named_otherwise_do_not_join_the_series(tmp_path):
    folder = write(tmp_path / "a", {n: [person(100)] for n in range(4)}, name="cam.{:04d}.json")
    write(folder, {n: [] for n in range(2)}, name="del_{:06d}.json")
    (folder / "meta.json").write_text("not json")
    assert keypoints.load_person(folder, fps=30).frames == 4
    write(folder, {n: [] for n in range(4)}, name="del_{:06d}.json")
    with pytest.raises(DataError, match="several series"):
        keypoints.load_person(folder, fps=30)


@needs_data
def test_nobody_is_swapped_in_the_real_crowd():
    """Ten people, unordered. The picture itself shifts by some 60 px between the first two frames."""
    folder = DATA / "openpose_crowd"
    for place in range(10):
        observed = keypoints.load_person(folder, fps=30, person=place)
        if observed.visible.any(-1).sum() < 10:
            continue  # one false detection in the first frame
        neck = observed.index("neck")
        both = observed.visible[1:, neck] & observed.visible[:-1, neck]
        steps = observed.keypoints[:, neck].diff(dim=0).norm(dim=-1)[both]
        assert steps.median() < 5 and steps[1:].max() < 30
        assert observed.visible.any(-1).all()


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("layout", [None, "BODY_25"])
def test_people_without_any_confidence_are_nobody(tmp_path, count, layout):
    ghosts = [person(100 * n, confidence=0) for n in range(count)]
    with pytest.raises(DataError, match="nobody was detected in any frame: no point is sure enough"):
        keypoints.load_person(write(tmp_path / "a", {0: ghosts, 1: ghosts}), fps=30, layout=layout)
