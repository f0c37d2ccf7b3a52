"""Writes the completer as an ONNX file that fills gaps between known frames, for editors without Python or torch.

The file takes a window of the standard skeleton at 30 frames a second: ``root`` (1, 60, 3) metres, z up; ``rotations``
(1, 60, 22, 3, 3), each relative to its parent; ``known`` (1, 60), 1 where a frame is known; ``curves`` (1, 60, 60),
what a smooth curve through those frames is of them (``baselines.curve_weights``; docs/library.md computes it
with numpy alone). It gives back root and rotations, known frames to the bit. Contacts are told nowhere. The first frame
has to be known.
"""

import argparse
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from motionlab.baselines import curve_weights
from motionlab.diffusion import features
from motionlab.diffusion.completer import Completer, load
from motionlab.errors import DataError, MissingData
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import FPS, Motion
from motionlab.skeleton import STANDARD

_FRAMES = 60
INPUTS, OUTPUTS = ("root", "rotations", "known", "curves"), ("root_filled", "rotations_filled")


class _Gaps(nn.Module):
    """A completer of whole frames, its curves given."""

    def __init__(self, model: Completer) -> None:
        super().__init__()
        self.model = model

    def forward(self, root: Tensor, rotations: Tensor, known: Tensor, curves: Tensor) -> tuple[Tensor, Tensor]:
        model, whole = self.model, known[..., None] > 0.5
        none = torch.zeros_like(root[..., :1]).expand(-1, -1, len(STANDARD.contact_names))
        local, frame = stuck_root(Motion(STANDARD, root, rotations, FPS, none))
        mean, scale = model.sizes
        units = whole & (torch.arange(features.UNITS) < features.UNITS - 1)
        numbers = torch.where(units[..., features.OWNERS], (features.made(local) - mean) / scale, 0.0)
        begun = (curves @ numbers) * scale + mean
        begun = torch.where(units[..., features.OWNERS], features.made(local), begun)
        begun = features.made(features.motion_of(begun, local))
        states = features.states(features.motion_of(begun, local))
        made = local_to_world(frame, features.motion_of(begun + model(states, units, FPS) * scale, local))
        return torch.where(whole, root, made.root), torch.where(whole[..., None, None], rotations, made.rot)


def export(model: Completer, path: Path | str) -> None:
    """Writes ``path`` (.onnx).

    Raises:
        MissingData: the packages that write such files are not installed.
        DataError: the model draws, or was not trained on windows of 60 frames; or there is no such folder.
    """
    if model.recipe.diffusion or model.recipe.frames != _FRAMES:
        what = "draws" if model.recipe.diffusion else f"takes windows of {model.recipe.frames} frames"
        raise DataError(f"this model {what}", remedy=f"export one of one answer and {_FRAMES} frames")
    if not Path(path).resolve().parent.is_dir():
        raise DataError("no such folder", path=path, remedy="make it first")
    try:
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise MissingData("the package onnxscript", "pip install -e '.[onnx]'") from error
    root, known = torch.zeros(1, _FRAMES, 3), torch.ones(1, _FRAMES)
    rotations = torch.eye(3).expand(1, _FRAMES, len(STANDARD), 3, 3).contiguous()
    known[:, 5:-5] = 0.0
    sample = (root, rotations, known, curve_weights(known > 0.5).float())
    gaps = _Gaps(model).eval()
    gaps(*sample)  # what the skeleton keeps is computed now, not while it is traced
    with warnings.catch_warnings():  # torch warns of its own calls
        warnings.simplefilter("ignore", FutureWarning)
        how = {"dynamo": True, "external_data": False, "optimize": True, "verbose": False}
        torch.onnx.export(gaps, sample, str(path), input_names=list(INPUTS), output_names=list(OUTPUTS), **how)


def run(options: argparse.Namespace) -> int:
    """Writes a completer that ships, or another."""
    export(load(options.model), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB; takes {', '.join(INPUTS)}")
    return 0
