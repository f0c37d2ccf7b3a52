"""How much a fit must know of its camera: the same clips with less and less of it.

Errors are measured in the axes of the camera, where the true and the found world agree whatever is known of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from data_synth.scenes import Scene
from motionlab import metrics, rotation
from motionlab.footage.fit import pixel_distances, pixels_of
from motionlab.humor.energies import RGB_LIGHT
from motionlab.humor.evidence import evidence
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from studies.nb05_testops import tuning
from studies.nb05_testops.cast import Filmed
from studies.nb05_testops.measures import CM

TILT, RISE = 3.0, 0.05  # standard deviations, degrees and metres, of a camera that was placed by eye
Methods = Mapping[str, Mapping[str, Tensor]]  # method -> measure -> numbers (P,)
_HEADS = {"own bones": "on its own bones, cm", "place": "place, cm", "ratio": "pixels / truth's",
          "acceleration": "acceleration off, m/s²"}  # fmt: skip


def placed_by_eye(camera: Camera, generator: torch.Generator) -> Camera:
    """Turns a camera about its centre by a random rotation of ``TILT`` an axis and lifts it by ``RISE``."""
    turn = rotation.exp(torch.deg2rad(TILT * torch.randn(3, generator=generator))).to(camera.rotation) @ camera.rotation
    centre = camera.centre + camera.centre.new_tensor([0, 0, 1]) * RISE * torch.randn(1, generator=generator).item()
    return replace(camera, rotation=turn, translation=-turn @ centre)


def knowledge(cameras: Sequence[Camera], generator: torch.Generator) -> dict[str, dict[str, object]]:
    """Returns arguments of ``testops.fit`` by what is known, from everything to nothing."""
    nothing = {"cameras": [None] * len(cameras), "size": (cameras[0].width, cameras[0].height)}
    return {
        "camera and floor": {"cameras": cameras, "floor": "camera"},
        "placed by eye": {"cameras": [placed_by_eye(c, generator) for c in cameras], "floor": "refine"},
        "the lens only": {"cameras": cameras, "floor": "guess"}, "image size only": nothing,
    }  # fmt: skip


def start_cameras(observation: Observation2D, **given: object) -> list[Camera]:
    """Returns the cameras that a fit starts from, and keeps until stage 3 moves them; arguments as of ``fit``."""
    seen = evidence(observation, **given)
    return seen.view.cameras(seen.values.new_zeros(len(seen.values), 3))


def in_camera(cameras: Sequence[Camera], points: Tensor) -> Tensor:
    """Computes world points (G, T, K, 3) in the axes of each view's camera."""
    turn, shift = (torch.stack([getattr(c, n) for c in cameras]).to(points) for n in ("rotation", "translation"))
    return points @ turn[:, None].mT + shift[:, None, None]


def errors(motion: Motion, cameras: Sequence[Camera], scene: Scene) -> dict[str, Tensor]:
    """Computes errors (B,) of a fit in cm, in the axes of the camera.

    "root": on the true bones, the pelvis put on the true one. "none": as it stands before the camera.
    """
    there, made = in_camera(scene.cameras, scene.truth.positions), tuning.on_true_bones(motion, scene.truth)
    found = {"root": in_camera(cameras, made.positions), "none": in_camera(cameras, motion.positions)}
    return {align: CM * metrics.mpjpe(points, there, align=align) for align, points in found.items()}


def compared(
    shot: Filmed, priors: Priors, schedule: Schedule, chosen: tuning.Choice, generator: torch.Generator
) -> dict[str, dict[str, dict[str, Tensor]]]:
    """Fits people with less and less known of the camera.

    Returns by "root" and "none" (:func:`errors`), by what is known, and by method, numbers (P,).
    """
    found, seen = {"root": {}, "none": {}}, shot.scene.observation
    for name, given in knowledge(shot.scene.cameras, generator).items():
        two = tuning.stage_2(seen, priors, RGB_LIGHT, schedule, chosen, **given)
        three = fit(seen, priors, schedule=schedule, **given)
        off = {
            "tuned stage 2": errors(two, start_cameras(seen, **given), shot.scene),
            "stage 3": errors(three.motion, three.cameras, shot.scene),
        }
        for align, by in found.items():
            by[name] = {method: shot.people.mean(numbers[align]) for method, numbers in off.items()}
    return found


