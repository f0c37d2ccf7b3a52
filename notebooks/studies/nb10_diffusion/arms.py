"""Small denoisers, briefly trained, that differ from one in a single thing: what notebooks 10, 13, 14 and 15 compare.

They ship as ``arm_NAME``. ``make train`` trains them; from ``notebooks/``: ``python -m studies.nb10_diffusion.arms``,
or some of them by name. A run that was stopped goes on where its ``.partial.pt`` lies beside the checkpoint.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from motionlab import checkpoint, shipped, splits
from motionlab.diffusion.training import DenoiserTraining
from motionlab.shipped import DENOISER_PRESETS

_BASE, _TOLD, _HANDLES = (DENOISER_PRESETS[name] for name in ("free", "told", "handles"))
_ARM = replace(_BASE, size="small", steps=2000, lr=8e-4, warm_up=100)
_ARM_TOLD = replace(_TOLD, size="small", recalls=2000, steps=2000, warm_up=100)
_ARM_HELD = replace(_HANDLES, size="small", steps=1000)
#: All but those of handles, which differ from "handles", and "arrival", which differs from "told", differ from "all".
ARMS = {
    "all": _ARM,
    "seed_1": replace(_ARM, seed=1),
    "seed_2": replace(_ARM, seed=2),
    "simple": replace(_ARM, weights=replace(_ARM.weights, fk=0.0, velocity=0.0, contact=0.0)),
    "no_fk": replace(_ARM, weights=replace(_ARM.weights, fk=0.0)),
    "no_velocity": replace(_ARM, weights=replace(_ARM.weights, velocity=0.0)),
    "no_contact": replace(_ARM, weights=replace(_ARM.weights, contact=0.0)),
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
    "handles_no_loss": replace(_ARM_HELD, weights=replace(_ARM_HELD.weights, handles=0.0)),
    "handles_no_embedding": replace(_ARM_HELD, handles=0),
}
#: Arms that go on from the weights of another one, told of nothing.
FROM = {"told": "no_unit", "arrival": "no_unit"}


def train(name: str, data: Path | str | None, out: Path = checkpoint.SHIPPED) -> None:
    """Train one arm into ``out``/arm_NAME, or go on with it. data: folder of recordings, or None.

    Raises:
        DataError: an arm of recordings without recordings, or what is kept is not a run on these windows.
    """
    kept = out / f"arm_{name}.partial.pt"
    shipped.make(
        ARMS[name], data, out / f"arm_{name}", kept,
        resume=kept.exists() and DenoiserTraining.kept_recipe(kept) == ARMS[name],
        command=f"python -m studies.nb10_diffusion.arms {name}",
        recordings=[source for source in splits.SHIPPABLE if (Path(data) / source).is_dir()] if data else [],
        start=_start(name, out),
    )  # fmt: skip


def _start(name: str, out: Path) -> Path | None:
    """Where the arm that this one begins from lies: beside it, or where arms ship."""
    if name not in FROM:
        return None
    beside = out / f"arm_{FROM[name]}"
    return beside if beside.with_suffix(".json").exists() else checkpoint.SHIPPED / beside.name


def command(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.nb10_diffusion.arms", description="Train the arms of notebook 10."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(ARMS)} (default: all)")
    parser.add_argument("--data", default=os.environ.get("MOTIONLAB_DATA"), help="recordings, besides synthetic motion")
    parser.add_argument("--out", type=Path, default=checkpoint.SHIPPED, help="default: where they ship")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in ARMS]:
        parser.error(f"no arm {unknown[0]!r}")
    for name in options.names or ARMS:
        train(name, options.data, options.out)


if __name__ == "__main__":
    command()
