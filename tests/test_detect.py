"""Keypoints from a video: rtmlib and onnxruntime on a small network made here, which finds the brightest spot."""

import sys

import numpy as np
import pytest

from motionlab import detect
from motionlab.errors import DataError, MissingData, ShapeError
from motionlab.io import keypoints
from motionlab.io.layouts import HALPE_26
from motionlab.io.video import Video

WIDE, HIGH, FRAMES = 192, 256, 5  # of the network's input, and of the pictures


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


def brightest(path) -> None:
    """A network of RTMPose's form: for each of 26 points the brightness of every half column and half row."""
    onnx = pytest.importorskip("onnx")
    make, kind = onnx.helper, onnx.TensorProto.FLOAT
    nodes, initial, outputs = [], [], []
    for axis, length, other in (("x", WIDE, 2), ("y", HIGH, 3)):
        spread = np.zeros((length, 26, 2 * length), np.float32)
        spread[np.arange(length), :, 2 * np.arange(length)] = 0.4
        initial += [
            make.make_tensor(f"spread_{axis}", kind, (length, 26 * 2 * length), spread.ravel()),
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


def test_a_network_finds_what_moves(tmp_path, video):
    pytest.importorskip("onnxruntime")
    rtmlib = pytest.importorskip("rtmlib")
    brightest(tmp_path / "small.onnx")
    network = rtmlib.RTMPose(str(tmp_path / "small.onnx"), (WIDE, HIGH), backend="onnxruntime")
    detect.find(video, tmp_path / "keypoints.npz", finder=network)
    found = keypoints.load(tmp_path / "keypoints.npz")
    assert (found.fps, found.size, found.frames) == (25.0, (WIDE, HIGH), FRAMES)
    track = found.tracks[0]
    assert track.frames.tolist() == [0, 1, 3, 4]  # the empty picture is no person
    for frame, points in zip(track.frames, track.points, strict=True):
        assert np.abs(points[:, :2] - corner(frame)).max() < 3  # the square's upper left corner, to two cells


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
    for word in ("pip install 'motionlab[detect]'", "--keypoints", "OpenPose", "MMPose", "AlphaPose", "--write_json"):
        assert word in str(caught.value)

    class Offline:
        def BodyWithFeet(self, **how):
            raise OSError("no route to host")

    monkeypatch.setitem(sys.modules, "rtmlib", Offline())
    with pytest.raises(MissingData, match="no route to host"):
        detect.find(video, tmp_path / "keypoints.npz")
    with pytest.raises(DataError, match="nobody was found"):
        detect.find(video, tmp_path / "keypoints.npz", finder=lambda picture: (np.zeros((0, 26, 2)), np.zeros((0, 26))))
    with pytest.raises(ShapeError, match="26"):
        detect.find(video, tmp_path / "k.npz", finder=lambda picture: (np.zeros((1, 17, 2)), np.zeros((1, 17))))
    images = Pictures(tmp_path, None, (WIDE, HIGH), FRAMES)
    with pytest.raises(DataError, match="--fps"):
        detect.find(images, tmp_path / "keypoints.npz")
    assert not list(tmp_path.iterdir())
