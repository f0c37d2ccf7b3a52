"""What 2-D pose detectors write, from points that are known: each format by hand from its documentation."""

import io
import json

import numpy as np

SIZE, FRAMES, SIDES = (1280, 720), 4, ("left", "right")
COCO = ["nose", *(f"{s}_{part}" for part in "eye ear shoulder elbow wrist hip knee ankle".split() for s in SIDES)]
#: MMPose's names of Halpe's 26 points, in configs/_base_/datasets/halpe26.py.
HALPE = [*COCO, "head", "neck", "hip", *(f"{s}_{part}" for part in ("big_toe", "small_toe", "heel") for s in SIDES)]
#: MediaPipe's PoseLandmark, in its order.
BLAZE = """nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear
mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky right_pinky
left_index right_index left_thumb right_thumb left_hip right_hip left_knee right_knee left_ankle right_ankle left_heel
right_heel left_foot_index right_foot_index""".split()
#: easy_ViTPose's coco_25: COCO with neck and hip in between, and feet.
FEET = [f"{side}_{part}" for side in SIDES for part in ("big_toe", "small_toe", "heel")]
VIT = [*COCO[:5], "neck", *COCO[5:13], "hip", *COCO[13:], *FEET]


def points(count: int, people: int = 2, frames: int = FRAMES) -> np.ndarray:
    """People (T, P, K, 3) in pixels who move a little, 500 px apart; confidences from 0.6 to 0.95."""
    draw = np.random.default_rng(count)
    body = draw.uniform(0, (100, 200), (people, count, 2)) + 200 + 500 * np.arange(people)[:, None, None] * (1, 0)
    moved = body[None] + 3 * np.arange(frames)[:, None, None, None]
    sure = draw.uniform(0.6, 0.95, (frames, people, count, 1))
    return np.concatenate([moved, sure], -1).round(3)


def flat(person: list[list[float]]) -> list[float]:
    return [x for point in person for x in point]


def openpose(count: int, suffix: str = "") -> dict:
    """One frame; version 1.0 wrote no _2d."""
    return {"people": [{f"pose_keypoints{suffix}": flat(p)} for p in points(count, frames=1)[0].tolist()]}


def mmpose(count: int = 17, names: list[str] | None = None) -> list | dict:
    """Frames from 0; with names as the demo's script writes it, from 1."""
    frames = []
    for n, people in enumerate(points(count).tolist(), start=1 if names else 0):
        found = [{"keypoints": [q[:2] for q in p], "keypoint_scores": [q[2] for q in p]} for p in people]
        frames.append({"frame_id": n, "instances": [one | {"bbox": [[1, 2, 3, 4]]} for one in found]})
    meta = {"dataset_name": "h36m", "keypoint_id2name": {str(k): name for k, name in enumerate(names or [])}}
    return {"meta_info": meta, "instance_info": frames} if names else frames


def results(count: int, image: str = "", ids: list | None = None, first: int = 0) -> list:
    """AlphaPose's and COCO's: a list of people with their image, "1.jpg" or 1; AlphaPose's has an idx."""
    return [
        {"image_id": f"{n}{image}" if image else n, "category_id": 1, "keypoints": flat(p), "score": 2.9}
        | ({"idx": ids[k], "box": [1, 2, 3, 4]} if ids else {})
        for n, people in enumerate(points(count).tolist(), start=first) for k, p in enumerate(people)
    ]  # fmt: skip


def by_image(people: str, person: str) -> dict:
    """AlphaPose's formats cmu and open: people by image, 18 points."""
    frames = [{people: [{person: flat(p)} for p in frame], "version": "v0.3"} for frame in points(18).tolist()]
    return {f"{n:05d}.png": frame for n, frame in enumerate(frames)}


def ultralytics() -> list:
    """What tojson() gives of every frame, with the tracker's ids."""
    frames = [[zip(*p, strict=True) for p in frame] for frame in points(17).tolist()]
    keypoints = [[dict(zip(("x", "y", "visible"), map(list, p), strict=True)) for p in frame] for frame in frames]
    more = {"name": "person", "class": 0, "confidence": 0.9, "box": {"x1": 1.0, "y1": 2.0, "x2": 3.0, "y2": 4.0}}
    return [[{**more, "track_id": 5 + k, "keypoints": p} for k, p in enumerate(frame)] for frame in keypoints]


def yolo(frame: int = 0) -> str:
    """One image's predictions: class, box, points as shares of the image; the box's confidence and the id."""
    rows = []
    for k, p in enumerate(points(17)[frame] / (*SIZE, 1)):
        low, high = p[:, :2].min(0), p[:, :2].max(0)
        numbers = " ".join(f"{x:.9f}" for x in (*(low + high) / 2, *(high - low), *p.ravel()))
        rows.append(f"0 {numbers} 0.91 {k + 1}")
    return "\n".join(rows)


