"""The completer as an ONNX file, but for what onnxruntime makes of it: that, an example in test_readme says."""

from dataclasses import replace

import pytest

from motionlab.commands import onnx_export
from motionlab.diffusion.completer import Completer, CompleterRecipe
from motionlab.errors import DataError

RECIPE = CompleterRecipe(size=64, layers=1)


def test_a_model_that_draws_is_refused(tmp_path):
    with pytest.raises(DataError, match="draws"):
        onnx_export.export(Completer(replace(RECIPE, diffusion=True)), tmp_path / "a.onnx")
    with pytest.raises(DataError, match="40 frames"):
        onnx_export.export(Completer(replace(RECIPE, frames=40)), tmp_path / "a.onnx")
    with pytest.raises(DataError, match="no such folder"):
        onnx_export.export(Completer(RECIPE), tmp_path / "none" / "a.onnx")
