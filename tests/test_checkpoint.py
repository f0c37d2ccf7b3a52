"""Checkpoints: what is saved comes back; what is damaged, half written or foreign is refused; what ships is whole."""

import json

import pytest
import torch
from safetensors.torch import save as save_tensors

from motionlab import checkpoint
from motionlab.errors import DataError
from motionlab.humor import pretrained
from motionlab.humor.priors import Cvae, official_weights

RECIPE = {"what": "a test", "seed": 3}


@pytest.fixture
def kept(tmp_path):
    """A small model, saved."""
    torch.manual_seed(0)
    model = Cvae(64, skip=True, direct=True).frozen()
    checkpoint.save(tmp_path / "small", official_weights(model), RECIPE)
    return model, tmp_path / "small"


def test_what_is_saved_comes_back(kept):
    model, path = kept
    tensors, recipe = checkpoint.load(path)
    assert tensors.keys() == official_weights(model).keys()
    assert all(torch.equal(tensors[name], value) for name, value in official_weights(model).items())
    assert recipe.items() >= RECIPE.items()
    assert {p.name for p in path.parent.iterdir()} == {"small.safetensors", "small.json"}
    again = pretrained.load_motion_prior(str(path))
    x = torch.randn(5, 339, generator=torch.Generator().manual_seed(1))
    assert torch.equal(again.prior(x).mean, model.prior(x).mean)
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in model.state_dict().items())
    assert not any(p.requires_grad for p in again.parameters())


def test_half_precision_is_read_as_single(kept, tmp_path):
    model, _ = kept
    checkpoint.save(tmp_path / "half", {n: v.half() for n, v in official_weights(model).items()}, RECIPE)
    again = pretrained.load_motion_prior(str(tmp_path / "half"))
    assert {p.dtype for p in again.parameters()} == {torch.float32}
    assert torch.allclose(again.decoder.net[0].weight, model.decoder.net[0].weight, atol=1e-3)


def test_a_nudge_moves_the_last_digits_and_nothing_else(tmp_path, generator, monkeypatch):
    stored = {"x": torch.randn(1000, generator=generator), "none": torch.zeros(3), "count": torch.arange(3)}
    checkpoint.save(tmp_path / "a", stored, RECIPE)

    def loaded(seed):
        monkeypatch.setenv("MOTIONLAB_NUDGE", seed)
        return checkpoint.load(tmp_path / "a")[0]

    first, again, other = loaded("1"), loaded("1"), loaded("2")
    assert all(torch.equal(first[name], again[name]) for name in stored) and not torch.equal(first["x"], other["x"])
    assert all(torch.equal(first[name], stored[name]) for name in ("none", "count"))
    off = (first["x"] / stored["x"] - 1).double()
    assert 0.5e-7 < off.std() < 2e-7 and off.mean().abs() < 2e-8
    assert torch.equal(loaded("")["x"], stored["x"])


HARM = {  # file, and what its bytes become; None: it is gone
    "truncated": (".safetensors", lambda content: content[: len(content) // 2]),
    "one bit": (".safetensors", lambda content: content[:-5] + bytes([content[-5] ^ 1]) + content[-4:]),
    "of another": (".safetensors", lambda content: save_tensors({"x": torch.zeros(3)})),
    "no tensors": (".safetensors", None),
    "no recipe": (".json", None),
    "broken recipe": (".json", lambda content: b'{"seed": 3'),
    "recipe of a list": (".json", lambda content: b"[1, 2]"),
    "recipe without checksum": (".json", lambda content: json.dumps(RECIPE).encode()),
}


@pytest.mark.parametrize("harm", HARM)
def test_damage_is_refused_with_a_remedy(kept, harm):
    (_, path), (suffix, change) = kept, HARM[harm]
    file = path.with_suffix(suffix)
    file.write_bytes(change(file.read_bytes())) if change else file.unlink()
    with pytest.raises(DataError, match="small") as caught:
        checkpoint.load(path)
    assert "train" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda w: {"weight": torch.zeros(3)}, "prior_net"),
        (lambda w: w | {"encoder.net.0.bias": torch.zeros(7)}, "do not fit"),
        (lambda w: {n: v for n, v in w.items() if n != "decoder.net.9.bias"}, "do not fit"),
        (lambda w: w | {"decoder.net.9.bias": torch.full((216,), torch.nan)}, "not finite"),
    ],
)
def test_other_models_are_refused(kept, change, complaint):
    model, path = kept
    checkpoint.save(path.with_name("foreign"), change(official_weights(model)), RECIPE)
    with pytest.raises(DataError, match=complaint):
        pretrained.load_motion_prior(str(path.with_name("foreign")))


def test_the_shipped_prior_is_whole_and_small():
    model = pretrained.load_motion_prior("humor_real")
    assert set(official_weights(model)) == {*Cvae(64).state_dict(), "skip.weight"} and model.latent == 48
    assert (checkpoint.SHIPPED / "humor_real.safetensors").stat().st_size < 15e6
    assert not any(p.requires_grad for p in model.parameters()) and not model.training
    assert pretrained.load_motion_prior("humor_real") is model
