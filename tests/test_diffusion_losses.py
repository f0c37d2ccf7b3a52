"""Losses of the denoiser: against loops, against what is known, and with gradients that stay finite."""

from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.sampling import cosine
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from motionlab.training.denoiser_training import denoising_losses

LAYOUT = Layout()
EVERYTHING = Layout(velocities=True)
PARTS = ("simple", "velocity", "fk", "contact")


def motion(generator, count=3, frames=5):
    rot = rotation.exp(0.3 * torch.randn(count, frames, 22, 3, generator=generator, dtype=torch.float64))
    rot[..., 0, :, :] = UPRIGHT.double() @ rot[..., 0, :, :]
    root = torch.randn(count, frames, 3, generator=generator, dtype=torch.float64)
    contacts = (torch.rand(count, frames, 9, generator=generator) < 0.5).double()
    bones = STANDARD.offsets.double() * (1 + 0.1 * torch.rand(count, 1, 22, 1, generator=generator))
    return Motion(replace(STANDARD, offsets=bones), root, rot, 30.0, contacts)


@pytest.fixture
def case(generator):
    """Estimate and truth (3, 5, D), normaliser, bones (3, 22, 3)."""
    return make(LAYOUT, generator)


def make(layout, generator):
    given = motion(generator)
    rows = layout.encode(given)
    normaliser = Normaliser.measure(rows, layout)
    truth = normaliser.apply(rows)
    estimate = truth + 0.3 * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    return estimate, truth, normaliser, given.skeleton.offsets[:, 0]


def joints_by_hand(row, layout, bones):
    """Joint positions (22, 3) of one frame of plain numbers, one joint at a time."""
    six = torch.cat((row[layout.slices["orient"]], row[layout.slices["pose"]])).reshape(22, 6)
    places, turns = [], []
    for j, parent in enumerate(STANDARD.parents):
        a, b = six[j, :3], six[j, 3:]
        x = a / a.norm()
        y = b - (x @ b) * x
        y = y / y.norm()
        own = torch.stack((x, y, torch.linalg.cross(x, y)), -1)
        turns.append(own if parent < 0 else turns[parent] @ own)
        places.append(row[layout.slices["root"]] if parent < 0 else places[parent] + turns[parent] @ bones[j])
    return torch.stack(places)


def twin(estimate, truth, layout, normaliser, bones):
    """Eqs. 4.8 and 4.9 as they are printed, frame by frame; simple and velocity per number."""
    parts = dict.fromkeys(PARTS, 0.0)
    count, frames, size = estimate.shape
    moving = layout.slices["pose"].stop
    for i in range(count):
        here, there = (x[i] * normaliser.scale + normaliser.mean for x in (estimate, truth))
        for n in range(frames):
            parts["simple"] += ((truth[i, n] - estimate[i, n]) ** 2).sum() / (size * frames * count)
            off = joints_by_hand(there[n], layout, bones[i]) - joints_by_hand(here[n], layout, bones[i])
            parts["fk"] += (off**2).sum() / (frames * count)
        for n in range(frames - 1):
            change = (truth[i, n + 1] - truth[i, n]) - (estimate[i, n + 1] - estimate[i, n])
            parts["velocity"] += (change[:moving] ** 2).sum() / (moving * (frames - 1) * count)
            way = joints_by_hand(here[n + 1], layout, bones[i]) - joints_by_hand(here[n], layout, bones[i])
            b = here[n, layout.slices["contacts"]].clamp(0, 1)
            for c, j in enumerate(STANDARD.contact_indices):
                parts["contact"] += ((way[j] * b[c]) ** 2).sum() / ((frames - 1) * count)
    return parts


@pytest.mark.parametrize("layout", [LAYOUT, EVERYTHING], ids=["plain", "velocities"])
def test_every_part_is_that_of_a_loop(generator, layout):
    estimate, truth, normaliser, bones = make(layout, generator)
    found = denoising_losses(estimate, truth, layout, normaliser, bones)
    wanted = twin(estimate, truth, layout, normaliser, bones)
    assert set(found) == set(PARTS)
    for name, value in found.items():
        assert value.item() == pytest.approx(wanted[name].item(), rel=1e-9), name
        assert value > 1e-5, name  # or the comparison says nothing


def test_numbers_that_were_not_recorded_teach_nothing(case):
    """Against the truth put in their place, which has no error."""
    estimate, truth, normaliser, bones = case
    seen = torch.ones(len(truth), LAYOUT.size, dtype=torch.bool)
    seen[1:, LAYOUT.slices["pose"]] = False
    found = denoising_losses(estimate, truth, LAYOUT, normaliser, bones, seen=seen)
    mended = torch.where(seen[:, None], estimate, truth)
    wanted = denoising_losses(mended, truth, LAYOUT, normaliser, bones)
    all_of_it = denoising_losses(estimate, truth, LAYOUT, normaliser, bones)
    for name in PARTS:
        assert found[name].item() == pytest.approx(wanted[name].item(), rel=1e-9), name
        assert found[name] < all_of_it[name], name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_where_nothing_is_left_of_the_signal(generator, dtype):
    """What a network that knows nothing says at t = T: the mean, nought in plain numbers, noise; and x_T itself."""
    _, truth, normaliser, bones = make(LAYOUT, generator)
    truth = truth.to(dtype)
    schedule, noise = cosine(1000), torch.randn(truth.shape, generator=generator).to(dtype)
    nought = normaliser.apply(torch.zeros_like(truth))
    for at in (torch.zeros_like(truth), nought, noise, schedule.noised(truth, 999, noise)):
        at = at.clone().requires_grad_()
        parts = denoising_losses(at, truth, LAYOUT, normaliser, bones)
        sum(parts.values()).backward()
        assert at.grad.isfinite().all() and (at.grad != 0).any()
