"""Captury's takes: somebody falls, sits down to lie, and turns; four calibrated cameras, exact projections, 50 fps."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.humor.energies import KEYPOINTS
from motionlab.humor.evidence import Observation3D
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.io.cameras import load_cameras
from motionlab.motion import FPS, Motion
from motionlab.observation import BODY_25, Camera, Observation2D, at_rate
from motionlab.skeleton import STANDARD
from motionlab.viz.movie import strip
from studies.nb05_testops.recordings import COMPARED, HIPS, compared
from studies.shared import captury
from studies.shared.clips import part, stacked

#: What is shown, from which second on of which take.
MOMENTS = {
    "falls": ("video-02-epic-fall", 7.8), "goes down to sit": ("video-09-meditation", 3.6),
    "sits on the floor": ("video-09-meditation", 6.5), "turns": ("video-05-turn", 4.0),
}  # fmt: skip
SHOWN = ("tuned stage 2", "stage 3")
#: BODY_25's points as Captury names them; the mean of several.
_POINTS = {"nose": ("Nose",), "neck": ("Neck",), "mid_hip": ("Hips",)} | {
    f"{side}_{part}": tuple(f"{side.capitalize()}{name}" for name in names)
    for side in ("left", "right")
    for part, names in {
        "shoulder": ("Arm",), "elbow": ("ForeArm",), "wrist": ("Hand",), "hip": ("UpLeg",), "knee": ("Leg",),
        "ankle": ("Foot",), "eye": ("Eye",), "ear": ("Ear",), "heel": ("HeelOuter", "HeelInner"),
        "big_toe": ("FootEEInner",), "small_toe": ("FootEEOuter",),
    }.items()
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Moments:
    """Two seconds of each moment from every camera: keypoints (G, T, 25, 2), a camera each, joints (G, T, 12, 3).

    names: the moment of each of the G views; views of one moment lie together.
    """

    observation: Observation2D
    cameras: list[Camera]
    reference: Tensor
    names: tuple[str, ...]


def moments(folder: Path | str, *, frames: int = 60, views: int = 4) -> Moments:
    """Reads the moments of Captury's takes at 30 fps, by so many of their cameras."""
    seen, cameras, joints, names = [], [], [], []
    for name, (take, start) in MOMENTS.items():
        place, first = Path(folder) / take, round(start * FPS)
        there = captury.joints(place / "biomech.csv", COMPARED.values())
        at = (first + torch.arange(frames)) * (50.0 / FPS)  # joints at 30 fps, linear between
        low = at.floor().long().clamp(max=len(there) - 2)
        share = (at - low)[:, None, None]
        for index, camera in enumerate([*load_cameras(place / "camera.calib").values()][:views]):
            table = projected(place / f"projected{index:02}.csv", camera)
            seen.append(part(at_rate(_as_body_25(table)), slice(first, first + frames)))
            cameras.append(camera), joints.append(torch.lerp(there[low], there[low + 1], share)), names.append(name)
    return Moments(stacked(seen, camera=None), cameras, torch.stack(joints), tuple(names))


def projected(path: Path, camera: Camera) -> Observation2D:
    """Reads the joints as projected into a camera: exact, in image widths; confidence 1 in the image, 0 outside."""
    head, *rows = [line.split(",") for line in path.read_text().splitlines() if line.strip()]
    names = tuple(name.strip() for name in head[1::2] if name.strip())
    table = np.array([row[1 : 1 + 2 * len(names)] for row in rows], np.float32)
    pixels = torch.from_numpy(table).double().unflatten(-1, (-1, 2)) * camera.width
    inside = ((pixels >= 0) & (pixels < torch.tensor([camera.width, camera.height]))).all(-1)
    pixels = torch.where(inside[..., None], pixels, 0.0).float()
    return Observation2D(pixels, inside.float(), names, captury.FPS, camera, f"{path.parent.name} {path.stem}")


def _as_body_25(table: Observation2D) -> Observation2D:
    rows = [[table.index(name) for name in _POINTS[point]] for point in BODY_25]
    keypoints = torch.stack([table.keypoints[:, some].mean(1) for some in rows], 1)
    confidence = torch.stack([table.confidence[:, some].amin(1) for some in rows], 1)
    return replace(table, keypoints=keypoints, confidence=confidence, names=BODY_25)


def over_time(motion: Motion, truth: Tensor) -> Tensor:
    """Computes the error (G, T) in cm of the twelve joints, the middle of the hips put on the true one."""
    centred = [x - x[..., HIPS, :].mean(-2, keepdim=True) for x in (compared(motion), truth)]
    return 100 * (centred[0] - centred[1]).norm(dim=-1).mean(-1)


def panels(curves: Mapping[str, Tensor], names: tuple[str, ...]) -> dict[str, dict[str, Tensor]]:
    """Returns by moment and method in ``SHOWN`` the errors over time (V, T) of its views."""
    mine = {moment: [k for k, name in enumerate(names) if name == moment] for moment in dict.fromkeys(names)}
    return {moment: {name: curves[name][some] for name in SHOWN} for moment, some in mine.items()}


def person(taken: Moments, view: int, priors: Priors, schedule: Schedule) -> Motion:
    """Computes a body (T) on the true joints of a view's moment, by a stage 2 that sees these in three dimensions."""
    rows = STANDARD.indices(list(COMPARED))
    points = torch.zeros(*taken.reference.shape[1:2], len(STANDARD), 3)
    points[:, rows], seen = taken.reference[view], torch.zeros(points.shape[:2], dtype=torch.bool)
    seen[:, rows] = True
    shown = Observation3D(points[None], seen[None], FPS)
    return fit(shown, priors, weights=KEYPOINTS, schedule=schedule.without_stage_3()).stages[2].clip(0)


def pictured(ways: Mapping[str, Motion], true: Motion, view: int, body: BodyModel) -> np.ndarray:
    """Draws the person and both fits of one view on the floor, four poses through time, the person as a ghost."""
    fits = {name: ways[name].clip(view) for name in SHOWN}
    roles = {"the person": "truth", "tuned stage 2": "stage2", "stage 3": "stage3"}
    return strip({"the person": true} | fits, 4, roles=roles, body=body, ghost=true)


def ends(curves: Mapping[str, Tensor], names: tuple[str, ...]) -> list[dict[str, object]]:
    """Returns a row per moment: the mean error in cm over its last quarter, all views, of the methods in ``SHOWN``."""
    return [
        {"moment": moment} | {f"{name}, cm": x[:, -(x.shape[1] // 4) :].mean().item() for name, x in some.items()}
        for moment, some in panels(curves, names).items()
    ]
