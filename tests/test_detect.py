"""Keypoints from a video: rtmlib and onnxruntime on small networks made here, which find the brightest spot.

`make interop` installs the two and sets $MOTIONLAB_DETECT, so that nothing is skipped.
"""

import importlib
import os
import sys
from unittest.mock import Mock

import imageio.v2 as imageio
import numpy as np
import pytest

from motionlab.errors import DataError, MissingData, ShapeError
from motionlab.footage import clip, detect
from motionlab.io import keypoints
from motionlab.io.detections import HALPE_26
from motionlab.io.video import Video

WIDE, HIGH, FRAMES = 192, 256, 5  # of the network's input, and of the pictures
LEFTS, TOP = (30, 130), 100  # of two people who stand still


class Pictures(Video):
    """A bright square on black that moves; nothing in the third picture."""

    def pictures(self, wanted):
        for frame in wanted:
            picture = np.zeros((HIGH, WIDE, 3), np.uint8)
            if frame != 2:
                left, top = corner(frame)
                picture[top : top + 30, left : left + 30] = 255
            yield picture


def corner(frame: int) -> tuple[int, int]:
    return 40 + 10 * frame, 60 + 20 * frame


@pytest.fixture
def video(tmp_path) -> Video:
    return Pictures(tmp_path / "clip.mp4", 25.0, (WIDE, HIGH), FRAMES)


def extra(name: str):
    """A package of the extra ``detect``, or of its test."""
    if "MOTIONLAB_DETECT" in os.environ:
        return importlib.import_module(name)
    return pytest.importorskip(name, reason=f"no {name}: make interop")


def brightest(path) -> None:
    """A network of RTMPose's form: for each of 26 points the brightness of every half column and half row."""
    onnx = extra("onnx")
    make, kind = onnx.helper, onnx.TensorProto.FLOAT
    nodes, initial, outputs = [], [], []
    for axis, length, other in (("x", WIDE, 2), ("y", HIGH, 3)):
        spread = np.zeros((length, 26, 2 * length), np.float32)
        spread[np.arange(length), :, 2 * np.arange(length)] = 0.4
        initial += [
            onnx.numpy_helper.from_array(spread.reshape(length, -1), f"spread_{axis}"),
            make.make_tensor(f"shape_{axis}", onnx.TensorProto.INT64, (3,), (1, 26, 2 * length)),
            make.make_tensor(f"axes_{axis}", onnx.TensorProto.INT64, (2,), (1, other)),
        ]
        nodes += [
            make.make_node("ReduceMax", ["input", f"axes_{axis}"], [f"most_{axis}"], keepdims=0),
            make.make_node("MatMul", [f"most_{axis}", f"spread_{axis}"], [f"flat_{axis}"]),
            make.make_node("Reshape", [f"flat_{axis}", f"shape_{axis}"], [f"simcc_{axis}"]),
        ]
        outputs.append(make.make_tensor_value_info(f"simcc_{axis}", kind, (1, 26, 2 * length)))
    takes = [make.make_tensor_value_info("input", kind, (1, 3, HIGH, WIDE))]
    graph = make.make_graph(nodes, "brightest", takes, outputs, initial)
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 18)], ir_version=9)
    path.write_bytes(model.SerializeToString())


def people(path, size: int = 640) -> None:
    """A network of YOLOX's form: where ``Two`` has people, each sure where its half of the picture has white in it."""
    onnx = extra("onnx")
    make, kind, whole = onnx.helper, onnx.TensorProto.FLOAT, onnx.TensorProto.INT64
    scale, middle = size / HIGH, WIDE * size // HIGH // 2
    boxes = [scale * edge for left in LEFTS for edge in (left, TOP, left + 20, TOP + 40)]
    initial = [make.make_tensor("boxes", kind, (1, 2, 4), boxes), make.make_tensor("white", kind, (1,), [240.0])]
    for name, values in {"0": [0], "1": [middle], "2": [2 * middle], "columns": [3], "all": [1, 2, 3]}.items():
        initial.append(make.make_tensor(name, whole, (len(values),), values))
    nodes = []
    for half in (0, 1):
        nodes += [
            make.make_node("Slice", ["input", f"{half}", f"{half + 1}", "columns"], [f"half{half}"]),
            make.make_node("ReduceMax", [f"half{half}", "all"], [f"most{half}"]),
            make.make_node("Greater", [f"most{half}", "white"], [f"seen{half}"]),
            make.make_node("Cast", [f"seen{half}"], [f"score{half}"], to=kind),
        ]
    nodes += [
        make.make_node("Concat", ["score0", "score1"], ["scores4"], axis=1),
        make.make_node("Flatten", ["scores4"], ["scores2"]),
        make.make_node("Unsqueeze", ["scores2", "two"], ["scores"]),
        make.make_node("Concat", ["boxes", "scores"], ["people"], axis=2),
    ]
    initial.append(make.make_tensor("two", whole, (1,), [2]))
    takes = [make.make_tensor_value_info("input", kind, (1, 3, size, size))]
    gives = [make.make_tensor_value_info("people", kind, (1, 2, 5))]
    graph = make.make_graph(nodes, "people", takes, gives, initial)
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 18)], ir_version=9)
    path.write_bytes(model.SerializeToString())


