"""``python -m motionlab train``: make a checkpoint from synthetic motion and the recordings that may be used."""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict, replace
from pathlib import Path

import torch

from motionlab import checkpoint, shipped, splits, train_completer, train_more, train_plain, train_prior
from motionlab.diffusion.embedding import FeatureRecipe
from motionlab.errors import DataError
from motionlab.humor import examples, quality, training
from motionlab.humor.cvae import Cvae, official_weights
from motionlab.motion import Motion

_COURSES = {name: home for home in (train_completer, train_plain, train_prior) for name in home.RECIPES}


def add_options(command: argparse.ArgumentParser) -> None:
    """Adds what ``train NAME`` takes."""
    command.add_argument(
        "model", choices=("humor", "small", "features", *_COURSES),
        help="transition prior; pose and first states; what generated motion is judged in; what completes motions, a "
        "denoiser and a transition prior of hours of recordings, trained until Ctrl-C",
    )  # fmt: skip
    command.add_argument(
        "--preset", choices=[name for presets in _presets().values() for name in presets],
        help="default: the first of " + "; ".join(f"{model}: {', '.join(each)}" for model, each in _presets().items()),
    )  # fmt: skip
    command.add_argument("--steps", type=_count, help="optimiser steps, the whole schedule (default: the preset's)")
    command.add_argument("--seed", type=int, help="default: 0")
    command.add_argument(
        "--data", default=os.environ.get("MOTIONLAB_DATA"), help="recordings, besides synthetic motion"
    )
    command.add_argument("--out", type=Path, help="default: the checkpoint that ships")
    command.add_argument("--resume", action="store_true", help="go on with a run that was stopped, as it was begun")
    command.add_argument(
        "--more", action="store_true", help=f"{', '.join(_COURSES)}: go on from the kept run, or what ships"
    )
    command.set_defaults(run=_train)


def _presets() -> dict[str, dict]:
    return {"humor": training.PRIOR_PRESETS, "small": dict.fromkeys(("compact", "real"))}


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, not {text!r}")
    return int(text)


def _training_sources(folder: Path | str | None) -> tuple[dict[str, list[Motion]], dict[str, list[Motion]]]:
    """Motions for training and held out, by source; a recording is used where its licence lets weights be shipped."""
    from data_synth import corpus

    made = corpus.build(version="B")
    train, held = {}, {}
    train["synthetic"] = [s.motion for s in made.train]
    held["synthetic, unseen sequence"] = [s.motion for s in made.heldout_sequences]
    held["synthetic, unseen person"] = [s.motion for s in made.heldout_subject]
    used, left = splits.trainable(folder)
    if used:
        train["recordings"], held["recordings"] = used, left
    return train, held


def _together(train: dict[str, list[Motion]], recipe: training.PriorRecipe) -> list[Motion]:
    """All motions and, of each, copies on other bodies and held otherwise, as many as the recipe says."""
    generator = torch.Generator().manual_seed(recipe.seed)
    copies = {name: recipe.varied if name == "synthetic" else recipe.varied_recordings for name in train}
    return [
        each
        for name, motions in train.items() for motion in motions
        for each in (motion, *(examples.varied_motion(motion, generator) for _ in range(copies[name])))
    ]  # fmt: skip


def _wanted(options: argparse.Namespace, kept: Path) -> training.PriorRecipe:
    """The recipe asked for; with --resume that of the kept run, whose steps and seed need not be given again.

    Raises:
        DataError: no such preset; or the kept run is missing, damaged or of another recipe.
    """
    presets = _presets()[options.model]
    options.preset = options.preset or next(iter(presets))
    if options.preset not in presets:
        raise DataError(f"{options.model} has no preset {options.preset!r}", remedy=f"choose {', '.join(presets)}")
    before = training.PriorTraining.kept_recipe(kept) if options.resume else None
    recipe = presets[options.preset]
    asked = {name: value for name in ("steps", "seed") if (value := getattr(options, name)) is not None}
    kept_ones = {name: getattr(before, name) for name in ("steps", "seed")} if before else {}
    recipe = replace(recipe, **kept_ones | asked)
    if before and recipe != before:
        was, now = asdict(before), asdict(recipe)
        others = ", ".join(f"{name} {was[name]}, not {now[name]}" for name in was if was[name] != now[name])
        remedy = "ask for the same, or start afresh, without --resume"
        raise DataError(f"this run was begun with {others}", path=kept, remedy=remedy)
    return recipe


