"""Trains the small priors: the pose VAE on poses, the initial-state mixture on first states.

Source: VPoser (Pavlakos et al. 2019); HuMoR (Rempe et al. 2021), section 4.2.
Differs: ``MIXTURE_RIDGE`` on the diagonals of our mixture is more than the official 1e-6. Two places and three
velocities among the features are fixed by others, so that 1e-6 asks the optimiser to hold them to a millimetre and to a
millimetre per second.
"""

import math
from types import SimpleNamespace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, check_shape
from motionlab.humor.cvae import Gaussian, kl
from motionlab.humor.priors import InitGmm, PosePrior
from motionlab.skeleton import STANDARD, fk
from motionlab.training.training_loop import TrainingRun, seeded

_COMPONENTS = 12
MIXTURE_RIDGE = 1e-4  # square metres, or (metres per second)^2: one centimetre
#: What the reconstruction may miss by: radians per joint and metres per joint, one standard deviation.
POSE_TURN, POSE_PLACE = 0.10, 0.02
#: Probability with which a limb comes from another pose: unseen poses are found better, samples are a bit less human.
_SHARE = 0.2
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


def _joints_of(rot: Tensor) -> Tensor:
    """Joints (..., 22, 3) of the standard body, pelvis in the origin, for local rotations (..., 21, 3, 3)."""
    still = torch.eye(3).to(rot).expand(*rot.shape[:-3], 1, 3, 3)
    return fk(STANDARD, rot.new_zeros(*rot.shape[:-3], 3), torch.cat((still, rot), -3))[0]


