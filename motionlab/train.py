"""``python -m motionlab train``: make a checkpoint from synthetic motion and the recordings that may be used."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

from motionlab import checkpoint, shipped, train_completer, train_more, train_plain, train_prior
from motionlab.diffusion.embedding import FeatureRecipe
from motionlab.errors import DataError

_COURSES = {name: home for home in (train_completer, train_plain, train_prior) for name in home.RECIPES}


def add_options(command: argparse.ArgumentParser) -> None:
    """Adds what ``train NAME`` takes."""
    command.add_argument(
        "model", choices=("small", "features", *_COURSES),
        help="pose and first states; what generated motion is judged in; what completes motions, a denoiser and a "
        "transition prior, trained until Ctrl-C",
    )  # fmt: skip
    command.add_argument("--steps", type=_count, help="optimiser steps, the whole schedule (default: the recipe's)")
    command.add_argument("--seed", type=int, default=0, help="default: 0")
    command.add_argument(
        "--data", default=os.environ.get("MOTIONLAB_DATA"), help="recordings, besides synthetic motion"
    )
    command.add_argument("--out", type=Path, help="default: the checkpoint that ships; of small, its folder")
    command.add_argument(
        "--more", action="store_true", help=f"{', '.join(_COURSES)}: go on from the kept run, or what ships"
    )
    command.set_defaults(run=_train)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, not {text!r}")
    return int(text)


def _train(options: argparse.Namespace) -> int:
    if options.model in _COURSES:
        return _train_on(options)
    if options.more:
        raise DataError(f"{options.model} takes no --more", remedy=f"it is for {', '.join(_COURSES)}")
    if options.model == "small":
        data, out = shipped.real_motions(options.data), options.out or checkpoint.SHIPPED
        shipped.make_pose_prior(data, out, seed=options.seed, steps=options.steps or shipped.STEPS)
        shipped.make_init_gmm(data, out, seed=options.seed)
        return 0
    recipe = replace(FeatureRecipe(), seed=options.seed)
    recipe = replace(recipe, steps=options.steps or recipe.steps)
    shipped.make_features(options.data, options.out or checkpoint.SHIPPED / "features_real", recipe)
    return 0


def _train_on(options: argparse.Namespace) -> int:
    """Trains until Ctrl-C."""
    home = _COURSES[options.model]
    recipe = home.RECIPES[options.model]
    recipe = replace(recipe, steps=options.steps or recipe.steps, seed=options.seed)
    out = options.out or checkpoint.SHIPPED / options.model
    try:
        course, every = home.Course(options.model, recipe, options.data), min(2500, -(-recipe.steps // 8))
        train_more.go_on(course, out, more=options.more, every=every)
    except KeyboardInterrupt:
        print("stopped; the same command with --more goes on")
    return 0
