"""``python -m motionlab train``: make a checkpoint from synthetic motion and the recordings that may be used."""

import argparse
import os
from dataclasses import replace
from pathlib import Path

from motionlab import checkpoint
from motionlab.diffusion.encoder import EncoderRecipe
from motionlab.errors import DataError
from motionlab.training import recipes, train_more
from motionlab.training.courses import COURSES


def add_options(command: argparse.ArgumentParser) -> None:
    """Adds what ``train NAME`` takes."""
    command.add_argument(
        "model", choices=("small", "features", *COURSES),
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
        "--more", action="store_true", help=f"{', '.join(COURSES)}: go on from the kept run, or what ships"
    )
    command.set_defaults(run=_train)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, not {text!r}")
    return int(text)


def _train(options: argparse.Namespace) -> int:
    name, out = options.model, options.out
    if options.more and name not in COURSES:
        raise DataError(f"{name} takes no --more", remedy=f"it is for {', '.join(COURSES)}")
    if name == "small":
        data, out = recipes.real_motions(options.data), out or checkpoint.SHIPPED
        recipes.make_pose_prior(data, out, seed=options.seed, steps=options.steps or recipes.STEPS)
        recipes.make_init_gmm(data, out, seed=options.seed)
        return 0
    kind, recipe = COURSES.get(name, (None, EncoderRecipe()))
    recipe = replace(recipe, seed=options.seed, steps=options.steps or recipe.steps)
    if kind is None:
        recipes.make_encoder(options.data, out or checkpoint.SHIPPED / "features_real", recipe)
        return 0
    try:
        course, every = kind(name, recipe, options.data), min(2500, -(-recipe.steps // 8))
        train_more.go_on(course, out or checkpoint.SHIPPED / name, more=options.more, every=every)
    except KeyboardInterrupt:
        print("stopped; the same command with --more goes on")
    return 0
