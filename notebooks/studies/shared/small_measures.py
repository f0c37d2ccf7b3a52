"""What small denoisers are worth: their estimates of x_0 on strangers, and the motion that they make up."""

from dataclasses import replace

import torch
from torch import Tensor

from motionlab import metrics
from motionlab.bench import PersonWindows, by_person
from motionlab.contact import resting_heights
from motionlab.diffusion.model import LEVELS, MotionDiffusion, motion_model
from motionlab.diffusion.sampling import noise_like
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import FPS, Motion
from motionlab.skeleton import BALLS, FEET, STANDARD
from studies.shared.feature_training import motion_encoder

STEPS = 50  # of the sampler, at most
PLAIN = "diffusion_plain"
_DOWN = 0.03  # metres above where a ball rests
_TRAVELS = 0.2  # m/s over the floor, from which a root counts as moving


def measured(model: MotionDiffusion, held: PersonWindows) -> dict:
    """Measures a model. estimates: by measure and level of noise, a number a person; samples: by measure, one number.

    As many windows are made up as are held, by DDPM; the noise is the same for all models of one schedule.
    """
    made = made_up(model, len(held.whose))
    unit = float(f"{float(model.normaliser.scale[0]):.4g}")
    return {"root's unit, m": unit, "estimates": _estimates(model, held), "samples": described(made, held.motion)}


def made_up(model: MotionDiffusion, count: int) -> Motion:
    """Draws the windows (count, T) that a model is measured on."""
    return model.sample(count, torch.Generator().manual_seed(0), steps=STEPS)


def beside(held: PersonWindows) -> dict[str, dict[str, float]]:
    """Measures what a good and a bad generator would make: the held windows themselves, and with others' roots."""
    mixed = with_others_roots(held.motion, torch.Generator().manual_seed(0))
    return {"people": described(held.motion), "roots of others": described(mixed, held.motion)}


def plateau(held: PersonWindows) -> dict[str, dict[str, float]]:
    """Measures the thesis's model at its plateau, sampled as small models are."""
    return {PLAIN: described(made_up(motion_model(PLAIN), len(held.whose)), held.motion)}


@torch.no_grad()
def _estimates(model: MotionDiffusion, held: PersonWindows) -> dict[str, dict[str, list[float]]]:
    """x0 error: mean square, normalised. Distances of joints in the layout's frame, and about the pelvis, mm; of their
    velocities, m/s; and how far feet slide that truly stand, mm a frame."""
    x0, generator, found = model.encode(held.motion), torch.Generator().manual_seed(0), {}
    truth, last = model.decode(x0).positions, len(model.schedule) - 1
    feet = STANDARD.indices(FEET)
    for share in LEVELS:
        t = torch.full((len(x0),), round(share * last))
        x = model.denoiser(model.schedule.noised(x0, t, noise_like(x0, generator)), model.schedule.stamps[t])
        places = model.decode(x).positions
        about, true = places - places[..., :1, :], truth - truth[..., :1, :]
        rows = {
            "x0 error": (x - x0).square().mean((1, 2)),
            "joints, mm": 1000 * (places - truth).norm(dim=-1).mean((1, 2)),
            "body, mm": 1000 * (about - true).norm(dim=-1).mean((1, 2)),
            "velocity, m/s": FPS * (places - truth).diff(dim=1).norm(dim=-1).mean((1, 2)),
            "slide where feet stand, mm": metrics.slide_where_truth_stands_mm(
                places[..., feet, :], truth[..., feet, :], still=0.005
            ),
        }
        for name, values in rows.items():
            people = by_person(values, held.whose).tolist()
            found.setdefault(name, {})[f"{share:g}"] = [float(f"{value:.4g}") for value in people]
    return found


def described(made: Motion, real: Motion | None = None) -> dict[str, float]:
    """Means over windows (N, T) on the standard body, NaN left out; real: to compare with, as many of them."""
    balls = made.positions[..., STANDARD.indices(BALLS), :]
    found = {
        "slide, mm a frame": slide_mm(made).nanmean(), "skating, share of frames": skating(made).mean(),
        "driven": driven(made).nanmean(), "travel, m/s": travel(made).mean(),
        "acceleration, m/s^2": metrics.mean_acceleration(made.positions, FPS).mean(),
        "lower ball over the floor, mm": 1000 * (balls[..., 2].amin(-1) - STANDARD.sole).median(),
    }  # fmt: skip
    if real is not None:
        features = motion_encoder("features_real")
        x, y = features(made), features(real)
        found |= {"coverage": metrics.density_coverage(x, y)[1], "frechet": metrics.frechet(x, y)}
    return {name: float(f"{float(value):.5g}") for name, value in found.items()}


def slide_mm(motion: Motion) -> Tensor:
    """mm per frame (N,) that balls of the feet move over the floor while they are down; NaN where none is."""
    balls = motion.positions[..., STANDARD.indices(BALLS), :]
    down = balls[..., 2] - STANDARD.sole < _DOWN
    return metrics.masked_mean(1000 * balls[..., :2].diff(dim=-3).norm(dim=-1), down[:, 1:] & down[:, :-1], 2)


def skating(motion: Motion) -> Tensor:
    """Share (N,) of frames in which a ball of a foot slides over the floor (``metrics.skating_ratio``)."""
    return metrics.skating_ratio(motion.positions[..., STANDARD.indices(BALLS), :], FPS)


def travel(motion: Motion) -> Tensor:
    """Speed (N,) of the pelvis over the floor, m/s."""
    return motion.fps * motion.root[..., :2].diff(dim=-2).norm(dim=-1).mean(-1)


def driven(motion: Motion) -> Tensor:
    """How well the legs account for where the root goes, (N,): the cosine, over all frames and both axes of the floor,
    between the root's velocity and the velocity that its lower foot pushes it with, were it to stand.

    1: the lower foot stands or the root moves in its direction; 0: root and legs know nothing of each other. NaN where
    the root's mean speed is below 0.2 m/s. The lower foot: the joint of the feet nearest to its resting height.
    """
    feet = motion.skeleton.indices(list(FEET))
    about = motion.positions[..., feet, :] - motion.root[..., None, :]
    columns = [motion.skeleton.contact_names.index(name) for name in FEET]
    clear = motion.positions[..., feet, 2] - resting_heights(motion.skeleton)[..., columns]
    lower = (clear[..., 1:, :] + clear[..., :-1, :]).argmin(-1)[..., None, None]
    push = -about[..., :2].diff(dim=-3).gather(-2, lower.expand(*lower.shape[:-1], 2))[..., 0, :] * motion.fps
    way = motion.root[..., :2].diff(dim=-2) * motion.fps
    size = way.square().sum((-1, -2)).sqrt() * push.square().sum((-1, -2)).sqrt()
    found = (way * push).sum((-1, -2)) / size.clamp_min(1e-12)
    return torch.where(torch.linalg.vector_norm(way, dim=-1).mean(-1) >= _TRAVELS, found, torch.nan)


def with_others_roots(motion: Motion, generator: torch.Generator) -> Motion:
    """A control: each window (N, T) goes the way of another one, from its own first place and heading, and its legs
    know nothing of it."""
    local, frame = stuck_root(motion)
    order = torch.randperm(len(local.root), generator=generator)
    other = torch.empty_like(order)
    other[order] = order.roll(1)  # nobody keeps its own
    flat = torch.cat((local.root[other][..., :2], local.root[..., 2:]), -1)
    return local_to_world(frame, replace(local, root=flat))
