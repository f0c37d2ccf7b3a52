"""``python -m motionlab train diffusion``: data, training, choice of the checkpoint and its recipe."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from data_synth import corpus
from motionlab import library
from motionlab.diffusion import trained, training
from motionlab.diffusion.judge import judge
from motionlab.diffusion.losses import Weights
from motionlab.diffusion.trained import Recipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.frames import fix_root_horizontally
from motionlab.humor import variety
from motionlab.motion import Motion

Motions = Mapping[str, Sequence[Motion]]  # by source

_WEIGHTS = Weights(late=0.1, even=True)
#: free: free root, contacts, stuck root frame. fixed: the root over one spot, no contacts. world: as free, in world
#: space. pose: single poses. told: as free, told what is known.
#: In world space the root lies metres off, not decimetres, at first: with the weights of the others fk and contact
#: would have a hundred times the gradient of all else.
PRESETS = {
    "free": Recipe(weights=_WEIGHTS),
    "fixed": Recipe(version="A", contacts=False, travels=False, weights=_WEIGHTS),
    "world": Recipe(frame="world", weights=replace(_WEIGHTS, fk=0.002, contact=1.0)),
    "pose": Recipe(frames=1, contacts=False, batch=256, weights=replace(_WEIGHTS, velocity=0.0, contact=0.0)),
    "told": Recipe(told=True, weights=_WEIGHTS),
}
HELD = 256  # held-out windows that the checkpoint is chosen by


def sources(folder: Path | str | None) -> tuple[dict[str, list[Motion]], dict[str, list[Motion]]]:
    """Motions by source that train, and that choose the checkpoint.

    The held-out subject of the corpus and every second held-out recording are in neither: results are reported on them.
    """
    made = corpus.build(version="B")
    train = {"synthetic": [s.motion for s in made.train]}
    choose = {"synthetic, unseen sequence": [s.motion for s in made.heldout_sequences]}
    used, left = library.trainable(folder)
    if used:
        train["recordings"], choose["recordings, unseen"] = used, left[::2]
    return train, choose


def prepared(motions: Sequence[Motion], recipe: Recipe, *, copies: int = 0) -> list[Motion]:
    """On the standard body, of the recipe's version of the data, each with so many copies held otherwise."""
    generator, found = torch.Generator().manual_seed(recipe.seed), []
    for motion in map(on_standard, motions):
        for each in (motion, *(variety.held_otherwise(motion, generator) for _ in range(copies))):
            found.append(fix_root_horizontally(each) if recipe.version == "A" else each)
    return found


def make(
    recipe: Recipe,
    folder: Path | str | None,
    out: Path,
    kept: Path,
    *,
    resume: bool,
    command: str,
    recordings: Sequence[str] = (),
) -> None:
    """Train (or go on with ``kept``), write the checkpoint of the least KID to ``out``, with its recipe.

    Under ``accelerate launch`` every process calls this, and the first one writes.

    Args:
        folder: of recordings, or None. resume: go on with ``kept``. command, recordings: for the recipe: what was
            typed, and which sources were found.

    Raises:
        DataError: nothing to learn from, or ``kept`` is not a run on these windows.
    """
    train, choose = sources(folder)
    data = gather(
        prepared([m for motions in train.values() for m in motions], recipe, copies=recipe.copies), recipe.frames,
        mirrored=recipe.mirrored,
    )  # fmt: skip
    held = gather(prepared([m for motions in choose.values() for m in motions], recipe), recipe.frames).evenly(HELD)
    where = {"device": "cuda" if torch.cuda.is_available() else "cpu", "accelerator": _accelerator()}
    run = training.resume(kept, data, **where) if resume else training.Training(recipe, data, **where)
    run.run(keep=kept, held=held, judge=judge(held), progress=True)
    if run.rank:
        return
    about = {
        "made by": command + (" --data FOLDER" if "recordings" in train else ""),
        "minutes of motion, before mirroring": {k: sum(m.seconds for m in v) / 60 for k, v in train.items()},
        "minutes that chose the checkpoint": {k: sum(m.seconds for m in v) / 60 for k, v in choose.items()},
        "recordings": list(recordings),
        "corpus": asdict(corpus.Recipe()) | {"version": recipe.version},
        "windows": data.digest,
        "torch": torch.__version__,
        "chosen": {"step": run.best["step"], "kid": run.best["kid"]} if run.best else {"step": run.step},
        "curve": run.curve,
    }
    trained.save(out, _on_cpu(run.shipped), about, half=True)
    kept.unlink()
    print(f"{out.with_suffix('.safetensors')}: {run.step} steps, weights of step {about['chosen']['step']}")


def _on_cpu(model: trained.Trained) -> trained.Trained:
    return replace(model, denoiser=model.denoiser.cpu())


def _accelerator():
    """Of ``accelerate``, where several processes were launched; None for one."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return None
    from accelerate import Accelerator

    return Accelerator(cpu=not torch.cuda.is_available())