class Two(Pictures):
    """Two bright bars, then the left one alone, then grey, in which a pose would be seen but no person, then both."""

    def pictures(self, wanted):
        for frame in wanted:
            picture = np.full((HIGH, WIDE, 3), 190 if frame == 2 else 0, np.uint8)
            for left in {1: LEFTS[:1], 2: ()}.get(frame, LEFTS):
                picture[TOP : TOP + 40, left : left + 20] = 255
            yield picture


def test_the_detector_that_is_installed_finds_two_people_by_networks_made_here(tmp_path, monkeypatch, capsys):
    rtmlib = extra("rtmlib")
    weights = rtmlib.BodyWithFeet.MODE["balanced"]
    assert (weights["det_input_size"], weights["pose_input_size"]) == ((640, 640), (WIDE, HIGH))
    folder = tmp_path / "hub/checkpoints"
    folder.mkdir(parents=True)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))  # where rtmlib looks before it downloads
    for name, write in (("det", people), ("pose", brightest)):
        write(folder / f"{weights[name].rpartition('/')[2].removesuffix('.zip')}.onnx")
    detect.find(Two(tmp_path / "clip.mp4", 25.0, (WIDE, HIGH), FRAMES), tmp_path / "keypoints.npz")
    assert not capsys.readouterr().out
    with np.load(tmp_path / "keypoints.npz") as found:
        table = found["keypoints"]
    assert table.shape == (FRAMES, 2, 26, 3)
    assert (table[..., 2] > 0).all(-1).sum(1).tolist() == [2, 1, 0, 2, 2]
    assert not (table[..., 2] > 0)[2].any()  # the pose network alone would see somebody in the grey
    for k, left in enumerate(LEFTS):
        seen = table[[0, 3, 4], k, :, :2]
        assert np.abs(seen - (left, TOP)).max() < 2, left


def test_people_of_every_frame_are_kept_in_pixels(tmp_path, video):
    def two(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert picture.shape == (HIGH, WIDE, 3)
        bright = np.argwhere(picture[..., 0] > 0)
        if not len(bright):
            return np.zeros((0, 26, 2)), np.zeros((0, 26))
        ramp = np.arange(26)[:, None] * np.array([[4.0, 6.0]])  # as large as a person
        scores = np.stack((np.full(26, 0.9), np.where(np.arange(26) < 5, 0.1, 0.8)))
        return np.stack((bright[0][::-1] + ramp, bright[0][::-1] + ramp + 300)), scores

    detect.find(video, tmp_path / "keypoints.npz", finder=two)
    found = keypoints.load(tmp_path / "keypoints.npz")
    assert found.names == HALPE_26 and [len(track.frames) for track in found.tracks] == [4, 4]
    assert {int((track.points[0, :, 2] == 0).sum()) for track in found.tracks} == {0, 5}  # unsure is not seen


def test_what_is_missing_is_said(tmp_path, video, monkeypatch):
    monkeypatch.setitem(sys.modules, "rtmlib", None)
    with pytest.raises(MissingData) as caught:
        detect.find(video, tmp_path / "keypoints.npz")
    for word in ("pip install -c constraints.txt -e '.[detect]'", "--keypoints", "OpenPose", "docs/own_footage.md"):
        assert word in str(caught.value)

    bare, damaged = "No module named 'onnxruntime'", "INVALID_PROTOBUF : Load model from yolox.onnx failed"
    for error, message in (
        (OSError("no route to host"), "OSError: no route to host.*to the network"),
        (ModuleNotFoundError(bare, name="onnxruntime"), rf"package.*{bare}.*pip install.* '\.\[detect\]'"),
        (RuntimeError(damaged), "yolox.onnx.*delete"),
    ):
        monkeypatch.setitem(sys.modules, "rtmlib", Mock(**{"BodyWithFeet.side_effect": error}))
        with pytest.raises(MissingData, match=message):
            detect.find(video, tmp_path / "keypoints.npz")
    with pytest.raises(DataError, match="nobody was found"):
        detect.find(video, tmp_path / "keypoints.npz", finder=lambda picture: (np.zeros((0, 26, 2)), np.zeros((0, 26))))
    with pytest.raises(ShapeError, match="26"):
        detect.find(video, tmp_path / "k.npz", finder=lambda picture: (np.zeros((1, 17, 2)), np.zeros((1, 17))))
    images = Pictures(tmp_path, None, (WIDE, HIGH), FRAMES)
    with pytest.raises(DataError, match="--fps"):
        detect.find(images, tmp_path / "keypoints.npz")
    assert not list(tmp_path.iterdir())


def test_keypoints_of_another_video_are_not_taken_for_those_of_this_one(tmp_path, monkeypatch):
    for name in ("a", "b"):
        imageio.mimwrite(tmp_path / f"{name}.mp4", [np.zeros((HIGH, WIDE, 3), np.uint8)] * FRAMES, fps=25)
    spots, found = np.arange(52).reshape(1, 26, 2) * 3.0, []
    monkeypatch.setattr(detect, "_rtmpose", lambda: lambda picture: found.append(1) or (spots, np.ones((1, 26))))
    out = tmp_path / "out"
    for name, count in (("a", FRAMES), ("a", FRAMES), ("b", 2 * FRAMES), ("b", 2 * FRAMES)):
        read = clip.open_clip(None, tmp_path / f"{name}.mp4", out=out)
        assert len(found) == count and read.footage.frames == FRAMES and (out / f"{name}_keypoints.npz").exists()
    assert any("earlier run" in note for note in read.notes)
