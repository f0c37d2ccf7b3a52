"""``python -m motionlab train diffusion``: data, training, choice of the checkpoint and its recipe."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from data_synth import corpus
from motionlab import diffusion_data, library
from motionlab.diffusion import trained, training
from motionlab.diffusion.judge import filling, judge
from motionlab.diffusion.losses import Weights
from motionlab.diffusion.trained import Recipe
from motionlab.diffusion.windows import gather
from motionlab.errors import DataError
from motionlab.humor import checkpoint
from motionlab.motion import Motion

_WEIGHTS = Weights(velocity=20.0, contact=100.0, late=0.1, by_signal=True, even=True, snr=10.0)
_BASE = Recipe(
    patch=2, spectral=True, before=True, root_unit=0.08, dropout=0.0, steps=36_000, batch=16, lr=4e-4, warm_up=300,
    weights=_WEIGHTS,
)  # fmt: skip
#: free: free root, contacts, stuck root frame. fixed: the root over one spot, no contacts. world: in world space;
#: stuck: its twin in the stuck frame, all else equal. pose: single poses. handles: single poses, told where some joints
#: should be. told: told what is known, from the weights of stuck, whose units it shares.
#: root_unit: so that a unit of noise moves the root about as far as it moves a hand (CHANGELOG); not where the frame
#: is the question, or where the root is mostly known.
#: In world space the root lies metres off, not decimetres, at first: with the weights of the others fk and contact
#: would have a hundred times the gradient of all else.
_FAR = replace(_WEIGHTS, fk=0.002, contact=20.0)
_POSE = replace(
    _BASE, frames=1, patch=1, root_unit=0.0, contacts=False, spectral=False, linear=True, batch=128, steps=3000,
    weights=replace(_WEIGHTS, fk=0.5, velocity=0.0, contact=0.0, by_signal=False, snr=0.0),
)  # fmt: skip
_HELD = replace(_POSE, handles=64, recalls=12_000, steps=4000, weights=replace(_POSE.weights, fk=5.0, handles=20.0))
#: What is asked of it from pure noise is what it is used for: such windows are many, and count a third of the clearest.
_TOLD = replace(
    _BASE, told=True, blind=0.3, recalls=12_000, root_unit=0.0, steps=10_000,
    weights=replace(_WEIGHTS, fk=0.5, contact=20.0, snr=2.0),
)  # fmt: skip
_PLACE = replace(_BASE, root_unit=0.0, steps=10_000, weights=_FAR)
PRESETS = {
    "free": _BASE,
    "fixed": replace(_BASE, version="A", contacts=False, travels=False, steps=6000),
    "world": replace(_PLACE, frame="world"),
    "stuck": _PLACE,
    "pose": _POSE,
    "handles": _HELD,
    "told": _TOLD,
}
_ARM = replace(_BASE, size="small", steps=2000, lr=8e-4, warm_up=100)
_ARM_TOLD = replace(_TOLD, size="small", recalls=2000, steps=2000, warm_up=100)
_ARM_HELD = replace(_HELD, size="small", steps=1000)
#: Small models, briefly trained, that differ from "all" in one thing each; those of handles from "handles", and
#: "arrival" from "told".
ARMS = {
    "all": _ARM,
    "seed_1": replace(_ARM, seed=1),
    "seed_2": replace(_ARM, seed=2),
    "simple": replace(_ARM, weights=replace(_WEIGHTS, fk=0.0, velocity=0.0, contact=0.0)),
    "no_fk": replace(_ARM, weights=replace(_WEIGHTS, fk=0.0)),
    "no_velocity": replace(_ARM, weights=replace(_WEIGHTS, velocity=0.0)),
    "no_contact": replace(_ARM, weights=replace(_WEIGHTS, contact=0.0)),
    "plain": replace(_ARM, spectral=False),
    "noising_10": replace(_ARM, noising=10),
    "noising_50": replace(_ARM, noising=50),
    "noising_200": replace(_ARM, noising=200),
    "eighth": replace(_ARM, share=1 / 8),
    "quarter": replace(_ARM, share=1 / 4),
    "half": replace(_ARM, share=1 / 2),
    "no_unit": replace(_ARM, root_unit=0.0),
    "synthetic": replace(_ARM, source="synthetic"),
    "recordings": replace(_ARM, source="recordings"),
    "told": _ARM_TOLD,
    "arrival": replace(_ARM_TOLD, arrival=True),
    "handles": _ARM_HELD,
    "handles_thesis": replace(_ARM_HELD, linear=False, recalls=0),
    "handles_no_loss": replace(_ARM_HELD, weights=replace(_HELD.weights, handles=0.0)),
    "handles_no_embedding": replace(_ARM_HELD, handles=0),
}
PRESETS |= {f"arm_{name}": recipe for name, recipe in ARMS.items()}
#: Models that go on from the weights of another one that ships, told of nothing.
FROM = {"told": "diffusion_stuck", "arm_told": "arm_no_unit", "arm_arrival": "arm_no_unit"}
HELD = 256  # held-out windows that the checkpoint is chosen by
#: Of all steps: no earlier average is chosen. The error of x_0 falls to the end, and KID is too uncertain to tell a
#: lucky early average from a better late one (CHANGELOG).
JUDGE_FROM = 0.6
SILENT = 0.01  # gain over the filter; less says that the network has collapsed
SHORT = 5000  # steps; fewer are not judged


def chosen(found: dict[str, list[Motion]], recipe: Recipe) -> dict[str, list[Motion]]:
    """Of the motions by source, those that the recipe trains on: its source, and every n-th motion of it.

    Raises:
        DataError: the recipe's source is not there.
    """
    if recipe.source not in ("all", *found):
        message = f"no motions from {recipe.source!r}, only from {', '.join(found)}"
        raise DataError(message, remedy="give --data with recordings, or another preset")
    used = {name: motions for name, motions in found.items() if recipe.source in ("all", name)}
    return {name: library.spread(motions, max(1, round(len(motions) * recipe.share))) for name, motions in used.items()}


def begins(preset: str, recipe: Recipe) -> Path | None:
    """The checkpoint that a preset goes on from; None for new weights, and for a size that is not the preset's."""
    as_usual = recipe.size == PRESETS[preset].size
    return checkpoint.SHIPPED / FROM[preset] if preset in FROM and as_usual else None


