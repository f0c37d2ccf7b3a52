"""Checks of the network: MDM's tensors by name and shape, and a twin written with plain matrices.

Source: MDM (Tevet et al. 2022), official code, unconstrained model of 25 x 6 numbers a frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from motionlab.diffusion.denoiser import Denoiser

PARAMETERS = 17_501_846  # of the official unconstrained model


def official(features: int = 150, size: int = 512, layers: int = 8, hidden: int = 1024) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the official model's tensors, without its tables of sines, which are not loaded."""
    shapes = {
        "input_process.poseEmbedding": (size, features),
        "embed_timestep.time_embed.0": (size, size),
        "embed_timestep.time_embed.2": (size, size),
        "output_process.poseFinal": (features, size),
    }
    found = {f"{name}.{part}": s[:n] for name, s in shapes.items() for part, n in (("weight", 2), ("bias", 1))}
    for k in range(layers):
        at = f"seqTransEncoder.layers.{k}."
        found |= {f"{at}self_attn.in_proj_weight": (3 * size, size), f"{at}self_attn.in_proj_bias": (3 * size,)}
        for name, shape in (
            ("self_attn.out_proj", (size, size)), ("linear1", (hidden, size)), ("linear2", (size, hidden)),
            ("norm1", (size,)), ("norm2", (size,)),
        ):  # fmt: skip
            found |= {f"{at}{name}.weight": shape, f"{at}{name}.bias": shape[:1]}
    return found


def differing(tensors: Mapping[str, Tensor], expected: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Names that only one side has, or whose shapes differ."""
    ours = {name: tuple(x.shape) for name, x in tensors.items()}
    return sorted(name for name in ours.keys() | expected.keys() if ours.get(name) != expected.get(name))


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


def seeded(features: int, seed: int, **size: int) -> Denoiser:
    """A network with random weights, frozen; torch's global generator is as before behind."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Denoiser(features, **size).eval().requires_grad_(False)
