"""How far fits of footage under several plans of work are from a 3-D reference.

With ``--views`` there is the person whom Pose2Sim filmed from four sides (``pose2sim_openpose`` in MOTIONLAB_DATA),
fitted by the solver of ``fit`` under each plan: joint error with the pelvis on the reference's, and processor seconds.
With ``--people`` there are people of CMU's recordings, filmed by a simulated camera, each fitted alone as ``fit`` does:
the plans are compared person by person, by their angles on the true bones. Where the camera is assumed, the world's
heading is nobody's to know: one turn about the vertical a clip is taken out.

    MOTIONLAB_DATA=FOLDER PYTHONPATH=notebooks python tests/bench/bench_footage.py [--views] [--people 12]
"""

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.footage import scene_fit
from motionlab.humor import pretrained, testops
from motionlab.humor.testops import Schedule
from motionlab.metrics import interval, joint_errors
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb05_testops import cast as clips_of
from studies.nb05_testops import measures, recordings
from studies.shared.clips import everyday, stacked, takes
from studies.shared.sitting import seated

#: What a fit may spend; the first is the default of ``fit``, and "first look" that of ``fit --quick``.
PLANS = {
    "default": scene_fit.FULL_WORK,
    "stage 2": scene_fit.FULL_WORK.without_stage_3(),
    "lean": Schedule.lean(),
    "quick": Schedule.quick(),
    "first look": scene_fit.QUICK_WORK,
}
CAMERAS = ("known", "assumed")
LIMBS = [k for k, name in enumerate(STANDARD.names) if name.endswith(("knee", "ankle", "elbow", "wrist"))]


def views_table(folder: Path, plans: Sequence[str], cameras: Sequence[str]) -> None:
    """Prints the error of every view under each plan, fitted together, and processor seconds."""
    views, priors = recordings.pose2sim(folder), pretrained.load_priors()
    print(f"{views.observation.frames} frames of {', '.join(views.names)}; joint error, pelvis aligned, cm")
    for how in cameras:
        for name in plans:
            known = recordings.given(views, how)
            before = time.process_time()
            fitted = testops.fit(views.observation, priors, schedule=PLANS[name], solver="shooting", **known)
            spent = time.process_time() - before
            found = recordings.measured(fitted.motion, fitted.cameras, views)
            each = ", ".join(f"{value:.2f}" for value in found["root"].tolist())
            print(
                f"camera {how:7} {name:11} {found['root'].mean():5.2f} ({each}); in the room "
                f"{found['global'].mean():5.1f}; {found['px'].mean():.1f} px; {spent:.1f} s",
                flush=True,
            )


def people_table(folder: Path, options: argparse.Namespace) -> None:
    """Prints, for each plan, the joint error of people filmed by a simulated camera, fitted one by one, pelvis
    aligned: of the angles on the true bones, and how much more it is than under the first plan, with its interval over
    people; of the motion on its own bones, of all joints and of the limbs'; and how many clips sit or stand as the
    truth does."""
    if options.cast == "synthetic sits":
        cast, view = clips_of.acted("sit", clips_of.sits_down, options.people, 7, seconds=1.0), "legs behind a desk"
    else:
        cast, view = everyday(takes(folder, options.part), options.people), "plain view"
    motions = [motion.cut(0, clips_of.FRAMES) for _, motion in cast]
    scene, priors = scenes.film_recorded(view, motions, seed=3), pretrained.load_priors()
    when, size = measures.moment(scene.truth), (int(scene.cameras[0].width), int(scene.cameras[0].height))
    for how in options.cameras:
        first = None
        for name in options.plans:
            found, spent = [], []
            for k in range(len(cast)):
                seen = stacked([scene.clip(k)], camera=None)
                known = {"cameras": [scene.cameras[k]], "floor": "camera"} if how == "known" else {"size": size}
                before = time.process_time()
                found.append(testops.fit(seen, priors, schedule=PLANS[name], solver="shooting", **known).motion)
                spent.append(time.process_time() - before)
            bones = replace(found[0].skeleton, offsets=torch.cat([m.skeleton.offsets for m in found]))
            made = Motion(bones, torch.cat([m.root for m in found]), torch.cat([m.rot for m in found]), found[0].fps)
            own, on_true = (
                _off(replace(made, skeleton=bones), scene.truth, turned=how == "assumed")
                for bones in (made.skeleton, scene.truth.skeleton)
            )
            error = clips_of.by_person(on_true.mean(-1), [who for who, _ in cast])
            first = error if first is None else first
            more, low, high = interval(error - first, "mean", torch.Generator().manual_seed(0))
            right = (seated(made, when) == seated(scene.truth, when)).double().mean()
            print(
                f"camera {how:7} {name:14} {error.mean():6.2f} cm on true bones, {more:+.2f} [{low:+.2f}, {high:+.2f}] "
                f"to {options.plans[0]}; {own.mean():.2f} cm on its own (limbs {own[:, LIMBS].mean():.2f}); "
                f"{100 * right:.0f} % sit or stand as they did; "
                f"{sum(spent) / len(spent):.1f} s a clip (n = {len(error)} people)",
                flush=True,
            )


def _off(motion: Motion, truth: Motion, *, turned: bool) -> torch.Tensor:
    """Mean distance (B, J) of joints in cm, pelvis on the true one, with or without the nearest turn about z."""
    ours, theirs = (m.positions - m.positions[..., :1, :] for m in (motion, truth))
    if turned:
        cross = (ours[..., :2, None] * theirs[..., None, :2]).sum((1, 2))  # (B, 2, 2)
        angle = torch.atan2(cross[:, 0, 1] - cross[:, 1, 0], cross[:, 0, 0] + cross[:, 1, 1])
        ours = ours @ rotation.rotation_about("z", angle)[:, None].mT
    return 100 * joint_errors(ours, theirs, align="none").mean(1)


def main() -> None:
    data = Path(os.environ.get("MOTIONLAB_DATA", "none"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", action="store_true", help="fit Pose2Sim's four views; a minute or so each plan")
    parser.add_argument("--people", type=int, metavar="N", help="fit so many people of CMU, each alone")
    parser.add_argument("--part", choices=("val", "test"), default="val", help="whose people these are")
    parser.add_argument("--cast", choices=("everyday", "synthetic sits"), default="everyday")
    parser.add_argument("--plans", nargs="+", choices=PLANS, default=[*PLANS])
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=CAMERAS)
    options = parser.parse_args()
    if options.people and ((data / "cmu_library").is_dir() or options.cast == "synthetic sits"):
        people_table(data, options)
    elif options.views and (data / "pose2sim_openpose").is_dir():
        views_table(data / "pose2sim_openpose", options.plans, options.cameras)
    else:
        print("--views with pose2sim_openpose, or --people with cmu_library, in MOTIONLAB_DATA: nothing measured")


if __name__ == "__main__":
    main()
