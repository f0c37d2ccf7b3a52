"""Notebook 05a: one clip fitted, its energy term by term, and the same fit with other weights."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
from matplotlib.figure import Figure

from data_synth import scenes
from data_synth.scenes import Scene
from motionlab import metrics
from motionlab.body import BodyModel
from motionlab.contact import with_contacts
from motionlab.humor import testops
from motionlab.humor.energies import RGB_LIGHT, Weights
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule
from motionlab.motion import Motion
from motionlab.viz.movie import Mesh, stage
from motionlab.viz.palette import ROLE
from studies.shared.plots import canvas

#: The terms that a figure follows: label and role.
TERMS = {"joints2d": ("keypoints", "observation"), "joints3d_smooth": ("smoothness", "stage2"),
         "motion_prior": ("motion prior", "stage3")}  # fmt: skip
Watched = list[tuple[int, dict[str, float]]]
ROLES = {"stage 1": "observation", "stage 2": "stage2", "stage 3": "stage3"}


def weights_of(smoothness: float = 1.0, prior: float = 1.0, contact: float = 1.0) -> Weights:
    """Returns the weights of a fit to keypoints with some of them so many times as large.

    smoothness: of stage 2. prior: of the motion prior and of the first state. contact: of both contact terms.
    """
    factor = {"joints3d_smooth": smoothness, "motion_prior": prior, "init_motion_prior": prior}
    factor |= {"contact_vel": contact, "contact_height": contact}
    usual = asdict(RGB_LIGHT)
    return Weights(**usual | {name: tuple(f * w for w in usual[name]) for name, f in factor.items()})


def filmed(motion: Motion, seed: int) -> Scene:
    """Films one motion (T,) of a person's own in plain view, its knees and feet hidden in the second half."""
    scene = scenes.film_recorded("plain view", [with_contacts(motion)], seed=seed)
    seen, confidence = scene.observation, scene.observation.confidence.clone()
    low = [k for k, name in enumerate(seen.names) if "knee" in name or "ankle" in name or "toe" in name]
    confidence[:, motion.frames // 2 :, low] = 0.0
    seen = replace(seen, confidence=confidence)
    return replace(scene, observation=seen, seen=scenes.joints_seen(seen.visible, motion.skeleton.names))


def fitted(
    scene: Scene, priors: Priors, schedule: Schedule | None, weights: Weights, solver: str = "rollout"
) -> tuple[Fitted, Watched]:
    """Fits a scene of one clip and returns the fit with (stage, terms) of every evaluation of the energy.

    solver: of stage 3; "shooting" is faster, and its evaluations are not watched.
    """
    watched: Watched = []
    keep = lambda number, terms: watched.append((number, {n: float(x) for n, x in terms.items()}))  # noqa: E731
    how = {"cameras": scene.cameras, "floor": "camera", "schedule": schedule, "weights": weights, "solver": solver}
    return testops.fit(scene.observation, priors, watch=keep, **how), watched


def errors(motion: Motion, scene: Scene) -> dict[str, float]:
    """Computes mean errors of a fit (1, T), cm: of joints that were seen, of those that were not, in the room and, "in
    pose", with the pelvis put on the true one; how it moves, and how far feet slide where the true ones stand."""
    off = {
        where: 100 * (moved.positions - scene.truth.positions).norm(dim=-1)
        for where, moved in {"": motion, " in pose": replace(motion, root=scene.truth.root)}.items()
    }
    speed = lambda x: x.positions.diff(n=2, dim=1).norm(dim=-1).mean().item() * motion.fps**2  # noqa: E731
    feet = motion.skeleton.indices([f"{side}_{part}" for side in metrics.SIDES for part in ("ankle", "foot")])
    steps = [x.positions[..., feet, :] for x in (motion, scene.truth)]
    return {
        f"{which} joints{where}, cm": x[joints].mean().item()
        for which, joints in {"seen": scene.seen, "hidden": ~scene.seen}.items()
        for where, x in off.items()
    } | {
        "acceleration / truth's": speed(motion) / speed(scene.truth),
        "slide, mm/frame": metrics.slide_where_truth_stands_mm(*steps).mean().item(),
    }


def ends(shown: Mapping[str, Motion], look: Mapping[str, object]) -> dict[str, np.ndarray]:
    """Draws the body late in the clip by stage, as ``look`` (keywords of ``movie.stage``) says."""
    fits = {name: motion for name, motion in shown.items() if name in ROLES}
    built, seconds = stage(fits, size=(330 * len(fits), 360), follow=True, **look)
    with built:
        return dict(zip(fits, np.split(built.image(0.85 * seconds), len(fits), axis=1), strict=True))


def terms_over_fit(watched: Watched, bodies: Mapping[str, np.ndarray]) -> Figure:
    """Draws ``TERMS`` over the evaluations of a fit, a column a stage, below the body that the stage ends with."""
    fig, axes = canvas(2, len(bodies), size=(9.0, 5.4), sharey="row")
    above, below = axes[: len(bodies)], axes[len(bodies) :]
    for k, (name, body) in enumerate(bodies.items()):
        above[k].imshow(body)
        above[k].set_axis_off()
        terms = [found for number, found in watched if name == f"stage {number}"]
        for term, (label, role) in TERMS.items():
            curve = np.array([found.get(term, np.nan) for found in terms])
            below[k].plot(curve, lw=2, color=ROLE[role], label=label)
        below[k].set(xlabel=f"evaluation in {name}")
    below[0].set(ylabel="weighted term of the energy")
    below[0].set_yscale("symlog", linthresh=10.0)
    below[0].legend(loc="lower left")
    return fig


def rows_of(found: Mapping[str, Fitted], scene: Scene, stages: Sequence[int]) -> list[dict[str, object]]:
    """Returns a row of errors for every fit, by the label of its weights."""
    every = [(label, k, fit.stages[k]) for label, fit in found.items() for k in stages]
    return [{"weights": label, "after": f"stage {k}"} | errors(motion, scene) for label, k, motion in every]


def panels(fit: Fitted, scene: Scene, stages: Sequence[int] = (1, 2, 3)) -> dict[str, Motion]:
    """Returns the truth and the stages of a fit of one clip, as a film shows them."""
    return {"truth": scene.truth.clip(0)} | {f"stage {k}": fit.stages[k].clip(0) for k in stages}


def picture(fit: Fitted, scene: Scene, body: BodyModel, seconds: float, *, things: Sequence[Mesh] = ()) -> np.ndarray:
    """Draws truth, stage 2 and stage 3 at one time, the fits over the truth. Titles: errors of the hidden joints in the
    room and, "pose", with the pelvis put on the true one."""
    shown, roles = panels(fit, scene, (2, 3)), {}
    titled = {"truth": shown["truth"]}
    for k in (2, 3):
        off = errors(fit.stages[k], scene)
        title = f"stage {k}: {off['hidden joints, cm']:.0f} cm, pose {off['hidden joints in pose, cm']:.0f}"
        titled[title], roles[title] = shown[f"stage {k}"], ROLES[f"stage {k}"]
    with stage(titled, roles, body, (1080, 400), things=things, ghost=shown["truth"])[0] as built:
        return built.image(seconds)
