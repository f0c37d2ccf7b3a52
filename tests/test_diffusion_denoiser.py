"""MDM's network: its names, its size, and a twin written with plain matrices."""

import math

import pytest
import torch
from torch import Tensor

from motionlab.diffusion.model import SIZES, Denoiser

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


def twin(model: Denoiser, x: Tensor, step: int) -> Tensor:
    """What a network that is told nothing says of one window x (T, D) at a step, with no layer of torch: matrices,
    softmax and erf, float64, one token per frame."""
    w = {name: value.double() for name, value in model.state_dict().items()}
    heads = model.seqTransEncoder.layers[0].self_attn.num_heads
    size = w["input_process.poseEmbedding.weight"].shape[0]
    rate = [10000 ** (-2 * (i // 2) / size) for i in range(size)]

    def sines(k: int) -> Tensor:
        return x.new_tensor([math.cos(k * r) if i % 2 else math.sin(k * r) for i, r in enumerate(rate)]).double()

    def linear(v: Tensor, name: str) -> Tensor:
        return v @ w[f"{name}.weight"].T + w[f"{name}.bias"]

    def norm(v: Tensor, name: str) -> Tensor:
        v = (v - v.mean(-1, keepdim=True)) / (v.var(-1, unbiased=False, keepdim=True) + 1e-5).sqrt()
        return v * w[f"{name}.weight"] + w[f"{name}.bias"]

    token = linear(sines(step), "embed_timestep.time_embed.0")
    token = linear(token * token.sigmoid(), "embed_timestep.time_embed.2")
    tokens = torch.cat((token[None], linear(x.double(), "input_process.poseEmbedding")))
    tokens = tokens + torch.stack([sines(k) for k in range(len(tokens))])
    for k in range(len(model.seqTransEncoder.layers)):
        at = f"seqTransEncoder.layers.{k}."
        qkv = tokens @ w[at + "self_attn.in_proj_weight"].T + w[at + "self_attn.in_proj_bias"]
        q, key, v = (part.reshape(len(tokens), heads, -1).transpose(0, 1) for part in qkv.chunk(3, -1))
        seen = ((q @ key.mT / math.sqrt(size / heads)).softmax(-1) @ v).transpose(0, 1).reshape(len(tokens), -1)
        tokens = norm(tokens + linear(seen, at + "self_attn.out_proj"), at + "norm1")
        inner = linear(tokens, at + "linear1")
        inner = inner * 0.5 * (1 + torch.erf(inner / math.sqrt(2)))
        tokens = norm(tokens + linear(inner, at + "linear2"), at + "norm2")
    return linear(tokens[1:], "output_process.poseFinal")


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


def test_tokens_of_several_frames_halve_the_sequence_and_keep_the_order(generator):
    model = Denoiser(4, size=16, layers=1, heads=2, hidden=16, dropout=0.0, patch=3).eval()
    lengths = []
    model.seqTransEncoder.register_forward_hook(lambda module, tokens, _: lengths.append(len(tokens[0])))
    x = torch.randn(2, 12, 4, generator=generator)
    with torch.no_grad():
        out = model(x, torch.tensor([3, 7]))
        model.output_process.poseFinal.weight.zero_()
        model.output_process.poseFinal.bias.copy_(torch.arange(12.0))
        order = model(x, torch.tensor([3, 7]))
    assert out.shape == x.shape and lengths[0] == 12 // 3 + 1
    assert torch.equal(order[0, :3], torch.arange(12.0).reshape(3, 4)) and torch.equal(order[0, 3:6], order[0, :3])