def mediapipe() -> dict:
    """One person's landmarks as shares of the image, with its size and rate."""
    shares = (points(33)[:, 0] / (*SIZE, 1)).tolist()
    marks = [[{"x": x, "y": y, "z": -0.1, "visibility": sure} for x, y, sure in frame] for frame in shares]
    frames = [{"frame": n, "pose_landmarks": frame} for n, frame in enumerate(marks)]
    return {"fps": 25, "width": SIZE[0], "height": SIZE[1], "frames": frames}


def mediapipe_csv() -> str:
    """A row per frame, time in milliseconds; as in a real file, one name is there twice."""
    names = ["right_eye_outer" if name == "right_eye_inner" else name for name in BLAZE]
    rows = [",".join(["time", *(f"{axis}_{name.upper()}" for name in names for axis in ("X", "Y", "Z", "visibility"))])]
    for n, frame in enumerate(points(33)[:, 0] / (*SIZE, 1)):
        rows.append(f"{40 * n}," + ",".join(f"{x:.9f},{y:.9f},-0.1,{sure}" for x, y, sure in frame))
    return "\n".join(rows)


def movenet() -> list:
    """Named points, in another order than COCO's."""
    named = [sorted(zip(COCO, people[0], strict=True)) for people in points(17).tolist()]
    return [{name: {"x": p[0], "y": p[1]} for name, p in frame} for frame in named]


def vitpose() -> dict:
    """y, x, score; ids are texts."""
    frames = [{str(3 + k): [[y, x, c] for x, y, c in p] for k, p in enumerate(f)} for f in points(25).tolist()]
    return {"keypoints": frames, "skeleton": {str(k): name for k, name in enumerate(VIT)}}


def long_csv() -> str:
    """A line per point, without confidences."""
    rows = [",".join(map(str, (*place, *points(17)[place][:2]))) for place in np.ndindex(FRAMES, 2, 17)]
    return "\n".join(["frame,person,keypoint,x,y", *rows])


def trc(table: np.ndarray, names: list[str], unit: float = 1.0) -> str:
    """As Sports2D writes it, in pixels though it says m: blank where a point (T, K, 2) was not seen."""
    head = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"]
    head += [f"25\t25\t{len(table)}\t{len(names)}\tm", "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t"]
    head.append("\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ"))
    rows = [
        f"{n}\t{n / 25:.3f}\t" + "\t".join("\t\t" if x == 0 else f"{x * unit:.4f}\t{y * unit:.4f}\t0.0" for x, y in row)
        for n, row in enumerate(table)
    ]
    return "\n".join([*head, "", *rows]) + "\n"


def plain_arrays() -> dict:
    more = {"names": COCO, "fps": 24.0, "size": SIZE, "ids": [4, 9]}
    return {"keypoints": points(17), **{key: np.array(value) for key, value in more.items()}}


def npz(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


#: name -> (content, layout's points, people, first frame)
FORMATS: dict[str, tuple[object, int, int, int]] = {
    "openpose_1.0.json": (openpose(18), 18, 2, 0),
    "openpose_135.json": (openpose(135, "_2d"), 135, 2, 0),
    "mmpose.json": (mmpose(), 17, 2, 0),
    "mmpose_meta.json": (mmpose(26, HALPE), 26, 2, 1),
    "alphapose.json": (results(26, ".jpg", [[0.0], [0.0]]), 26, 2, 0),
    "alphapose_tracked.json": (results(17, ".jpg", [7, 8]), 17, 2, 0),
    "alphapose_cmu.json": (by_image("bodies", "joints"), 18, 2, 0),
    "alphapose_open.json": (by_image("people", "pose_keypoints_2d"), 18, 2, 0),
    "coco.json": (results(17, first=10), 17, 2, 10),
    "ultralytics.json": (ultralytics(), 17, 2, 0),
    "yolo.txt": (yolo(), 17, 2, 0),
    "mediapipe.json": (mediapipe(), 33, 1, 0),
    "mediapipe.csv": (mediapipe_csv(), 33, 1, 0),
    "movenet.json": (movenet(), 17, 1, 0),
    "vitpose.json": (vitpose(), 25, 2, 0),
    "points.csv": (long_csv(), 17, 2, 0),
    "sports2d.trc": (trc(points(17)[:, 0, :, :2], COCO), 17, 1, 0),
    "plain.npz": (npz(**plain_arrays()), 17, 2, 0),
}
#: Formats without confidences.
UNSCORED = ("movenet.json", "points.csv", "sports2d.trc")
_TEXTS = {name: what[0] if isinstance(what[0], str | bytes) else json.dumps(what[0]) for name, what in FORMATS.items()}
SEEDS = {name: text.encode() if isinstance(text, str) else text for name, text in _TEXTS.items()}
