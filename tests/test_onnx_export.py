"""The completer as an ONNX file: what onnxruntime and numpy make of it is what torch makes of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from motionlab.baselines import curve_weights
from motionlab.commands import onnx_export
from motionlab.diffusion.completer import Completer, CompleterRecipe
from motionlab.errors import DataError
from motionlab.motion import FPS, Motion
from motionlab.skeleton import STANDARD

RECIPE = CompleterRecipe(size=64, layers=1)


def test_the_file_fills_as_the_model_does(tmp_path, motions):
    """Known frames to the bit, the others to 1e-4; with another model to more."""
    onnxruntime = pytest.importorskip("onnxruntime")
    torch.manual_seed(0)
    model = Completer(RECIPE).eval().requires_grad_(False)
    torch.nn.init.normal_(model.said.weight, std=0.02)
    onnx_export.export(model, tmp_path / "gaps.onnx")
    clip = motions[0].cut(30, 90)
    motion = Motion(STANDARD, clip.root[None].float(), clip.rot[None].float(), FPS, torch.zeros(1, 60, 9))
    frames = np.ones((1, 60), bool)
    frames[:, 12:44] = False
    session = onnxruntime.InferenceSession(tmp_path / "gaps.onnx")
    given = (
        motion.root.numpy(),
        motion.rot.numpy(),
        frames.astype(np.float32),
        curve_weights(torch.from_numpy(frames)).float().numpy(),
    )
    root, rot = session.run(None, dict(zip(onnx_export.INPUTS, given, strict=True)))
    known = torch.from_numpy(frames)[..., None].expand(-1, -1, len(STANDARD) + 2).clone()
    known[..., -1] = False
    made = model.complete(motion, known)
    assert abs(root - made.root.numpy()).max() < 1e-4 and abs(rot - made.rot.numpy()).max() < 1e-4
    assert (root[frames] == given[0][frames]).all() and (rot[frames] == given[1][frames]).all()
    model.said.weight.mul_(2)
    assert abs(rot - model.complete(motion, known).rot.numpy()).max() > 1e-2


def test_a_model_that_draws_is_refused(tmp_path):
    with pytest.raises(DataError, match="draws"):
        onnx_export.export(Completer(replace(RECIPE, diffusion=True)), tmp_path / "a.onnx")
    with pytest.raises(DataError, match="40 frames"):
        onnx_export.export(Completer(replace(RECIPE, frames=40)), tmp_path / "a.onnx")
    with pytest.raises(DataError, match="no such folder"):
        onnx_export.export(Completer(RECIPE), tmp_path / "none" / "a.onnx")
