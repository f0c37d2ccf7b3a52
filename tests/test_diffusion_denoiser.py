"""MDM's network: its names, its size, and a twin written with plain matrices."""

import pytest
import torch

from motionlab.diffusion.denoiser import SIZES, Denoiser
from motionlab.errors import ShapeError
from studies.nb10_diffusion.network_checks import twin

OFFICIAL = {  # names and shapes of the official unconstrained model (its tables of sines are not loaded)
    "input_process.poseEmbedding.weight": (512, 150), "output_process.poseFinal.weight": (150, 512),
    "seqTransEncoder.layers.7.self_attn.in_proj_weight": (1536, 512),
    "seqTransEncoder.layers.0.self_attn.out_proj.bias": (512,), "seqTransEncoder.layers.3.linear1.weight": (1024, 512),
    "seqTransEncoder.layers.3.linear2.weight": (512, 1024), "seqTransEncoder.layers.7.norm2.weight": (512,),
    "embed_timestep.time_embed.0.weight": (512, 512), "embed_timestep.time_embed.2.bias": (512,),
}  # fmt: skip


@pytest.fixture(scope="module")
def small():
    torch.manual_seed(0)
    return Denoiser(10, size=16, layers=2, heads=4, hidden=24).eval()


def test_the_twin_agrees(small, generator):
    x, t = torch.randn(3, 12, 10, generator=generator), torch.tensor([0, 7, 999])
    with torch.no_grad():
        found = small(x, t)
    for clip, step, ours in zip(x, t, found, strict=True):
        assert (twin(small, clip, step) - ours).abs().max() < 1e-5
    assert (twin(small, x[0], 500) - found[0]).abs().max() > 1e-3  # the step matters


def test_names_shapes_and_size_are_mdm_s():
    tensors = Denoiser(150, **SIZES["thesis"]).state_dict()
    for name, shape in OFFICIAL.items():
        assert tuple(tensors[name].shape) == shape, name
    assert sum(x.numel() for x in tensors.values()) == 17_501_846
    assert not any(name.endswith("sequence_pos_encoder.pe") for name in tensors)


def test_a_model_that_is_told_reads_what_is_known(generator):
    torch.manual_seed(1)
    model = Denoiser(6, size=16, layers=1, heads=2, hidden=16, told=True).eval()
    x, t = torch.randn(2, 4, 6, generator=generator), torch.tensor([1, 1])
    mask = torch.zeros(4, 6)
    mask[0] = 1
    known = torch.randn(2, 4, 6, generator=generator)
    nothing, something = model(x, t), model(x, t, known, mask)
    assert (nothing - something).abs().max() > 1e-3
    guess = torch.randn(2, 4, 6, generator=generator)
    assert not torch.allclose(model(x, t, known, mask, guess=guess), something, atol=1e-3)
    assert torch.equal(model(x, t, known + 5, mask, guess=guess), model(x, t, known, mask, guess=guess))
    other = torch.where(mask.bool(), known, known + 5)  # what the mask hides is not read
    assert torch.equal(model(x, t, other, mask), something)
    with pytest.raises(ShapeError):
        model(x, t, known)
    with pytest.raises(ShapeError):
        Denoiser(6, size=16, layers=1, heads=2, hidden=16)(x, t, known, mask)


def test_normalised_before_attention_tokens_pass_unchanged_where_nothing_is_added(generator):
    """The residual way is free: with silent attention and feed-forward only the last norm stands before the output."""
    model = Denoiser(4, size=16, layers=2, heads=2, hidden=16, dropout=0.0, before=True).eval()
    with torch.no_grad():
        for layer in model.seqTransEncoder.layers:
            for part in (layer.self_attn.out_proj, layer.linear2):
                part.weight.zero_(), part.bias.zero_()
        x, stamps = torch.randn(2, 5, 4, generator=generator), torch.tensor([3, 9])
        tokens = model.input_process.poseEmbedding(x) + model.sequence_pos_encoder.pe[1:6, 0]
        expected = model.output_process.poseFinal(torch.nn.functional.layer_norm(tokens, (16,)))
        assert torch.allclose(model(x, stamps), expected, atol=1e-5)
    behind = Denoiser(4, size=16, layers=2, heads=2, hidden=16)
    assert set(model.state_dict()) - set(behind.state_dict()) == {
        f"seqTransEncoder.norm.{k}" for k in ("weight", "bias")
    }
