"""Trains and writes the small checkpoints that ship: pose prior and initial-state mixture.

Source: VPoser (Pavlakos et al. 2019); HuMoR (Rempe et al. 2021), section 4.2.
Differs: ``MIXTURE_RIDGE`` on the diagonals of our mixture is more than the official 1e-6. Two places and three
velocities among the features are fixed by others, so that 1e-6 asks the optimiser to hold them to a millimetre and to a
millimetre per second.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import torch
from torch import Tensor

from data_synth import corpus as synthetic
from motionlab import checkpoint, corpus, rotation, splits
from motionlab.diffusion.windows import LEGS
from motionlab.errors import DataError, check_shape
from motionlab.humor import priors, state
from motionlab.humor.priors import Gaussian, InitGmm, PosePrior, kl
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD, fk
from motionlab.training.chain_training import random_body
from motionlab.training.training_loop import TrainingRun, seeded

STEPS = 4000  # of the pose prior
_COMPONENTS = 12
MIXTURE_RIDGE = 1e-4  # square metres, or (metres per second)^2: one centimetre
#: What the reconstruction may miss by: radians per joint and metres per joint, one standard deviation.
POSE_TURN, POSE_PLACE = 0.10, 0.02
#: Probability with which a limb comes from another pose: unseen poses are found better, samples are a bit less human.
_SHARE = 0.2
_FLIP = torch.tensor([-1.0, 1.0, 1.0])
_PARTNER = [j - 1 for j in STANDARD.mirror_indices[1:]]
#: Joints of the legs and of either arm, among the 21: these move on their own.
_ARMS = [tuple(f"{side}_{part}" for part in ("collar", "shoulder", "elbow", "wrist")) for side in ("left", "right")]
_LIMBS = [[j for j, name in enumerate(STANDARD.names[1:]) if name.endswith(limb)] for limb in (LEGS, *_ARMS)]
_COMMAND = "python -m motionlab train small --data FOLDER"


def sources(folder: Path | str | None) -> tuple[corpus.Corpus, list[Motion]]:
    """Returns what models learn from: the recordings of a folder, and synthetic motion.

    Raises:
        DataError: no folder, or nothing usable in it.
    """
    if not folder:
        raise DataError("this model learns from recordings", remedy="name a folder of them with --data")
    made = synthetic.build(version="B").train
    return corpus.assemble(folder, splits.real_sources(folder)), [sequence.motion for sequence in made]


def _poses(motions: Sequence[Motion], every: int = 1) -> Tensor:
    """Local rotations (N, 21, 3, 3) of every so many frames."""
    return torch.cat([m.rot[::every, 1:] for m in motions]).float()


def _first_states(motions: Sequence[Motion], every: int, generator: torch.Generator | None = None) -> Tensor:
    """Features (N, 138) of every so many frames, velocities as backward differences; with a generator, also of mirrored
    motions and of other bodies."""
    found = []
    for motion in motions:
        some = [motion] if generator is None else [motion, mirror(motion)]
        some += [] if generator is None else [random_body(each, generator) for each in some]
        for each in some:
            world = state.from_motion(each, causal=True)[::every]
            found.append(priors.first_state_features(state.localise(world, state.heading(world))).float())
    return torch.cat(found)


def make_small(folder: Path | str | None, out: Path, *, seed: int = 0, steps: int = STEPS) -> None:
    """Trains the pose prior and fits the mixture on what recordings (``corpus.assemble``) and synthetic motion teach
    (:func:`sources`); writes both into a folder."""
    found, made = sources(folder)
    takes, held = found.part("train"), [take.motion for take in found.part("val")]
    real = [take.motion for take in takes]
    every = real + made
    frames = {splits.RECORDED: sum(m.frames for m in real), splits.SYNTHETIC: sum(m.frames for m in made)}
    about = {"data": frames, "corpus": asdict(synthetic.Recipe()), "seed": seed}

    odds = [torch.full((count,), 1 / max(count, 1)) for count in frames.values()]  # each source as often as the other
    lacks = [take.missing for take in takes] + [()] * len(made)
    rows = torch.tensor([[joint not in names for joint in STANDARD.names[1:]] for names in lacks])
    seen = rows.repeat_interleave(torch.tensor([m.frames for m in every]), 0)
    run = PosePriorTraining(_poses(every), seen, torch.cat(odds), torch.Generator().manual_seed(seed), steps)
    model = run.run(every=max(1, steps // 100), progress=True).averaged
    recipe = about | {
        "what": "pose prior: variational autoencoder, 21 rotations to 32 latents",
        "command": f"{_COMMAND} --steps {steps} --seed {seed}", "steps": steps,
        "deviation": {"radians": POSE_TURN, "metres": POSE_PLACE},
        "held out": {"validation people": reconstruction(model, _poses(held, 3))},
        "history": [[row["step"], round(row["miss"], 3), round(row["kl"], 3)] for row in run.curve if "miss" in row],
    }  # fmt: skip
    tensors = {n: x for n, x in model.state_dict().items() if not n.endswith("num_batches_tracked")}
    checkpoint.save(out / "pose_prior_real", tensors, recipe)

    generator = torch.Generator().manual_seed(seed)
    samples = _first_states(every, 30, generator)
    gmm, history = fit_mixture(samples, generator)
    gmm = InitGmm(*(x.float() for x in gmm.tensors().values()))
    left = gmm.log_prob(_first_states(held, 3))
    recipe = about | {
        "what": "mixture of Gaussians over joints and velocities of a single frame",
        "command": f"{_COMMAND} --seed {seed}", "samples": len(samples), "components": len(gmm.weights),
        "ridge": MIXTURE_RIDGE, "weights": [round(w, 4) for w in gmm.weights.tolist()],
        "held-out log-likelihood, nats per frame": {
            "validation people": {"mixture": round(float(left.mean()), 2), "frames": len(left)}
        },
        "history": [round(x, 3) for x in history],
    }  # fmt: skip
    checkpoint.save(out / "init_gmm_real", gmm.tensors(), recipe)


def _joints_of(rot: Tensor) -> Tensor:
    """Joints (..., 22, 3) of the standard body, pelvis in the origin, for local rotations (..., 21, 3, 3)."""
    still = torch.eye(3).to(rot).expand(*rot.shape[:-3], 1, 3, 3)
    return fk(STANDARD, rot.new_zeros(*rot.shape[:-3], 3), torch.cat((still, rot), -3))[0]


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


class PosePriorTraining(TrainingRun):
    """Trains a pose prior on poses (N, 21, 3, 3): Adam, its rate falls as a cosine, and KL grows over the first tenth.

    seen (N, 21): False where a rotation was not recorded, and teaches nothing. odds (N,): how often each pose is drawn,
    relative to the others.
    """

    clip, least = math.inf, 0.0

    def __init__(
        self, rot: Tensor, seen: Tensor, odds: Tensor, generator: torch.Generator, steps: int, batch: int = 256
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
        """Mean over poses of -log p(pose | z) up to a constant, z drawn from the posterior; and of the KL. Errors of
        rotations are chords |R - R'| / sqrt 2, which for small angles are the angles."""
        some = self.drawn[self.step]
        rot, seen = _varied_poses(self.rot[some], self.seen[some], self.generator)
        posterior = self.model.encode(rot)
        found = self.model.decode(posterior.sample(self.generator))
        turn = ((found - rot).square().sum((-2, -1)) * seen).sum(-1) / (2 * 2 * POSE_TURN**2)
        place = (_joints_of(found) - _joints_of(rot)).square().sum((-2, -1)) / (2 * POSE_PLACE**2)
        miss, divergence = (turn + place).mean(), _nats(posterior)
        grown = min(1.0, (self.step + 1) / (0.1 * self.recipe.steps))
        return miss + grown * divergence, {"miss": miss, "kl": divergence}


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
        raise DataError(f"{len(features)} samples of {features.shape[1]} features", remedy="give more finite frames")
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