def make(
    recipe: Recipe,
    folder: Path | str | None,
    out: Path,
    kept: Path,
    *,
    resume: bool,
    command: str,
    recordings: Sequence[str] = (),
    start: Path | None = None,
) -> None:
    """Train (or go on with ``kept``), write the checkpoint of the least KID (of handles: the last) to
    ``out``, with its recipe.

    Under ``accelerate launch`` every process calls this, and the first one writes.

    Args:
        folder: of recordings, or None. resume: go on with ``kept``. command, recordings: for the recipe: what was
            typed, and which sources were found. start: the checkpoint to begin from; None: new weights.

    Raises:
        DataError: nothing to learn from, or ``kept`` is not a run on these windows.
    """
    train = chosen(diffusion_data.sources(folder, "train"), recipe)
    choose = diffusion_data.sources(folder, "choose")
    data = gather(_together(train, recipe, recipe.copies), recipe.frames, mirrored=recipe.mirrored)
    held = gather(_together(choose, recipe), recipe.frames).evenly(HELD)
    where = {"device": "cuda" if torch.cuda.is_available() else "cpu", "accelerator": _accelerator()}
    first = trained.load(start) if start and not resume else None
    run = training.resume(kept, data, **where) if resume else training.Training(recipe, data, **where, start=first)
    run.run(keep=kept, held=held, judge=_judge(recipe, held), judge_from=JUDGE_FROM, progress=True)
    if run.rank:
        return
    about = {
        "made by": command + (" --data FOLDER" if diffusion_data.RECORDED in choose else ""),
        "minutes of motion, before mirroring": {k: sum(m.seconds for m in v) / 60 for k, v in train.items()},
        "minutes that chose the checkpoint": {k: sum(m.seconds for m in v) / 60 for k, v in choose.items()},
        "recordings": list(recordings),
        "corpus": asdict(corpus.Recipe()) | {"version": recipe.version},
        "windows": data.digest,
        "torch": torch.__version__,
        "chosen": {k: v for k, v in run.best.items() if k != "weights"} if run.best else {"step": run.step},
        "curve": run.curve,
        **({"began from": checkpoint.read_recipe(start)} if start else {}),
    }
    trained.save(out, _on_cpu(run.shipped), about, half=True)
    kept.unlink()
    if (gain := run.curve[-1].get(training.GAIN, 1.0)) <= SILENT:
        print(f"the network adds nothing to its filter (gain {gain:.3f}): try a lower rate or a longer warm-up")
    print(f"{out.with_suffix('.safetensors')}: {run.step} steps, weights of step {about['chosen']['step']}")


def _judge(recipe: Recipe, held: Motion) -> training.Judge | None:
    """Of what the model is for. None, and the last weights ship, where there is one candidate only, and for a model of
    handles, of which what is made without says little."""
    if recipe.handles or recipe.weights.handles or recipe.steps < SHORT:
        return None
    return filling(held) if recipe.told else judge(held)


def _together(motions: dict[str, list[Motion]], recipe: Recipe, copies: int = 0) -> list[Motion]:
    return diffusion_data.prepared([m for each in motions.values() for m in each], recipe, copies=copies)


def _on_cpu(model: trained.Trained) -> trained.Trained:
    return replace(model, denoiser=model.denoiser.cpu())


def _accelerator():
    """Of ``accelerate``, where several processes were launched; None for one."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return None
    from accelerate import Accelerator

    return Accelerator(cpu=not torch.cuda.is_available())
