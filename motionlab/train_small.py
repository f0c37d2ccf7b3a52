"""The small models that ship with the project: priors over poses and first states, and the features that judge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from data_synth import anatomy, corpus
from motionlab import diffusion_data
from motionlab.diffusion import embedding
from motionlab.diffusion.trained import Recipe
from motionlab.diffusion.windows import gather
from motionlab.humor import checkpoint, init_gmm, pose_training, state
from motionlab.humor.init_gmm import InitGmm
from motionlab.humor.variety import other_body
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD

Motions = Mapping[str, Sequence[Motion]]  # by source
STEPS = 4000
COMMAND = "python -m motionlab train small"


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


def make_pose_prior(train: Motions, held: Motions, out: Path, *, seed: int = 0, steps: int = STEPS) -> dict:
    """Train and write the pose prior; its recipe.

    train, held: motions at 30 fps on the 22 joints, as ``train.sources`` splits them.
    """
    generator = torch.Generator().manual_seed(seed)
    found = {source: poses(motions) for source, motions in train.items()}
    odds = [torch.full((len(x),), 1 / len(x)) for x in found.values()]  # each source as often as the other
    every = torch.cat(list(found.values()))
    model, history = pose_training.train(every, generator, steps=steps, weight=torch.cat(odds))
    drawn = pose_training.samples(model, 2000, torch.Generator().manual_seed(seed))
    recipe = {
        "what": "pose prior: variational autoencoder, 21 rotations to 32 latents",
        "command": f"{COMMAND} --steps {steps} --seed {seed}",
        "data": {source: len(x) for source, x in found.items()},
        "corpus": asdict(corpus.Recipe()),
        "seed": seed,
        "steps": steps,
        "deviation": {"radians": pose_training.TURN, "metres": pose_training.PLACE},
        "held out": {name: pose_training.reconstruction(model, poses(some, 3)) for name, some in held.items()},
        "beyond anatomical limits, degrees": {
            "samples": plausibility(drawn),
            "training poses": plausibility(every[::50]),
        },
        "history": [[step, round(miss, 3), round(nats, 3)] for step, miss, nats in history],
    }
    tensors = {n: x for n, x in model.state_dict().items() if not n.endswith("num_batches_tracked")}
    checkpoint.save(out / "pose_prior_compact", tensors, recipe)
    return recipe


def make_init_gmm(train: Motions, held: Motions, out: Path, *, seed: int = 0) -> dict:
    """Fit and write the mixture; its recipe. Arguments as of :func:`make_pose_prior`."""
    generator = torch.Generator().manual_seed(seed)
    samples = first_states([m for some in train.values() for m in some], 15, generator)
    gmm, history = init_gmm.fit(samples, generator)
    gmm = InitGmm(*(x.float() for x in gmm.tensors().values()))
    single, _ = init_gmm.fit(samples, generator, components=1)
    tests = {name: first_states(some, 3) for name, some in held.items()}
    recipe = {
        "what": "mixture of Gaussians over joints and velocities of a single frame",
        "command": f"{COMMAND} --seed {seed}",
        "data": {source: sum(m.frames for m in some) for source, some in train.items()},
        "samples": len(samples),
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


def make_features(
    folder: Path | str | None, out: Path, *, seed: int = 0, steps: int | None = None, recordings: Sequence[str] = ()
) -> dict:
    """Train and write the features that generated motion is judged in (``diffusion.embedding``); their recipe.

    folder: of recordings, or None. Trained on the training part of ``diffusion_data``, watched on the choosing part.
    """
    recipe = embedding.Recipe(seed=seed, **({"steps": steps} if steps else {}))
    parts = {part: diffusion_data.sources(folder, part) for part in ("train", "choose")}
    ready = {part: [m for some in found.values() for m in some] for part, found in parts.items()}
    windows, held = (gather(diffusion_data.prepared(some, Recipe()), recipe.frames) for some in ready.values())
    features, curve = embedding.train(windows, recipe, held.evenly(256), say=print)
    with_data = " --data FOLDER" if diffusion_data.RECORDED in parts["train"] else ""
    about = {
        "what": "autoencoder over windows of 60 frames: the features that generated motion is judged in",
        "command": f"python -m motionlab train features --steps {recipe.steps} --seed {seed}{with_data}",
        "minutes of motion, before mirroring": {k: sum(m.seconds for m in v) / 60 for k, v in parts["train"].items()},
        "recordings": list(recordings),
        "corpus": asdict(corpus.Recipe()),
        "windows": windows.digest,
        "torch": torch.__version__,
        "share of variance missed, held out": {k: round(v, 4) for k, v in features.missed(held.evenly(256)).items()},
        "curve": curve,
    }
    embedding.save(out, features, about)
    return about


@torch.no_grad()
def plausibility(rot: Tensor) -> dict[str, float]:
    """Of poses (N, 21, 3, 3) against the anatomical limits: degrees beyond them (mean over poses of the worst joint,
    and over all joints), and the share of poses in which no angle is more than 5 degrees beyond."""
    whole = torch.cat((torch.eye(3).to(rot).expand(len(rot), 1, 3, 3), rot), 1)
    beyond = torch.stack(list(anatomy.excess(STANDARD, whole).values()), -1)
    return {
        "worst": float(beyond.amax(-1).mean()),
        "mean": float(beyond.mean()),
        "within 5 degrees": float((beyond.amax(-1) <= 5).float().mean()),
    }
