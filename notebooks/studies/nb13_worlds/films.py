"""A few samples of the small models of notebook 13, small enough to be kept with its rows.

    PYTHONPATH=notebooks python -m studies.nb13_worlds.films

Of each arm's first seed, of the samples that travel, those at the quartiles of skating: nobody picks them by eye.
"""

import io

import numpy as np
import torch

from motionlab import rotation
from motionlab.diffusion.model import load_denoiser
from motionlab.files import write_whole
from motionlab.heading import stuck_root
from motionlab.motion import FPS, Motion
from motionlab.skeleton import STANDARD
from studies.shared import small_measures, small_models

QUARTILES = (0.25, 0.5, 0.75)
_COUNT, _TRAVELS = 204, 0.2  # samples; m/s


def kept() -> dict[str, Motion]:
    """Reads what is kept: by arm, samples (3, T) that skate little, middling and much, each from its first frame."""
    with np.load(small_models.RECORDS / "small_frames_films.npz") as found:
        arms = [name.removesuffix(" root") for name in found.files if name.endswith(" root")]
        parts = {arm: [torch.from_numpy(found[f"{arm} {what}"]).float() for what in ("root", "turns")] for arm in arms}
    return {arm: Motion(STANDARD, root, rotation.exp(turns), FPS) for arm, (root, turns) in parts.items()}


def typical(made: Motion) -> Motion:
    """Of samples (N, T) those at the quartiles of skating, among the ones that travel."""
    skating = small_measures.skating(made)
    going = (small_measures.travel(made) >= _TRAVELS).nonzero()[:, 0]
    order = going[skating[going].argsort(stable=True)]
    return made.clip(order[[round(q * (len(order) - 1)) for q in QUARTILES]])


def main() -> None:
    """Draws the samples that were measured once more, and keeps some."""
    torch.set_num_threads(1)
    arrays = {}
    for arm in small_models.SETS["frames"]:
        if arm.recipe.seed == 0:
            model = load_denoiser(small_models.folder() / arm.digest)
            some = stuck_root(typical(small_measures.made_up(model, _COUNT)))[0]
            arrays[f"{arm.name} root"] = some.root.numpy().astype(np.float32)
            arrays[f"{arm.name} turns"] = rotation.log(some.rot).numpy().astype(np.float16)
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    write_whole(small_models.RECORDS / "small_frames_films.npz", content.getvalue())


if __name__ == "__main__":
    main()
