"""What 2-D pose detectors write, from points that are known: each format by hand from its documentation."""

import io
import json

import numpy as np

SIZE = (1280, 720)
FRAMES = 4


def points(count: int, people: int = 2, frames: int = FRAMES) -> np.ndarray:
    """People (T, P, K, 3) in pixels who move a little, 500 px apart; confidences from 0.6 to 0.95."""
    draw = np.random.default_rng(count)
    body = draw.uniform(0, (100, 200), (people, count, 2)) + 200 + 500 * np.arange(people)[:, None, None] * (1, 0)
    moved = body[None] + 3 * np.arange(frames)[:, None, None, None]
    sure = draw.uniform(0.6, 0.95, (frames, people, count, 1))
    return np.concatenate([moved, sure], -1).round(3)


def each(table: np.ndarray) -> list[tuple[int, list[list[list[float]]]]]:
    """(frame, people) of plain lists."""
    return list(enumerate(table.tolist()))


def flat(person: list[list[float]]) -> list[float]:
    return [x for point in person for x in point]


def openpose(count: int = 18, suffix: str = "") -> object:
    """One frame; version 1.0 wrote no _2d."""
    people = [{f"pose_keypoints{suffix}": flat(p)} for p in points(count, frames=1)[0].tolist()]
    return {"version": 1.0, "people": people}


def mmpose(count: int = 17, names: list[str] | None = None) -> object:
    def instance(person):
        return {
            "keypoints": [p[:2] for p in person],
            "keypoint_scores": [p[2] for p in person],
            "bbox": [[1, 2, 3, 4]],
            "bbox_score": 0.9,
        }

    first = 1 if names else 0  # the demo's script counts from 1
    frames = [
        {"frame_id": n + first, "instances": [instance(p) for p in people]} for n, people in each(points(count))
    ]  # fmt: skip
    if not names:
        return frames
    meta = {"dataset_name": "halpe26", "keypoint_id2name": {str(k): name for k, name in enumerate(names)}}
    return {"meta_info": meta, "instance_info": frames}


def alphapose(count: int = 26, tracked: bool = False) -> object:
    return [
        {"image_id": f"{n}.jpg", "category_id": 1, "keypoints": flat(p), "score": 2.9, "box": [1, 2, 3, 4],
         "idx": 7 + k if tracked else [0.0]}
        for n, people in each(points(count)) for k, p in enumerate(people)
    ]  # fmt: skip


def alphapose_images(form: str) -> object:
    """The formats cmu and open: people by image, 18 points."""
    keys = {"cmu": ("bodies", "joints"), "open": ("people", "pose_keypoints_2d")}[form]
    return {
        f"{n:05d}.png": {"version": "AlphaPose v0.3", keys[0]: [{keys[1]: flat(p)} for p in people]}
        for n, people in each(points(18))
    }


def coco() -> object:
    return [
        {"image_id": 10 + n, "category_id": 1, "keypoints": flat(p), "score": 0.8}
        for n, people in each(points(17)) for p in people
    ]  # fmt: skip


def ultralytics() -> object:
    """A list of what tojson() gives of every frame, with the tracker's ids."""

    def person(p, name):
        x, y, sure = zip(*p, strict=True)
        box = {"x1": 1.0, "y1": 2.0, "x2": 3.0, "y2": 4.0}
        found = {"name": "person", "class": 0, "confidence": 0.9, "box": box, "track_id": name}
        return found | {"keypoints": {"x": x, "y": y, "visible": sure}}

    return [[person(p, 5 + k) for k, p in enumerate(people)] for _, people in each(points(17))]  # fmt: skip


def yolo(frame: int = 0, tracked: bool = True) -> str:
    """One image's predictions: class, box, points as shares of the image; the box's confidence and the id."""
    rows = []
    for k, p in enumerate(points(17)[frame]):
        shares = p / (*SIZE, 1)
        low, high = shares[:, :2].min(0), shares[:, :2].max(0)
        rows.append("0 " + " ".join(f"{x:.9f}" for x in (*(low + high) / 2, *(high - low), *shares.ravel())))
        rows[-1] += f" 0.91 {k + 1}" if tracked else ""
    return "\n".join(rows)


def mediapipe() -> object:
    """One person's landmarks as shares of the image, in a frame that says its size and rate."""
    frames = [
        {"frame": n, "pose_landmarks": [
            {"x": x / SIZE[0], "y": y / SIZE[1], "z": -0.1, "visibility": sure} for x, y, sure in people[0]
        ]} for n, people in each(points(33))
    ]  # fmt: skip
    return {"fps": 25, "width": SIZE[0], "height": SIZE[1], "frames": frames}


