"""The pose prior and the mixture over first states that ship with the project: their data, training and recipes.

small_priors.make("/folder/of/recordings")
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from data_synth import corpus
from motionlab import library
from motionlab.errors import MissingData
from motionlab.humor import checkpoint, init_gmm, pose_training, shape, state
from motionlab.humor.init_gmm import InitGmm
from motionlab.io.recordings import SOURCES
from motionlab.motion import Motion, mirror

#: Recordings whose licence lets weights be trained on them and shipped.
ALLOWED = tuple(name for name in library.MOTIONS if SOURCES[name].trainable)
HELD_OUT = 6  # every sixth recording of a source is kept from training, from the fourth on
PEOPLE = 0.7  # standard deviation, in betas, of the bodies that the motions are put on


class Split(NamedTuple):
    """Motions at 30 fps on the 22 joints. ``train`` names its sources, the others are tests."""

    train: dict[str, list[Motion]]
    synthetic: list[Motion]
    real: list[Motion]


def split(folder: Path | str) -> Split:
    """The corpus and the allowed recordings of a folder, split.

    Raises:
        MissingData: none of these recordings is there.
    """
    made = corpus.build(progress=False)
    train = {"corpus": [s.motion for s in made.train]}
    real = []
    for source in ALLOWED:
        found = library.standard(folder, source)
        held = [m for i, m in enumerate(found) if i % HELD_OUT == 3]
        train[source] = [m for i, m in enumerate(found) if i % HELD_OUT != 3]
        real += held
    if not any(train[source] for source in ALLOWED):
        raise MissingData(f"recordings of {', '.join(ALLOWED)} in {folder}", "Set MOTIONLAB_DATA to their folder.")
    synthetic = [s.motion for s in (*made.heldout_sequences, *made.heldout_subject)]
    return Split({name: motions for name, motions in train.items() if motions}, synthetic, real)


def poses(motions: Sequence[Motion], every: int = 1) -> Tensor:
    """Local rotations (N, 21, 3, 3) of every so many frames."""
    return torch.cat([m.rot[::every, 1:] for m in motions]).float()


def first_states(motions: Sequence[Motion], every: int, generator: torch.Generator | None = None) -> Tensor:
    """Features (N, 138) of every so many frames; with a generator, also of mirrored motions and of other bodies."""
    found = []
    for motion in motions:
        some = [motion]
        if generator is not None:
            some = [motion, mirror(motion), other_body(motion, generator), other_body(mirror(motion), generator)]
        for each in some:
            world = state.from_motion(each)[::every]
            found.append(init_gmm.features(state.localise(world, state.heading(world))).float())
    return torch.cat(found)


def other_body(motion: Motion, generator: torch.Generator) -> Motion:
    """The same angles on a body drawn at random; the path grows with the legs, so that feet hardly slide."""
    betas = PEOPLE * torch.randn(shape.BETAS, generator=generator)
    scale = shape.scales(betas)[:, None]
    offsets = motion.skeleton.offsets * scale
    legs = motion.skeleton.indices(["left_knee", "left_ankle"])
    grown = offsets[legs].norm(dim=-1).sum() / motion.skeleton.offsets[legs].norm(dim=-1).sum()
    return replace(motion, skeleton=replace(motion.skeleton, offsets=offsets), root=motion.root * grown)


def make(folder: Path | str, *, seed: int = 0, steps: int = 5000, out: Path = checkpoint.SHIPPED) -> dict[str, dict]:
    """Train both, judge them on what was held out, write ``pose_prior_compact`` and ``init_gmm_compact``.

    A few minutes on one core. Returns the recipes by name.
    """
    data = split(folder)
    recipes = {"pose_prior_compact": make_pose_prior(data, seed, steps, out)}
    return recipes | {"init_gmm_compact": make_init_gmm(data, seed, out)}


def make_pose_prior(data: Split, seed: int, steps: int, out: Path) -> dict:
    """Train and write the pose prior; its recipe."""
    generator = torch.Generator().manual_seed(seed)
    train = {source: poses(motions) for source, motions in data.train.items()}
    # as many poses from recordings as from the corpus
    real = sum(len(x) for source, x in train.items() if source != "corpus")
    odds = [torch.full((len(x),), 1.0 if s == "corpus" else len(train["corpus"]) / real) for s, x in train.items()]
    every = torch.cat(list(train.values()))
    model, history = pose_training.train(every, generator, steps=steps, weight=torch.cat(odds))
    drawn = pose_training.samples(model, 2000, torch.Generator().manual_seed(seed))
    recipe = {
        "what": "pose prior: variational autoencoder, 21 rotations to 32 latents",
        "data": {source: len(x) for source, x in train.items()},
        "corpus": asdict(corpus.Recipe()),
        "seed": seed,
        "steps": steps,
        "deviation": {"radians": pose_training.TURN, "metres": pose_training.PLACE},
        "held out, synthetic": pose_training.reconstruction(model, poses(data.synthetic, 5)),
        "held out, real": pose_training.reconstruction(model, poses(data.real, 3)),
        "beyond anatomical limits, degrees": {
            "samples": pose_training.plausibility(drawn),
            "training poses": pose_training.plausibility(every[::50]),
        },
        "history": [[step, round(miss, 3), round(nats, 3)] for step, miss, nats in history],
    }
    tensors = {n: x for n, x in model.state_dict().items() if not n.endswith("num_batches_tracked")}
    checkpoint.save(out / "pose_prior_compact", tensors, recipe)
    return recipe


def make_init_gmm(data: Split, seed: int, out: Path) -> dict:
    """Fit and write the mixture; its recipe."""
    generator = torch.Generator().manual_seed(seed)
    motions = [m for some in data.train.values() for m in some]
    train = first_states(motions, 12, generator)
    gmm, history = init_gmm.fit(train, generator)
    gmm = InitGmm(*(x.float() for x in gmm.tensors().values()))
    single, _ = init_gmm.fit(train, generator, components=1)
    tests = {"synthetic": first_states(data.synthetic, 5), "real": first_states(data.real, 3)}
    recipe = {
        "what": "mixture of Gaussians over joints and velocities of a single frame",
        "data": {source: sum(m.frames for m in some) for source, some in data.train.items()},
        "samples": len(train),
        "corpus": asdict(corpus.Recipe()),
        "seed": seed,
        "components": len(gmm.weights),
        "ridge": init_gmm.RIDGE,
        "weights": [round(w, 4) for w in gmm.weights.tolist()],
        "held-out log-likelihood, nats per frame": {
            name: {
                "mixture": round(float(gmm.log_prob(x).mean()), 2),
                "single Gaussian": round(float(single.log_prob(x).mean()), 2),
                "frames": len(x),
            }
            for name, x in tests.items()
        },
        "history": [round(x, 3) for x in history],
    }
    checkpoint.save(out / "init_gmm_compact", gmm.tensors(), recipe)
    return recipe
