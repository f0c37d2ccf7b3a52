import math
from dataclasses import replace

import pytest
import torch

from data_synth.body import capsule_body, planted
from motionlab import rotation
from motionlab.motion import Motion
from motionlab.observation import look_at
from motionlab.skeleton import UPRIGHT
from studies.nb03_skinning import partial_fit

CAMERA = look_at(torch.tensor([0.0, 4.0, 1.4]), torch.tensor([0.0, 0.0, 1.1]), focal=1100.0, width=1280, height=720)


@pytest.fixture(scope="module")
def bodies():
    clean = capsule_body(spacing=0.04)
    faulty, _ = planted(clean, torch.Generator().manual_seed(0))
    kept = torch.where(faulty.weights < 1e-2, 0.0, faulty.weights)
    pruned = replace(faulty, weights=kept / kept.sum(1, keepdim=True))
    return {"clean": clean, "planted": faulty, "pruned": pruned}


def waving(body, frames=12):
    t = torch.arange(frames) / 30
    aa = torch.zeros(frames, 22, 3)
    aa[:, body.skeleton.index("left_shoulder"), 2] = -1.0 + 0.5 * torch.sin(6 * t)
    aa[:, body.skeleton.index("left_elbow"), 1] = -0.8
    aa[:, body.skeleton.index("head"), 0] = 0.2 * torch.sin(4 * t)
    rot = rotation.axis_angle_to_matrix(aa)
    rot[:, 0] = rotation.rotation_about("z", 0.3 * torch.sin(t) + math.pi / 8) @ UPRIGHT
    return Motion(body.skeleton, torch.tensor([0.0, 0.0, 0.99]).expand(frames, 3).clone(), rot, 30.0)


def test_only_planted_weights_pull_on_the_legs(bodies):
    fits = {
        name: partial_fit.fit_arm_and_face(body, waving(body), CAMERA, closures=60) for name, body in bodies.items()
    }
    assert fits["planted"].leg_gradient > 0
    assert fits["planted"].legs_mm > 0.01
    for name in ("clean", "pruned"):
        assert fits[name].leg_gradient == 0
        assert fits[name].legs_mm == 0


def test_legs_are_seen_when_they_do_move(bodies):
    """Negative control: the measure is not blind."""
    body = bodies["clean"]
    bent = waving(body).rot.clone()
    bent[:, body.skeleton.index("left_knee")] = rotation.rotation_about("x", torch.tensor(0.5))
    still = partial_fit._legs_in_pelvis(body, waving(body).rot)
    moved = partial_fit._legs_in_pelvis(body, bent)
    assert (moved - still).norm(dim=-1).max() > 0.2
