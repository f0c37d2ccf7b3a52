"""What a video leaves open, guessed before stage 3: the floor, and legs that sit where no foot was seen."""

from dataclasses import replace

import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import rotation
from motionlab.footage import scene_fit
from motionlab.footage.fit import landmarks_of
from motionlab.humor import evidence, pretrained, start, testops, unknowns
from motionlab.humor.energies import RGB_LIGHT
from motionlab.humor.stages import Problem
from motionlab.metrics import tilt_and_bend
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Observation2D, look_at, project
from motionlab.skeleton import STANDARD

FRAMES = 20
LOWER = [k for k, name in enumerate(BODY_25) if name.endswith(("knee", "ankle", "heel", "toe", "hip"))]


def acted(action: str, at: int) -> Motion:
    motion = ACTIONS[action](SUBJECTS[0], torch.Generator().manual_seed(4)).motion.cut(at, at + FRAMES)
    return replace(motion, root=motion.root - motion.root[:1] * torch.tensor([1.0, 1.0, 0.0]))


def filmed(motion: Motion, hide: list[int]) -> Observation2D:
    """Perfect detections from the front, without some of them, by a camera that is not said."""
    ahead = motion.rot[0, 0, :2, 2] / motion.rot[0, 0, :2, 2].norm()
    eye = torch.cat((4.0 * ahead, torch.tensor([1.2])))
    camera = look_at(eye, torch.tensor([0.0, 0.0, 1.0]), focal=1468.0, width=1280, height=720)
    sure = torch.ones(FRAMES, 25)
    sure[:, hide] = 0
    return Observation2D(project(camera, landmarks_of(motion))[0], sure, BODY_25, 30.0)


def test_legs_of_somebody_who_sits_whatever_the_trunk_does():
    walk = acted("walk", 20)
    lean = walk.rot.clone()
    lean[:, 0] = lean[:, 0] @ rotation.rotation_about("x", torch.tensor(0.5))
    for motion in (walk, replace(walk, rot=lean)):
        batch = replace(motion, root=motion.root[None], rot=motion.rot[None], contacts=None)
        sits = start.seated(batch)
        tilt, bend = tilt_and_bend(sits)
        assert (tilt - 85).abs().max() < 1 and (bend - 85).abs().max() < 1
        assert max(angle.mean() for angle in tilt_and_bend(batch)) < 60  # as they were
        rest = [j for j in range(22) if j not in start.SITTING_LEGS]
        assert torch.equal(sits.rot[:, :, rest], batch.rot[:, :, rest])
        ahead = sits.positions[0, :, STANDARD.indices(["left_knee", "right_knee"]), :2].mean(1) - motion.root[:, :2]
        assert (ahead * motion.rot[:, 0, :2, 2]).sum(-1).min() > 0.2  # to where the pelvis faces


def test_feet_count_by_confidence():
    sure = torch.zeros(10, 25)
    assert evidence.feet_seen(sure) == 0  # nobody
    sure[:5, :8] = 1.0
    assert evidence.feet_seen(sure) == 0
    sure[0, BODY_25.index("left_heel")] = 1.0
    sure[1, BODY_25.index("right_ankle")] = 0.5
    assert float(evidence.feet_seen(sure)) == pytest.approx(1.5 / 5)


def test_stage_3_begins_with_the_feet_on_the_floor():
    """Where the floor's height is not known, person and camera are raised together: the pixels stay."""
    seen = evidence.evidence(filmed(acted("idle", 0), []), size=(1280, 720))
    problem = Problem(seen, pretrained.load_priors(), RGB_LIGHT)
    unknown = testops.start_stage_1(problem)
    motion = unknowns.motion_of(unknowns.pose(unknown, problem.priors, seen), 30.0)
    motion = replace(motion, root=motion.root + torch.tensor([0.0, 0.0, 0.3]))
    pixels = seen.view.pixels(landmarks_of(motion), unknown.camera)
    for guesses in (True, False):
        track = testops._Track(replace(testops.Schedule.quick(), guesses=guesses), False, None)
        raised, _, shared, *_ = track._begun(problem, unknown, motion, unknown.latent, seen.confidence_per_joint)
        off = float(start.above_floor(raised.positions))
        assert abs(off) < 1e-4 if guesses else off > 0.1
        assert (seen.view.pixels(landmarks_of(raised), shared["camera"]) - pixels).abs().max() < 0.05


def test_who_sits_with_hidden_legs_is_not_made_to_stand():
    seen = filmed(acted("sit", 100), LOWER)
    angles = {}
    for guesses in (False, True):
        work = replace(scene_fit.QUICK_WORK, guesses=guesses)
        fitted = testops.fit(seen, pretrained.load_priors(), schedule=work, solver="shooting", size=(1280, 720))
        angles[guesses] = [float(angle.mean()) for angle in tilt_and_bend(fitted.motion)]
    assert min(angles[True]) > 45 > max(angles[False])