def _train(options: argparse.Namespace) -> int:
    if options.model in _COURSES:
        return _train_on(options)
    if options.more:
        raise DataError(f"{options.model} takes no --more", remedy=f"it is for {', '.join(_COURSES)}; use --resume")
    if options.model == "small":
        out, how = options.out or checkpoint.SHIPPED, {"seed": options.seed or 0, "name": options.preset or "compact"}
        real = how["name"] == "real"
        train, held, missing, *_ = (
            shipped.real_motions(options.data) if real else (*_training_sources(options.data), None)
        )
        shipped.make_pose_prior(train, held, out, **how, steps=options.steps or shipped.STEPS, missing=missing)
        shipped.make_init_gmm(train, held, out, **how, causal=real)
        return 0
    if options.model == "features":
        if options.preset:
            raise DataError("features have no presets", remedy="leave --preset out")
        recipe = replace(FeatureRecipe(), seed=options.seed or 0)
        recipe = replace(recipe, steps=options.steps or recipe.steps)
        shipped.make_features(options.data, options.out or checkpoint.SHIPPED / "features_real", recipe)
        return 0
    preset = options.preset or next(iter(_presets()[options.model]))
    out = options.out or checkpoint.SHIPPED / f"{options.model}_{preset}"
    kept = out.with_suffix(".partial.pt")
    recipe = _wanted(options, kept)
    train, held = _training_sources(options.data)
    data = examples.examples(_together(train, recipe), recipe.length + 1)
    run = training.PriorTraining.resume(kept, data) if options.resume else training.PriorTraining(recipe, data)
    judged = {name: found for name, motions in held.items() if len((found := splits.state_windows(motions))[0])}

    def validate(model: Cvae) -> dict[str, float]:
        row = {}
        for name, (x, _) in judged.items():
            step, way = quality.one_step_errors(model, x), quality.rollout_errors(model, x)
            row |= {
                f"{name}: one step": float(step["posterior"].mean()),
                f"{name}: kl": float(step["kl"].sum(-1).mean()),
            }
            row[f"{name}: 2 s"] = float(way["posterior z"][:, -1].mean())
        return row

    run.run(keep=kept, every=250, validate=validate, progress=True)
    minutes = {name: sum(m.seconds for m in motions) / 60 for name, motions in train.items()}  # copies not counted
    about = {
        "made by": f"python -m motionlab train humor --preset {options.preset} --steps {recipe.steps} "
        f"--seed {recipe.seed}" + (" --data FOLDER" if "recordings" in train else ""),
        "recipe": asdict(run.recipe), "minutes of motion, before mirroring": minutes,
        "minutes of motion, with copies and mirror images": len(data.states) / 30 / 60, "examples": data.digest,
        "recordings": _found_in(options.data) if "recordings" in train else [], "torch": torch.__version__,
        "quality, held out": {name: quality.quality_row(run.averaged, *found) for name, found in judged.items()},
        "curve": run.curve,
    }  # fmt: skip
    checkpoint.save(out, official_weights(run.averaged), about)
    kept.unlink()
    print(f"{out.with_suffix('.safetensors')}: {run.step} steps")
    return 0


def _train_on(options: argparse.Namespace) -> int:
    """Trains until Ctrl-C."""
    asked = [name for name in ("preset", "resume") if getattr(options, name)]
    if asked:
        raise DataError(f"{options.model} takes no --{asked[0]}", remedy="--more goes on from --out")
    home = _COURSES[options.model]
    recipe = home.RECIPES[options.model]
    recipe = replace(recipe, steps=options.steps or recipe.steps, seed=options.seed or 0)
    out = options.out or checkpoint.SHIPPED / options.model
    try:
        train_more.go_on(home.Course(options.model, recipe, options.data), out, more=options.more)
    except KeyboardInterrupt:
        print("stopped; the same command with --more goes on")
    return 0


def _found_in(folder: Path | str) -> list[str]:
    """Sources in a folder of recordings whose licences let weights be shipped."""
    return [source for source in splits.SHIPPABLE if (Path(folder) / source).is_dir()]