# ------------------------------------------------------------------------------------------------------- the plain view
def misses(pixels: Tensor, seen: Observation2D) -> Tensor:
    """Computes the mean distance (G,) of points (G, T, 25, 2) from the detections in pixels, weighted by confidence."""
    away, weight = pixel_distances(pixels, seen)
    return (away * weight).sum((-1, -2)) / weight.sum((-1, -2))


def scores(motion: Motion, shot: Filmed) -> dict[str, Tensor]:
    """Measures a fit by a known camera, a number (P,) a person.

    "pose": cm, on the true bones, the pelvis put on the true one; "own bones": on those that were fitted. "place": cm,
    as it stands. "ratio": pixels off the detections over the truth's own distance from them. "acceleration": error,
    m/s^2.
    """
    scene, p, t = shot.scene, motion.positions, shot.scene.truth.positions
    made = tuning.on_true_bones(motion, scene.truth).positions
    px = misses(pixels_of(motion, list(scene.cameras)), scene.observation)
    found = {"pose": CM * metrics.mpjpe(made, t, align="root"), "own bones": CM * metrics.mpjpe(p, t, align="root")}
    found |= {"place": CM * metrics.mpjpe(p, t, align="none")}
    found |= {"ratio": px / misses(scene.pixels, scene.observation)}
    found |= {"acceleration": metrics.acceleration_error(p, t, scene.truth.fps)}
    return {name: shot.people.mean(values) for name, values in found.items()}


def score_rows(plain: Mapping[str, Methods], generator: torch.Generator) -> list[dict[str, object]]:
    """Returns a row per source and method: means over people, of the pose with its interval."""
    return [
        {"people": f"{source} ({len(found['pose'])})", "after": method}
        | {"pose, cm": "{:.1f} [{:.1f}, {:.1f}]".format(*metrics.interval(found["pose"], "mean", generator))}
        | {head: found[name].mean().item() for name, head in _HEADS.items()}
        for source, by in plain.items()
        for method, found in by.items()
    ]


def gains(
    plain: Mapping[str, Methods], chosen: Mapping[str, tuning.Choice], generator: torch.Generator
) -> list[dict[str, object]]:
    """Returns a row per source: what stage 2 was tuned to, and what stage 3 gains over it with its 95 % interval."""
    rows = []
    for source, by in plain.items():
        two, three = (by[method]["pose"] for method in ("tuned stage 2", "stage 3"))
        row = {"people": f"{source} ({len(three)})", "stage 2 is tuned to": tuning.said(chosen[source])}
        rows.append(row | {"stage 3 less the tuned stage 2: pose, cm": metrics.paired(three, two, generator)})
    return rows


def knowledge_rows(found: Mapping[str, Methods], generator: torch.Generator) -> list[dict[str, object]]:
    """Returns a row by what is known of the camera: errors in pose and in place, and what the pose loses."""
    rows, most = [], found["root"]["camera and floor"]["stage 3"]
    for name, by in found["root"].items():
        place, three = found["none"][name], by["stage 3"]
        rows.append({
            "known": name, "stage 3: pose, cm": f"{three.mean():.1f}",
            "more than with all known": "" if three is most else metrics.paired(three, most, generator),
            "place, cm": f"{place['stage 3'].mean():.0f}",
            "tuned stage 2: pose, cm": f"{by['tuned stage 2'].mean():.1f}",
            "its place, cm": f"{place['tuned stage 2'].mean():.0f}",
        })  # fmt: skip
    return rows
