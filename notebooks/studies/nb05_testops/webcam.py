"""A webcam of which nothing is known: its pitch as an unknown, and whether the fit stands and moves as people do."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import torch
from torch import Tensor

from data_synth import scenes
from data_synth.scenes import Scene
from motionlab import rotation
from motionlab.baselines import savitzky_golay
from motionlab.footage.fit import pixels_of
from motionlab.humor.evidence import ASSUMED_HEIGHT, LEVEL
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule, fit
from motionlab.io import openpose
from motionlab.motion import FPS, Motion
from motionlab.observation import Camera, Observation2D
from studies.nb05_testops.camera_knowledge import misses
from studies.nb05_testops.filmed_people import People
from studies.shared.clips import part

SMOOTHED = 9  # frames of the filter over detections whose speed is measured
#: Shares of the body's mass, put on the 22 joints; a limb's half at either end.
#: Source: de Leva 1996, rounded, men and women alike.
_MASS = {"head": 0.07, "spine3": 0.16, "spine2": 0.1, "spine1": 0.07, "pelvis": 0.1} | {
    f"{side}_{joint}": share
    for side in ("left", "right")
    for joint, share in (("shoulder", 0.014), ("elbow", 0.022), ("wrist", 0.014), ("hip", 0.072), ("knee", 0.092),
                         ("ankle", 0.022), ("foot", 0.014))
}  # fmt: skip
_FEET = ("left_ankle", "left_foot", "right_ankle", "right_foot")


def clips(folder: Path | str, starts: Sequence[int], frames: int) -> Observation2D:
    """Reads clips (G, T) of a webcam recording of 3Dance, 30 fps presumed."""
    return part(openpose.load(folder, fps=FPS, layout="BODY_25"), torch.tensor(starts)[:, None] + torch.arange(frames))


def pitched(size: tuple[int, int], degrees: float) -> Camera:
    """Returns the camera that is assumed where nothing is known, looking so many degrees down."""
    width, height = size
    focal = (width**2 + height**2) ** 0.5
    lens = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    turn = rotation.exp(torch.deg2rad(torch.tensor([degrees, 0.0, 0.0]))) @ LEVEL
    return Camera(lens, turn, -turn @ torch.tensor([0.0, 0.0, ASSUMED_HEIGHT]), width, height)


def pitch_of(camera: Camera) -> float:
    """Computes how many degrees a camera looks down."""
    return -torch.rad2deg(torch.asin(camera.rotation[2, 2])).item()


def at_pitches(
    seen: Observation2D, size: tuple[int, int], priors: Priors, schedule: Schedule, pitches: Sequence[float],
    lens: Sequence[Camera] | None = None,
) -> dict[float, Fitted]:  # fmt: skip
    """Fits clips (G, T) once from every pitch; stage 3 may then move the camera.

    lens: cameras whose focal length is known, and the size of whose image.
    """
    lenses = lens or [pitched(size, 0.0)] * len(seen.keypoints)
    turned = {d: [replace(pitched(size, d), intrinsics=known.intrinsics) for known in lenses] for d in pitches}
    how = {"floor": "refine", "schedule": schedule}
    return {degrees: fit(seen, priors, cameras=cameras, **how) for degrees, cameras in turned.items()}


# ------------------------------------------------------------------------------------------------------------- balance
def off_balance(motion: Motion) -> Tensor:
    """Computes the horizontal distance (..., T) in cm of the centre of mass from the hull of both feet.

    The centre of mass is a weighted mean of joints (``_MASS``); the hull is that of ankles and balls, lifted or not.
    """
    names, points = motion.skeleton.names, motion.positions[..., :2]
    share = torch.tensor([_MASS.get(name, 0.0) for name in names])
    centre = torch.einsum("...jd,j->...d", points, share / share.sum())
    return 100 * from_hull(centre, points[..., motion.skeleton.indices(list(_FEET)), :])


def from_hull(point: Tensor, corners: Tensor) -> Tensor:
    """Computes the distance (...) of a point (..., 2) from the convex hull of corners (..., N, 2); 0 inside."""
    count, here = corners.shape[-2], point[..., None, :]
    a, b = (corners[..., list(i), :] for i in zip(*combinations(range(count), 2), strict=True))
    along, way = b - a, here - a
    share = ((way * along).sum(-1) / along.square().sum(-1).clamp(min=1e-9)).clamp(0, 1)
    away = (way - share[..., None] * along).norm(dim=-1).amin(-1)
    p, q, r = (corners[..., list(i), :] for i in zip(*combinations(range(count), 3), strict=True))
    sides = torch.stack([_cross(q - p, here - p), _cross(r - q, here - q), _cross(p - r, here - r)], -1)
    inside = ((sides >= 0).all(-1) | (sides <= 0).all(-1)) & (_cross(q - p, r - p).abs() > 1e-9)
    return torch.where(inside.any(-1), 0.0, away)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def lean(motion: Motion) -> Tensor:
    """Computes the angle (..., T) in degrees of the trunk, pelvis to neck, from the vertical."""
    trunk = motion.positions[..., motion.skeleton.index("neck"), :] - motion.positions[..., 0, :]
    return torch.rad2deg(torch.acos((trunk[..., 2] / trunk.norm(dim=-1)).clamp(-1, 1)))


# --------------------------------------------------------------------------------------------------------------- speed
def seen_motion(motion: Motion, cameras: Sequence[Camera], seen: Observation2D) -> dict[str, Tensor]:
    """Computes how a fit (G, T) moves in the image, over how the detections do: "speed" and "acceleration" (G,).

    Only points that were detected in ``SMOOTHED`` frames on end count, in those frames; the detections are smoothed.
    """
    ours, theirs = pixels_of(motion, list(cameras)), savitzky_golay(seen.keypoints.flatten(-2), SMOOTHED, 2)
    theirs, there = theirs.unflatten(-1, (-1, 2)), (seen.confidence > 0).double()
    whole = there.unfold(1, SMOOTHED, 1).amin(-1)  # (G, T - 8, K): the window around each frame
    edge = SMOOTHED // 2
    ours, theirs = ours[:, edge:-edge], theirs[:, edge:-edge]
    found = {}
    for name, order in (("speed", 1), ("acceleration", 2)):
        mask = whole[:, order:] * whole[:, :-order]
        a, b = ((x.diff(n=order, dim=1).norm(dim=-1) * mask).sum((1, 2)) for x in (ours, theirs))
        found[name] = (a / b).float()
    return found


# ------------------------------------------------------------------------------------------- which pitch, and what then
RECORDINGS = ("dance_upper_body", "PRE_json")
#: What may say which pitch is right: least of it.
RULES = {
    "energy of stage 3": lambda found, seen: sum(found.energies[3].values()),
    "pixels off": lambda found, seen: misses(pixels_of(found.motion, found.cameras), seen),
    "off balance": lambda found, seen: off_balance(found.motion).mean(-1),
}


def behind_a_desk(people: People, *, seed: int, frames: int) -> Scene:
    """Films the first frames of recorded clips, a desk hiding the legs, by cameras whose pitch is known."""
    return scenes.film_recorded("legs behind a desk", [m.cut(0, frames) for m in people.motions], seed=seed)


def chosen(found: Mapping[float, Fitted], seen: Observation2D, rule: str) -> float:
    """Returns the pitch with the least of a rule, summed over the clips of one camera."""
    return min(found, key=lambda degrees: RULES[rule](found[degrees], seen).sum().item())


def best_rule(found: Mapping[float, Fitted], scene: Scene) -> tuple[str, list[dict[str, object]]]:
    """Returns the rule whose pitch ends nearest to the true one, clip by clip, and a row per rule."""
    true = torch.tensor([pitch_of(camera) for camera in scene.cameras])
    ended = torch.tensor([[pitch_of(camera) for camera in fitted.cameras] for fitted in found.values()])
    off = {}
    for name, rule in RULES.items():
        at = torch.stack([rule(f, scene.observation) for f in found.values()]).argmin(0)
        off[name] = (ended.gather(0, at[None])[0] - true).abs()
    best = min(off, key=lambda name: off[name].mean().item())
    off["none: taken as level"] = (true - ended[list(found).index(0.0)]).abs()
    return best, [{"pitch by": n, "off, degrees": x.mean().item(), "clips": len(true)} for n, x in off.items()]


def standing(truth: Motion) -> tuple[float, float]:
    """Computes how far real people on their feet are off balance: median and 95th percentile over frames, cm.

    On their feet: the pelvis is at 0.8 m or higher.
    """
    away = off_balance(truth)[truth.positions[..., 0, 2] >= 0.8]
    return away.median().item(), away.quantile(0.95).item()


def shown(found: Mapping[float, Fitted], picked: float) -> tuple[dict[str, Motion], dict[str, str]]:
    """Returns a film's panels of the first clip, and their roles."""
    made = {"stage 2, level camera": found[0.0].stages[2], "stage 3, level camera": found[0.0].motion}
    if picked:
        made[f"stage 3, pitch {picked:+.0f}°"] = found[picked].motion
    roles = dict(zip(made, ("stage2", "stage3", "stage3"), strict=False))
    return {name: motion.clip(0) for name, motion in made.items()}, roles


