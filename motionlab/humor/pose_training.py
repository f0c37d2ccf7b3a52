"""Training of the pose prior, and what it is worth on poses that it has not seen."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from tqdm.auto import tqdm

from motionlab import rotation
from motionlab.errors import DataError, check_shape
from motionlab.humor.cvae import Gaussian, kl
from motionlab.humor.pose_prior import LATENT, PosePrior
from motionlab.skeleton import STANDARD, fk

#: What the reconstruction may miss by: radians per joint and metres per joint, one standard deviation.
TURN, PLACE = 0.10, 0.02
#: Probability with which a limb comes from another pose: unseen poses are found better, samples are a bit less human.
SHARE = 0.2
_FLIP = torch.tensor([-1.0, 1.0, 1.0])
_PARTNER = [j - 1 for j in STANDARD.mirror_indices[1:]]
#: Joints of the legs and of either arm, among the 21: these move on their own.
_LIMBS = [
    [j for j, name in enumerate(STANDARD.names[1:]) if any(part in name for part in parts)]
    for parts in (
        ("hip", "knee", "ankle", "foot"),
        ("left_collar", "left_shoulder", "left_elbow", "left_wrist"),
        ("right_collar", "right_shoulder", "right_elbow", "right_wrist"),
    )
]


def joints_of(rot: Tensor) -> Tensor:
    """Joints (..., 22, 3) of the standard body, pelvis in the origin, for local rotations (..., 21, 3, 3)."""
    still = torch.eye(3).to(rot).expand(*rot.shape[:-3], 1, 3, 3)
    return fk(STANDARD, rot.new_zeros(*rot.shape[:-3], 3), torch.cat((still, rot), -3))[0]


def objective(model: PosePrior, rot: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Mean over poses (B, 21, 3, 3) of -log p(pose | z) up to a constant, z drawn from the posterior; and of the KL.

    Errors of rotations are chords |R - R'| / sqrt 2, which for small angles are the angles.
    """
    posterior = model.encode(rot)
    found = model.decode(posterior.sample(generator))
    turn = (found - rot).square().sum((-2, -1)).sum(-1) / (2 * 2 * TURN**2)
    place = (joints_of(found) - joints_of(rot)).square().sum((-2, -1)) / (2 * PLACE**2)
    prior = Gaussian(torch.zeros_like(posterior.mean), torch.zeros_like(posterior.mean))
    return (turn + place).mean(), kl(posterior, prior).sum(-1).mean()


def varied(rot: Tensor, generator: torch.Generator, *, share: float = SHARE) -> Tensor:
    """Poses (B, 21, 3, 3), half of them mirrored, a share of them with each limb from another person."""
    flip = torch.rand(len(rot), 1, 1, 1, generator=generator) < 0.5
    rot = torch.where(flip, _FLIP[:, None] * rot[:, _PARTNER] * _FLIP, rot)
    if share:
        rot = rot.clone()
        for limb in _LIMBS:
            some = torch.nonzero(torch.rand(len(rot), generator=generator) < share)
            other = torch.randint(len(rot), some.shape, generator=generator)
            rot[some, limb] = rot[other, limb]
    return rot


def train(
    rot: Tensor,
    generator: torch.Generator,
    *,
    steps: int = 4000,
    batch: int = 256,
    rate: float = 1e-3,
    weight: Tensor | None = None,
    share: float = SHARE,
    progress: bool = True,
) -> tuple[PosePrior, list[tuple[int, float, float]]]:
    """A pose prior for poses rot (N, 21, 3, 3): Adam, rate falling as a cosine, KL growing over the first tenth.

    weight (N,): how often each pose is drawn, relative to the others.

    Returns:
        the frozen model, and (step, reconstruction, KL) a hundred times.
    Raises:
        DataError: no poses, or numbers that are not finite.
    """
    check_shape(rot, "N 21 3 3", "rot")
    if len(rot) < 2 or not rot.isfinite().all():
        raise DataError(f"{len(rot)} poses", remedy="give two or more, all of them finite")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        model = PosePrior()
    with torch.no_grad():
        model.out.weight.mul_(0.1)
        model.out.bias.copy_(rotation.matrix_to_sixd(torch.eye(3)).repeat(21))
    optimiser = torch.optim.Adam(model.parameters(), lr=rate)
    history = []
    odds = torch.ones(len(rot)) if weight is None else weight
    drawn = torch.multinomial(odds, steps * batch, replacement=True, generator=generator).split(batch)
    for step, rows in enumerate(tqdm(drawn, desc="pose prior", disable=not progress)):
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * step / steps))
        miss, divergence = objective(model, varied(rot[rows], generator, share=share), generator)
        optimiser.zero_grad()
        (miss + min(1.0, (step + 1) / (0.1 * steps)) * divergence).backward()
        optimiser.step()
        if step % max(1, steps // 100) == 0:
            history.append((step, float(miss.detach()), float(divergence.detach())))
    return model.frozen(), history


@torch.no_grad()
def reconstruction(model: PosePrior, rot: Tensor) -> dict[str, float]:
    """Of poses (N, 21, 3, 3), decoded from the posterior's mean: mean error of a rotation in degrees, mean distance of
    a joint (without the pelvis) in cm, KL in nats, and how many latents say something (variance of the mean > 0.01)."""
    posterior = model.encode(rot)
    found = model.decode(posterior.mean)
    away = (joints_of(found) - joints_of(rot))[..., 1:, :].norm(dim=-1)
    prior = Gaussian(torch.zeros_like(posterior.mean), torch.zeros_like(posterior.mean))
    return {
        "degrees": float(torch.rad2deg(rotation.geodesic(found, rot)).mean()),
        "cm": 100 * float(away.mean()),
        "kl": float(kl(posterior, prior).sum(-1).mean()),
        "active": int((posterior.mean.var(0) > 0.01).sum()),
    }


def samples(model: PosePrior, count: int, generator: torch.Generator) -> Tensor:
    """Poses (count, 21, 3, 3) decoded from N(0, 1)."""
    with torch.no_grad():
        return model.decode(torch.randn(count, LATENT, generator=generator))
