"""Trains and writes the small checkpoints that ship: pose prior, initial-state mixture, and the autoencoder in whose
latent features generated motion is judged (``diffusion.encoder``)."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from data_synth import corpus as synthetic
from motionlab import checkpoint, corpus, splits
from motionlab.diffusion import encoder
from motionlab.diffusion.windows import Windows, gather, on_standard
from motionlab.errors import DataError, ShapeError
from motionlab.humor import priors, state
from motionlab.humor.priors import InitGmm
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD
from motionlab.training import prior_training
from motionlab.training.chain_training import random_body
from motionlab.training.training_loop import TrainingRun, seeded

STEPS = 4000  # of the pose prior
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


class RealMotions(NamedTuple):
    """Motions for training, by source; those of the validation people; which joints each of the first lacks."""

    train: dict[str, list[Motion]]
    held: dict[str, list[Motion]]
    missing: dict[str, list[tuple[str, ...]]]


def real_motions(folder: Path | str | None) -> RealMotions:
    """Returns what recordings (``corpus.assemble``) and synthetic motion teach (:func:`sources`)."""
    found, made = sources(folder)
    takes = found.part("train")
    train = {splits.RECORDED: [t.motion for t in takes], splits.SYNTHETIC: made}
    missing = {splits.RECORDED: [t.missing for t in takes], splits.SYNTHETIC: [()] * len(made)}
    return RealMotions(train, {"validation people": [t.motion for t in found.part("val")]}, missing)


def _poses(motions: Sequence[Motion], every: int = 1) -> Tensor:
    """Local rotations (N, 21, 3, 3) of every so many frames."""
    return torch.cat([m.rot[::every, 1:] for m in motions]).float()


def _first_states(motions: Sequence[Motion], every: int, generator: torch.Generator | None = None) -> Tensor:
    """Features (N, 138) of every so many frames, velocities as backward differences; with a generator, also of mirrored
    motions and of other bodies."""
    found = []
    for motion in motions:
        some = [motion]
        if generator is not None:
            some = [motion, mirror(motion), random_body(motion, generator), random_body(mirror(motion), generator)]
        for each in some:
            world = state.from_motion(each, causal=True)[::every]
            found.append(priors.first_state_features(state.localise(world, state.heading(world))).float())
    return torch.cat(found)


def make_pose_prior(data: RealMotions, out: Path, *, seed: int = 0, steps: int = STEPS) -> None:
    """Trains and writes the pose prior into a folder."""
    generator = torch.Generator().manual_seed(seed)
    found = {source: _poses(motions) for source, motions in data.train.items()}
    odds = [torch.full((len(x),), 1 / len(x)) for x in found.values()]  # each source as often as the other
    every = torch.cat(list(found.values()))
    lacks = [names for source in data.train for names in data.missing[source]]
    counts = torch.tensor([m.frames for some in data.train.values() for m in some])
    rows = torch.tensor([[joint not in names for joint in STANDARD.names[1:]] for names in lacks])
    how = {"steps": steps, "weight": torch.cat(odds), "seen": rows.repeat_interleave(counts, 0)}
    model, history = prior_training.train_pose_prior(every, generator, **how)
    recipe = {
        "what": "pose prior: variational autoencoder, 21 rotations to 32 latents",
        "command": f"{_COMMAND} --steps {steps} --seed {seed}",
        "data": {source: len(x) for source, x in found.items()},
        "corpus": asdict(synthetic.Recipe()), "seed": seed, "steps": steps,
        "deviation": {"radians": prior_training.POSE_TURN, "metres": prior_training.POSE_PLACE},
        "held out": {name: prior_training.reconstruction(model, _poses(some, 3)) for name, some in data.held.items()},
        "history": [[step, round(miss, 3), round(nats, 3)] for step, miss, nats in history],
    }  # fmt: skip
    tensors = {n: x for n, x in model.state_dict().items() if not n.endswith("num_batches_tracked")}
    checkpoint.save(out / "pose_prior_real", tensors, recipe)


def make_init_gmm(data: RealMotions, out: Path, *, seed: int = 0) -> None:
    """Fits and writes the mixture into a folder."""
    generator = torch.Generator().manual_seed(seed)
    samples = _first_states([m for some in data.train.values() for m in some], 30, generator)
    gmm, history = prior_training.fit_mixture(samples, generator)
    gmm = InitGmm(*(x.float() for x in gmm.tensors().values()))
    held = {name: gmm.log_prob(_first_states(some, 3)) for name, some in data.held.items()}
    recipe = {
        "what": "mixture of Gaussians over joints and velocities of a single frame",
        "command": f"{_COMMAND} --seed {seed}",
        "data": {source: sum(m.frames for m in some) for source, some in data.train.items()},
        "samples": len(samples), "corpus": asdict(synthetic.Recipe()), "seed": seed, "components": len(gmm.weights),
        "ridge": prior_training.MIXTURE_RIDGE, "weights": [round(w, 4) for w in gmm.weights.tolist()],
        "held-out log-likelihood, nats per frame": {
            name: {"mixture": round(float(x.mean()), 2), "frames": len(x)} for name, x in held.items()
        },
        "history": [round(x, 3) for x in history],
    }  # fmt: skip
    checkpoint.save(out / "init_gmm_real", gmm.tensors(), recipe)


def make_encoder(folder: Path | str | None, out: Path, recipe: encoder.EncoderRecipe) -> None:
    """Trains and writes the features that generated motion is judged in (``diffusion.encoder``).

    folder: of recordings. Trained on the training people, watched on validation people.
    """
    train, val = real_motions(folder)[:2]
    windows, held = (
        gather([on_standard(m) for each in some.values() for m in each], recipe.frames) for some in (train, val)
    )
    held = held.evenly(256)
    features, curve = train_encoder(windows, recipe, held, progress=True)
    about = {
        "what": "autoencoder over windows of 60 frames: the features that generated motion is judged in",
        "command": f"python -m motionlab train features --steps {recipe.steps} --seed {recipe.seed} --data FOLDER",
        "minutes of motion, before mirroring": {k: sum(m.seconds for m in v) / 60 for k, v in train.items()},
        "corpus": asdict(synthetic.Recipe()), "windows": windows.digest, "torch": torch.__version__,
        "share of variance missed, held out": {k: round(v, 4) for k, v in features.reconstruction_error(held).items()},
        "curve": curve,
    }  # fmt: skip
    encoder.save_encoder(out, features, about)


class _EncoderRun(TrainingRun):
    """Trains an autoencoder on windows. Every group weighs the same in the loss, or the few numbers that say whether a
    foot slides would drown."""

    clip, warm_up, least = math.inf, 0, 0.0

    def __init__(self, recipe: encoder.EncoderRecipe, windows: Windows) -> None:
        generator, self.windows = torch.Generator().manual_seed(recipe.seed), windows
        network = seeded(recipe.seed, lambda: encoder.Autoencoder(recipe))
        self.mean, self.scale = _moments(encoder.signals(windows.draw(min(2048, 16 * recipe.batch), generator)))
        sizes = torch.tensor([*encoder.FEATURE_GROUPS.values()])
        self.weight = (1 / (sizes * len(sizes))).repeat_interleave(sizes)
        optimiser = torch.optim.Adam(network.parameters(), recipe.lr)
        super().__init__(recipe, windows.digest, generator, network, optimiser)

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        x = (encoder.signals(self.windows.draw(self.recipe.batch, self.generator)) - self.mean) / self.scale
        return ((self.model(x) - x).square() * self.weight).sum(-1).mean(), {}

    def _ready(self, network: encoder.Autoencoder) -> encoder.MotionEncoder:
        size = self.recipe.size
        return encoder.MotionEncoder(network, self.mean, self.scale, torch.zeros(size), torch.ones(size), self.recipe)


def train_encoder(
    windows: Windows, recipe: encoder.EncoderRecipe, held: Motion | None = None, *, progress: bool = False
) -> tuple[encoder.MotionEncoder, list[dict]]:
    """Trains on windows; returns the features and the curve: loss, and what is ``missed`` of held-out windows."""
    if windows.length != recipe.frames:
        raise ShapeError(f"windows of {windows.length} frames, recipe of {recipe.frames}")
    every, judge = max(1, recipe.steps // 20), None if held is None else lambda x: x.reconstruction_error(held)
    run = _EncoderRun(recipe, windows).run(every=every, judge=judge, judge_every=every, progress=progress)
    made = run.averaged
    made.network.half().float()  # its weights as they are stored
    latent = made(windows.draw(2048, run.generator)).float()
    made = replace(made, centre=latent.mean(0), spread=latent.std(0).clamp(min=1e-3))
    return made, [{name: round(value, 4) for name, value in row.items()} for row in run.curve]


def _moments(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of each column and one deviation per group, of rows (N, T, 94)."""
    flat = x.flatten(0, 1)
    mean = flat.mean(0)
    parts = (flat - mean).split(list(encoder.FEATURE_GROUPS.values()), 1)
    return mean, torch.cat([part.square().mean().sqrt().clamp(min=1e-3).expand(part.shape[1]) for part in parts])