def mediapipe_csv(names: list[str]) -> str:
    """A row per frame, time in milliseconds."""
    head = ["time", *(f"{axis}_{name.upper()}" for name in names for axis in ("X", "Y", "Z", "visibility"))]
    rows = [",".join(head)]
    for n, people in each(points(33)):
        cells = [f"{x / SIZE[0]:.9f},{y / SIZE[1]:.9f},-0.1,{sure}" for x, y, sure in people[0]]
        rows.append(f"{40 * n},{','.join(cells)}")
    return "\n".join(rows)


def movenet(names: list[str]) -> object:
    """Named points, in another order than COCO's."""
    return [
        {name: {"x": p[0], "y": p[1]} for name, p in sorted(zip(names, people[0], strict=True))}
        for _, people in each(points(17))
    ]


def vitpose(names: list[str]) -> object:
    """y, x, score; ids are texts."""
    frames = [
        {str(3 + k): [[y, x, sure] for x, y, sure in p] for k, p in enumerate(people)} for _, people in each(points(25))
    ]
    return {"keypoints": frames, "skeleton": {str(k): name for k, name in enumerate(names)}}


def long_csv(word: str = "person") -> str:
    """A line per point, without confidences."""
    lines = [f"frame,{word},keypoint,x,y"]
    for n, people in each(points(17)):
        lines += [f"{n},{k},{j},{x},{y}" for k, p in enumerate(people) for j, (x, y, _) in enumerate(p)]
    return "\n".join(lines)


def plain_arrays(names: list[str]) -> dict:
    return {
        "keypoints": points(17), "names": np.array(names), "fps": np.array(24.0), "size": np.array(SIZE),
        "ids": np.array([4, 9]), "first": np.array(100),
    }  # fmt: skip


def npz(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


SIDES = ("left", "right")
COCO = ["nose", *(f"{s}_{part}" for part in "eye ear shoulder elbow wrist hip knee ankle".split() for s in SIDES)]
#: MMPose's names of Halpe's 26 points, in configs/_base_/datasets/halpe26.py.
HALPE = [*COCO, "head", "neck", "hip", *(f"{s}_{part}" for part in ("big_toe", "small_toe", "heel") for s in SIDES)]
#: MediaPipe's PoseLandmark, in its order.
BLAZE = """nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear
mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky right_pinky
left_index right_index left_thumb right_thumb left_hip right_hip left_knee right_knee left_ankle right_ankle left_heel
right_heel left_foot_index right_foot_index""".split()
#: easy_ViTPose's coco_25: COCO with neck and hip in between, and feet.
VIT = [*COCO[:5], "neck", *COCO[5:13], "hip", *COCO[13:], *(f"{s}_{p}" for s in SIDES for p in ("big_toe", "small_toe", "heel"))]  # fmt: skip  # noqa: E501

#: name -> (content, layout's points, people, confidences are there, first frame)
FORMATS: dict[str, tuple[object, int, int, bool, int]] = {
    "openpose_1.0.json": (openpose(), 18, 2, True, 0),
    "openpose_135.json": (openpose(135, "_2d"), 135, 2, True, 0),
    "mmpose.json": (mmpose(), 17, 2, True, 0),
    "mmpose_meta.json": (mmpose(26, HALPE), 26, 2, True, 1),
    "alphapose.json": (alphapose(), 26, 2, True, 0),
    "alphapose_tracked.json": (alphapose(17, tracked=True), 17, 2, True, 0),
    "alphapose_cmu.json": (alphapose_images("cmu"), 18, 2, True, 0),
    "alphapose_open.json": (alphapose_images("open"), 18, 2, True, 0),
    "coco.json": (coco(), 17, 2, True, 10),
    "ultralytics.json": (ultralytics(), 17, 2, True, 0),
    "yolo.txt": (yolo(), 17, 2, True, 0),
    "mediapipe.json": (mediapipe(), 33, 1, True, 0),
    "mediapipe.csv": (mediapipe_csv(BLAZE), 33, 1, True, 0),
    "movenet.json": (movenet(COCO), 17, 1, False, 0),
    "vitpose.json": (vitpose(VIT), 25, 2, True, 0),
    "points.csv": (long_csv(), 17, 2, False, 0),
    "plain.npz": (npz(**plain_arrays(COCO)), 17, 2, True, 100),
}
_TEXTS = {name: what[0] if isinstance(what[0], str | bytes) else json.dumps(what[0]) for name, what in FORMATS.items()}
SEEDS = {name: text.encode() if isinstance(text, str) else text for name, text in _TEXTS.items()}