def rows(
    found: Mapping[str, Mapping[float, Fitted]], picked: Mapping[str, float], seen: Mapping[str, Observation2D],
    size: tuple[int, int],
) -> list[dict[str, object]]:  # fmt: skip
    """Returns a row per recording and fit, of what can be said without a reference: level camera, stages 2 and 3, and
    stage 3 at the picked pitch."""
    made = []
    for name, by in found.items():
        here, level, other = seen[name], by[0.0], by[picked[name]]
        ways = {"stage 2, level camera": (level.stages[2], [pitched(size, 0.0)] * len(here.keypoints))}
        ways["stage 3, level camera"] = level.motion, level.cameras
        if picked[name]:
            ways[f"stage 3, pitch {picked[name]:+.0f}°"] = other.motion, other.cameras
        for label, (motion, cameras) in ways.items():
            moves = seen_motion(motion, cameras, here)
            made.append({
                "recording": f"{name} ({len(here.keypoints)} clips)", "fit": label,
                "pixels off": misses(pixels_of(motion, list(cameras)), here).mean().item(),
                "off balance, cm": off_balance(motion).median().item(),
                "trunk leans, degrees": lean(motion).median().item(),
            } | {f"{kind} / detections'": moves[kind].mean().item() for kind in ("speed", "acceleration")})  # fmt: skip
    return made


def reading(rules: Sequence[Mapping[str, object]], rule: str, real: tuple) -> str:
    """Says how well the best rule finds the pitch, and how far people on their feet are off balance."""
    off = {r["pitch by"]: r["off, degrees"] for r in rules}
    level = off["none: taken as level"]
    return (
        f"Where the true pitch is known, the best rule (*{rule}*) ends {off[rule]:.0f} degrees off, and a camera taken "
        f"as level {level:.0f}. Real people on their feet are off balance by {real[0]:.1f} cm (median over frames), "
        f"and by {real[1]:.0f} cm or more in one frame of twenty."
    )
