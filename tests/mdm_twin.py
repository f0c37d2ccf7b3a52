"""A twin of MDM's network, written with plain matrices."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from motionlab.diffusion.model import Denoiser


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
