"""The checkpoints that ship with the project, each made from its data: denoisers, small priors, and features.

:func:`make` trains a denoiser by a preset and chooses its weights. ``make_pose_prior`` and ``make_init_gmm`` make the
priors over poses and first states, ``make_features`` the features that generated motion is judged in.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from data_synth import anatomy, corpus
from motionlab import checkpoint, splits
from motionlab import corpus as real_corpus
from motionlab.diffusion import embedding, model, training
from motionlab.diffusion.embedding import filling_judge, kid_judge
from motionlab.diffusion.losses import LossWeights
from motionlab.diffusion.model import DenoiserRecipe
from motionlab.diffusion.windows import gather
from motionlab.errors import DataError
from motionlab.humor import prior_training, priors, state
from motionlab.humor.examples import other_body
from motionlab.humor.priors import InitGmm
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD

_WEIGHTS = LossWeights(velocity=20.0, contact=100.0, late=0.1, by_signal=True, even=True, snr=10.0)
_BASE = DenoiserRecipe(
    patch=2, spectral=True, before=True, root_unit=0.08, dropout=0.0, steps=36_000, batch=16, lr=4e-4, warm_up=300,
    weights=_WEIGHTS,
)  # fmt: skip
#: free: free root, contacts, stuck root frame. fixed: the root over one spot, no contacts. world: in world space;
#: stuck: its twin in the stuck frame, all else equal. pose: single poses. handles: single poses, told where some joints
#: should be. told: told what is known, from the weights of stuck, whose units it shares.
#: root_unit: so that a unit of noise moves the root about as far as it moves a hand (docs/experiments.md); not where
#: the frame is the question, or where the root is mostly known.
#: In world space the root lies metres off, not decimetres, at first: with the weights of the others fk and contact
#: would have a hundred times the gradient of all else.
_FAR = replace(_WEIGHTS, fk=0.002, contact=20.0)
_POSE = replace(
    _BASE, frames=1, patch=1, root_unit=0.0, contacts=False, spectral=False, linear=True, batch=128, steps=3000,
    weights=replace(_WEIGHTS, fk=0.5, velocity=0.0, contact=0.0, by_signal=False, snr=0.0),
)  # fmt: skip
_HANDLES = replace(_POSE, handles=64, recalls=12_000, steps=4000, weights=replace(_POSE.weights, fk=5.0, handles=20.0))
#: What is asked of it from pure noise is what it is used for: such windows are many, and count a third of the clearest.
_TOLD = replace(
    _BASE, told=True, blind=0.3, recalls=12_000, root_unit=0.0, steps=10_000,
    weights=replace(_WEIGHTS, fk=0.5, contact=20.0, snr=2.0),
)  # fmt: skip
_PLACE = replace(_BASE, root_unit=0.0, steps=10_000, weights=_FAR)
DENOISER_PRESETS = {
    "free": _BASE,
    "fixed": replace(_BASE, version="A", contacts=False, travels=False, steps=6000),
    "world": replace(_PLACE, frame="world"),
    "stuck": _PLACE,
    "pose": _POSE,
    "handles": _HANDLES,
    "told": _TOLD,
}
#: The same, learnt from hours of real motion; those of single poses from whole bodies, as they recall what they saw.
_STEPS = {"free": 15_000, "handles": 4000}
_REAL = {name: replace(DENOISER_PRESETS[name], source=splits.REAL_MOTION, steps=n) for name, n in _STEPS.items()}
DENOISER_PRESETS |= {f"real_{name}": recipe for name, recipe in _REAL.items()}
FEATURE_PRESETS = {"usual": embedding.FeatureRecipe(), "real": embedding.FeatureRecipe(steps=4000, real=True)}
#: Models that go on from the weights of another one that ships, told of nothing.
FROM = {"told": "diffusion_stuck"}
_HELD = 256  # held-out windows that the checkpoint is chosen by
#: Of all steps: no earlier average is chosen. The error of x_0 falls to the end, and KID is too uncertain to tell a
#: lucky early average from a better late one (docs/experiments.md).
_JUDGE_FROM = 0.6
_SILENT = 0.01  # gain over the filter; less says that the network has collapsed
_SHORT, _LONG = 5000, 10_000  # steps; fewer are not judged, more are measured more rarely
_Motions = Mapping[str, Sequence[Motion]]  # by source
STEPS = 4000  # of the pose prior


class RealMotions(NamedTuple):
    """Motions for training, by source; those of the people that choose; which joints each of the first lacks; and how
    many people were recorded."""

    train: dict[str, list[Motion]]
    held: dict[str, list[Motion]]
    missing: dict[str, list[tuple[str, ...]]]
    people: int


def real_motions(folder: Path | str | None, *, whole: bool = False) -> RealMotions:
    """Returns what recordings (``corpus.assemble``; whole: those that lack no joint) and synthetic motion teach.

    Raises:
        DataError: no folder, or nothing usable in it.
    """
    if not folder:
        raise DataError("this preset learns from recordings", remedy="name a folder of them with --data")
    found, made = real_corpus.assemble(folder, splits.real_sources(folder)), corpus.build(version="B")
    takes = [t for t in found.part("train") if not (whole and t.missing)]
    train = {splits.RECORDED: [t.motion for t in takes], splits.SYNTHETIC: [s.motion for s in made.train]}
    missing = {splits.RECORDED: [t.missing for t in takes], splits.SYNTHETIC: [()] * len(made.train)}
    held = {"people who choose": [t.motion for t in found.part("choose")]}
    return RealMotions(train, held, missing, len({t.person for t in takes}))


def training_motions(found: dict[str, list[Motion]], recipe: DenoiserRecipe) -> dict[str, list[Motion]]:
    """Returns the motions, by source, that the recipe trains on: those of its source, and every n-th of them.

    Raises:
        DataError: the recipe's source is not there.
    """
    if recipe.source not in ("all", splits.REAL_MOTION, *found):
        message = f"no motions from {recipe.source!r}, only from {', '.join(found)}"
        raise DataError(message, remedy="give --data with recordings, or another preset")
    used = {name: some for name, some in found.items() if recipe.source in ("all", splits.REAL_MOTION, name)}
    return {name: splits.evenly(some, max(1, round(len(some) * recipe.share))) for name, some in used.items()}


def _learnt_from(recipe: DenoiserRecipe, folder: Path | str | None) -> RealMotions:
    """What the recipe trains on and is chosen by; no missing joints where all count as recorded."""
    if recipe.source == splits.REAL_MOTION:
        found = real_motions(folder, whole=recipe.linear)
        train, missing = (training_motions(each, recipe) for each in (found.train, found.missing))
        return found._replace(train=train, missing=missing)
    train = training_motions(splits.motions_by_part(folder, "train"), recipe)
    return RealMotions(train, splits.motions_by_part(folder, "choose"), {}, 0)


def begins(preset: str, recipe: DenoiserRecipe) -> Path | None:
    """Returns the checkpoint whose weights a preset starts from, or None: new weights, or not the preset's size."""
    as_usual = recipe.size == DENOISER_PRESETS[preset].size
    return checkpoint.SHIPPED / FROM[preset] if preset in FROM and as_usual else None