def _objective(model: PosePrior, rot: Tensor, seen: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Mean over poses (B, 21, 3, 3) of -log p(pose | z) up to a constant, z drawn from the posterior; and of the KL.

    Errors of rotations are chords |R - R'| / sqrt 2, which for small angles are the angles; only those that were
    recorded count: seen (B, 21).
    """
    posterior = model.encode(rot)
    found = model.decode(posterior.sample(generator))
    turn = ((found - rot).square().sum((-2, -1)) * seen).sum(-1) / (2 * 2 * POSE_TURN**2)
    place = (_joints_of(found) - _joints_of(rot)).square().sum((-2, -1)) / (2 * POSE_PLACE**2)
    return (turn + place).mean(), _nats(posterior)


def _nats(posterior: Gaussian) -> Tensor:
    """Mean KL divergence from N(0, 1)."""
    nothing = torch.zeros_like(posterior.mean)
    return kl(posterior, Gaussian(nothing, nothing)).sum(-1).mean()


def _varied_poses(rot: Tensor, seen: Tensor, generator: torch.Generator, odds: float = _SHARE) -> tuple[Tensor, Tensor]:
    """Poses (B, 21, 3, 3), half of them mirrored, a share of them with each limb from another person; and which joints
    of them were recorded (B, 21)."""
    flip = torch.rand(len(rot), 1, 1, 1, generator=generator) < 0.5
    rot = torch.where(flip, _FLIP[:, None] * rot[:, _PARTNER] * _FLIP, rot)
    seen = torch.where(flip[:, 0, 0], seen[:, _PARTNER], seen)
    for limb in _LIMBS:
        some = torch.nonzero(torch.rand(len(rot), generator=generator) < odds)
        other = torch.randint(len(rot), some.shape, generator=generator)
        rot[some, limb], seen[some, limb] = rot[other, limb], seen[other, limb]
    return rot, seen


class _PosePriorRun(TrainingRun):
    """Trains a pose prior: Adam, its rate falls as a cosine, and KL grows over the first tenth."""

    clip, least = math.inf, 0.0

    def __init__(
        self, steps: int, batch: int, rot: Tensor, seen: Tensor, odds: Tensor, generator: torch.Generator
    ) -> None:
        model = seeded(int(torch.randint(2**31, (), generator=generator)), PosePrior)
        with torch.no_grad():
            model.out.weight.mul_(0.1)
            model.out.bias.copy_(rotation.matrix_to_sixd(torch.eye(3)).repeat(21))
        self.drawn = torch.multinomial(odds, steps * batch, replacement=True, generator=generator).split(batch)
        self.rot, self.seen = rot, seen
        recipe = SimpleNamespace(steps=steps, lr=1e-3, average=0.0)  # its weights are the last ones
        super().__init__(recipe, "", generator, model, torch.optim.Adam(model.parameters(), lr=recipe.lr))

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        some = self.drawn[self.step]
        rot, seen = _varied_poses(self.rot[some], self.seen[some], self.generator)
        miss, divergence = _objective(self.model, rot, seen, self.generator)
        grown = min(1.0, (self.step + 1) / (0.1 * self.recipe.steps))
        return miss + grown * divergence, {"miss": miss, "kl": divergence}


def train_pose_prior(
    rot: Tensor, generator: torch.Generator, *, steps: int = 4000, batch: int = 256, weight: Tensor | None = None,
    seen: Tensor | None = None, progress: bool = True,
) -> tuple[PosePrior, list[tuple[int, float, float]]]:  # fmt: skip
    """Trains a pose prior on poses (N, 21, 3, 3).

    weight (N,): how often each pose is drawn, relative to the others. seen (N, 21): False where a rotation was not
    recorded, and teaches nothing.

    Returns:
        the frozen model, and (step, reconstruction, KL) a hundred times.
    Raises:
        DataError: no poses, or numbers that are not finite.
    """
    check_shape(rot, "N 21 3 3", "rot")
    if len(rot) < 2 or not rot.isfinite().all():
        raise DataError(f"{len(rot)} poses", remedy="give two or more, all of them finite")
    odds = torch.ones(len(rot)) if weight is None else weight
    seen = torch.ones(rot.shape[:2], dtype=torch.bool) if seen is None else seen
    run = _PosePriorRun(steps, batch, rot, seen, odds, generator)
    run.run(every=max(1, steps // 100), progress=progress)
    return run.averaged, [(row["step"], row["miss"], row["kl"]) for row in run.curve]


@torch.no_grad()
def reconstruction(model: PosePrior, rot: Tensor) -> dict[str, float]:
    """Computes what poses (N, 21, 3, 3) lose when they are decoded from the posterior's mean.

    Mean error of a rotation in degrees, mean distance of a joint (without the pelvis) in cm, KL in nats, and how many
    latents say something (variance of the mean > 0.01).
    """
    posterior = model.encode(rot)
    found = model.decode(posterior.mean)
    away = (_joints_of(found) - _joints_of(rot))[..., 1:, :].norm(dim=-1)
    return {
        "degrees": float(torch.rad2deg(rotation.geodesic(found, rot)).mean()),
        "cm": 100 * float(away.mean()),
        "kl": float(_nats(posterior)),
        "active": int((posterior.mean.var(0) > 0.01).sum()),
    }


def fit_mixture(
    features: Tensor, generator: torch.Generator, *, components: int = _COMPONENTS, ridge: float = MIXTURE_RIDGE,
) -> tuple[InitGmm, list[float]]:  # fmt: skip
    """Fits a mixture to features (N, D) by expectation-maximisation, started from k-means++ and a few steps of k-means.

    Returns:
        the mixture, and the mean log-likelihood (nats) before each of at most 100 steps, until that grows by less than
        0.01.
    Raises:
        DataError: fewer samples than features, or numbers that are not finite.
    """
    check_shape(features, "N D", "features")
    if len(features) <= features.shape[1] or not features.isfinite().all():
        raise DataError(
            f"{len(features)} samples of {features.shape[1]} features", remedy="give more frames, all of them finite"
        )
    x = features.double()
    share = torch.nn.functional.one_hot(_clusters(x, components, generator), components).double()
    history: list[float] = []
    for _ in range(100):
        gmm = _maximise(x, share, ridge)
        joint = gmm.each(x)
        total = joint.logsumexp(-1)
        history.append(float(total.mean()))
        if len(history) > 1 and history[-1] - history[-2] < 1e-2:
            break
        share = (joint - total[:, None]).exp()
    return gmm, history


def _maximise(x: Tensor, share: Tensor, ridge: float) -> InitGmm:
    """The mixture that fits samples x (N, D) best, given to whom (N, K) each belongs."""
    count = share.sum(0).clamp(min=1e-6)
    means = (share.mT @ x) / count[:, None]
    ridge_matrix = ridge * torch.eye(x.shape[1], dtype=x.dtype)
    covariances = []
    for k in range(share.shape[1]):  # one component at a time: all at once would need N K D numbers
        away = (x - means[k]) * (share[:, k, None] / count[k]).sqrt()
        covariances.append(away.mT @ away + ridge_matrix)
    return InitGmm(count / count.sum(), means, torch.stack(covariances))


def _clusters(x: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Index (N,) of the nearest of ``count`` centres: k-means++ and ten steps of Lloyd's, features at unit spread."""
    x = (x - x.mean(0)) / x.std(0).clamp(min=1e-3)
    chosen = x[torch.randint(len(x), (1,), generator=generator)]
    for _ in range(count - 1):
        nearest = torch.cdist(x, chosen).amin(-1).square()
        chosen = torch.cat((chosen, x[torch.multinomial(nearest.float() + 1e-12, 1, generator=generator)]))
    for _ in range(10):
        owner = torch.cdist(x, chosen).argmin(-1)
        member = torch.nn.functional.one_hot(owner, count).double()
        size = member.sum(0)[:, None]
        chosen = torch.where(size > 0, member.mT @ x / size.clamp(min=1), chosen)
    return torch.cdist(x, chosen).argmin(-1)