def make(
    recipe: DenoiserRecipe,
    folder: Path | str | None,
    out: Path,
    kept: Path,
    *,
    resume: bool,
    command: str,
    recordings: Sequence[str] = (),
    start: Path | None = None,
) -> None:
    """Trains (or goes on with ``kept``) and writes the checkpoint of the least KID (of handles: the last) to ``out``,
    with its recipe.

    Under ``accelerate launch`` every process calls this, and the first one writes.

    Args:
        folder: of recordings, or None. resume: go on with ``kept``. command, recordings: for the recipe: what was
            typed, and which sources were found. start: the checkpoint to begin from; None: new weights.

    Raises:
        DataError: nothing to learn from, or ``kept`` is not a run on these windows.
    """
    train, choose, lacking, people = _learnt_from(recipe, folder)
    missing = [names for some in lacking.values() for names in some for _ in range(1 + recipe.copies)] or None
    motions = _together(train, recipe, recipe.copies)
    data = gather(motions, recipe.frames, mirrored=recipe.mirrored, missing=missing)
    held = gather(_together(choose, recipe), recipe.frames).evenly(_HELD)
    where = {"device": "cuda" if torch.cuda.is_available() else "cpu", "accelerator": _accelerator()}
    first = model.load_denoiser(start) if start and not resume else None
    run = (
        training.DenoiserTraining.resume(kept, data, **where)
        if resume
        else training.DenoiserTraining(recipe, data, **where, start=first)
    )
    measures = [training.held_errors(held), *([filling_judge(held)] if recipe.told else [])]
    validate = lambda made: {k: v for measure in measures for k, v in measure(made).items()}  # noqa: E731
    every = 1250 if recipe.steps > _LONG else 500
    how = {"every": every, "validate": validate, "judge": _judge(recipe, held), "judge_from": _JUDGE_FROM}
    run.run(keep=kept, **how, progress=True)
    if run.rank:
        return
    about = {
        "made by": command + (" --data FOLDER" if people or splits.RECORDED in choose else ""),
        "minutes of motion, before mirroring": {k: sum(m.seconds for m in v) / 60 for k, v in train.items()},
        **({"people": people} if people else {}),
        "minutes that chose the checkpoint": {k: sum(m.seconds for m in v) / 60 for k, v in choose.items()},
        "recordings": list(recordings),
        "corpus": asdict(corpus.Recipe()) | {"version": recipe.version},
        "windows": data.digest,
        "torch": torch.__version__,
        "chosen": {k: v for k, v in run.best.items() if k != "weights"} if run.best else {"step": run.step},
        "curve": run.curve,
        **({"began from": checkpoint.read_recipe(start)} if start else {}),
    }
    made = run.shipped
    model.save_denoiser(out, replace(made, denoiser=made.denoiser.cpu()), about, half=True)
    kept.unlink()
    if (gain := run.curve[-1].get(model.GAIN, 1.0)) <= _SILENT:
        print(f"the network adds nothing to its filter (gain {gain:.3f}): try a lower rate or a longer warm-up")
    print(f"{out.with_suffix('.safetensors')}: {run.step} steps, weights of step {about['chosen']['step']}")


def _judge(recipe: DenoiserRecipe, held: Motion) -> training.Judge | None:
    """Of what the model is for. None, and the last weights ship, where there is one candidate only, and for a model of
    handles, of which what is made without says little."""
    if recipe.handles or recipe.weights.handles or recipe.steps < _SHORT:
        return None
    return filling_judge(held) if recipe.told else kid_judge(held)


def _together(motions: dict[str, list[Motion]], recipe: DenoiserRecipe, copies: int = 0) -> list[Motion]:
    return splits.prepared([m for each in motions.values() for m in each], recipe, copies=copies)


def _accelerator():
    """Of ``accelerate``, where several processes were launched; None for one."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return None
    from accelerate import Accelerator

    return Accelerator(cpu=not torch.cuda.is_available())


def _poses(motions: Sequence[Motion], every: int = 1) -> Tensor:
    """Local rotations (N, 21, 3, 3) of every so many frames."""
    return torch.cat([m.rot[::every, 1:] for m in motions]).float()


def _first_states(
    motions: Sequence[Motion], every: int, generator: torch.Generator | None = None, *, causal: bool = False
) -> Tensor:
    """Features (N, 138) of every so many frames; with a generator, also of mirrored motions and of other bodies."""
    found = []
    for motion in motions:
        some = [motion]
        if generator is not None:
            some = [motion, mirror(motion), other_body(motion, generator), other_body(mirror(motion), generator)]
        for each in some:
            world = state.from_motion(each, causal=causal)[::every]
            found.append(priors.first_state_features(state.localise(world, state.heading(world))).float())
    return torch.cat(found)


def _command(name: str) -> str:
    return "python -m motionlab train small" + (f" --preset {name} --data FOLDER" if name != "compact" else "")


def make_pose_prior(
    train: _Motions,
    held: _Motions,
    out: Path,
    *,
    seed: int = 0,
    steps: int = STEPS,
    name: str = "compact",
    missing: Mapping[str, Sequence[Sequence[str]]] | None = None,
) -> dict:
    """Trains and writes the pose prior; returns its recipe.

    train, held: motions at 30 fps on the 22 joints, as ``train`` splits them. name: of the checkpoint, after
    ``pose_prior_``. missing: by source the joints that each motion lacks; None: none lacks any.
    """
    generator = torch.Generator().manual_seed(seed)
    found = {source: _poses(motions) for source, motions in train.items()}
    odds = [torch.full((len(x),), 1 / len(x)) for x in found.values()]  # each source as often as the other
    every, seen = torch.cat(list(found.values())), None
    if missing:
        lacks = [names for source in train for names in missing[source]]
        counts = torch.tensor([m.frames for some in train.values() for m in some])
        rows = torch.tensor([[joint not in names for joint in STANDARD.names[1:]] for names in lacks])
        seen = rows.repeat_interleave(counts, 0)
    how = {"steps": steps, "weight": torch.cat(odds), "seen": seen}
    model, history = prior_training.train_pose_prior(every, generator, **how)
    drawn = prior_training.samples(model, 2000, torch.Generator().manual_seed(seed))
    recipe = {
        "what": "pose prior: variational autoencoder, 21 rotations to 32 latents",
        "command": f"{_command(name)} --steps {steps} --seed {seed}",
        "data": {source: len(x) for source, x in found.items()},
        "corpus": asdict(corpus.Recipe()),
        "seed": seed,
        "steps": steps,
        "deviation": {"radians": prior_training.POSE_TURN, "metres": prior_training.POSE_PLACE},
        "held out": {name: prior_training.reconstruction(model, _poses(some, 3)) for name, some in held.items()},
        "beyond anatomical limits, degrees": {
            "samples": _beyond_limits(drawn),
            "training poses": _beyond_limits(every[::50]),
        },
        "history": [[step, round(miss, 3), round(nats, 3)] for step, miss, nats in history],
    }
    tensors = {n: x for n, x in model.state_dict().items() if not n.endswith("num_batches_tracked")}
    checkpoint.save(out / f"pose_prior_{name}", tensors, recipe)
    return recipe


def make_init_gmm(
    train: _Motions, held: _Motions, out: Path, *, seed: int = 0, name: str = "compact", causal: bool = False
) -> dict:
    """Fits and writes the mixture; returns its recipe. Arguments as of :func:`make_pose_prior`.

    causal: of states whose velocities are backward differences.
    """
    generator = torch.Generator().manual_seed(seed)
    every = 30 if causal else 15  # there are hours of it
    samples = _first_states([m for some in train.values() for m in some], every, generator, causal=causal)
    gmm, history = prior_training.fit_mixture(samples, generator)
    gmm = InitGmm(*(x.float() for x in gmm.tensors().values()))
    single, _ = prior_training.fit_mixture(samples, generator, components=1)
    tests = {source: _first_states(some, 3, causal=causal) for source, some in held.items()}
    recipe = {
        "what": "mixture of Gaussians over joints and velocities of a single frame",
        "command": f"{_command(name)} --seed {seed}",
        "data": {source: sum(m.frames for m in some) for source, some in train.items()},
        "samples": len(samples),
        "corpus": asdict(corpus.Recipe()),
        "seed": seed,
        "components": len(gmm.weights),
        "ridge": prior_training.MIXTURE_RIDGE,
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
    checkpoint.save(out / f"init_gmm_{name}", gmm.tensors(), recipe)
    return recipe


def make_features(
    folder: Path | str | None, out: Path, recipe: embedding.FeatureRecipe, *, recordings: Sequence[str] = ()
) -> dict:
    """Trains and writes the features that generated motion is judged in (``diffusion.embedding``); returns the recipe.

    folder: of recordings, or None. Trained on the training part of ``splits``, or on the people who train, watched on
    the choosing part.
    """
    usual = (splits.motions_by_part(folder, part) for part in ("train", "choose"))
    train, choose = real_motions(folder)[:2] if recipe.real else usual
    windows, held = (gather(_together(some, DenoiserRecipe()), recipe.frames) for some in (train, choose))
    features, curve = embedding.train_features(windows, recipe, held.evenly(256), progress=True)
    preset, with_data = "--preset real " * recipe.real, " --data FOLDER" * (splits.RECORDED in train)
    about = {
        "what": "autoencoder over windows of 60 frames: the features that generated motion is judged in",
        "command": f"python -m motionlab train features {preset}--steps {recipe.steps} --seed {recipe.seed}{with_data}",
        "minutes of motion, before mirroring": {k: sum(m.seconds for m in v) / 60 for k, v in train.items()},
        "recordings": list(recordings),
        "corpus": asdict(corpus.Recipe()),
        "windows": windows.digest,
        "torch": torch.__version__,
        "share of variance missed, held out": {k: round(v, 4) for k, v in features.missed(held.evenly(256)).items()},
        "curve": curve,
    }
    embedding.save_features(out, features, about)
    return about


@torch.no_grad()
def _beyond_limits(rot: Tensor) -> dict[str, float]:
    """Of poses (N, 21, 3, 3) against the anatomical limits: degrees beyond them (mean over poses of the worst joint,
    and over all joints), and the share of poses in which no angle is more than 5 degrees beyond."""
    whole = torch.cat((torch.eye(3).to(rot).expand(len(rot), 1, 3, 3), rot), 1)
    beyond = torch.stack(list(anatomy.excess(STANDARD, whole).values()), -1)
    return {
        "worst": float(beyond.amax(-1).mean()),
        "mean": float(beyond.mean()),
        "within 5 degrees": float((beyond.amax(-1) <= 5).float().mean()),
    }
