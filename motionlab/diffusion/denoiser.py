"""The network that estimates x_0 from x_t: a transformer encoder over frames, with the noising step as an extra token.

Source: thesis 4.1.2, Fig. 4.2; MDM (Tevet et al. 2022), official code, unconstrained model: the
same weights, by name and shape.
Differs, where asked: several frames in one token, which halves the work.
"""

import math

import torch
from torch import Tensor, nn

from motionlab.errors import ShapeError, check_shape

_LONGEST = 5000  # frames and steps that the table of sines holds


def _sines(count: int, size: int) -> Tensor:
    """(count, size): sin and cos of position times 10000^(-2i / size), interleaved (Vaswani et al. 2017)."""
    position = torch.arange(count, dtype=torch.float32)[:, None]
    rate = torch.exp(torch.arange(0, size, 2, dtype=torch.float32) * (-math.log(10000.0) / size))
    table = torch.zeros(count, size)
    table[:, 0::2], table[:, 1::2] = torch.sin(position * rate), torch.cos(position * rate)
    return table


class Denoiser(nn.Module):
    """features: numbers per frame. size: of a token. patch: frames in a token.

    "small", "compact" and "thesis" sizes: ``SIZES``.
    """

    def __init__(
        self, features: int, *, size: int = 512, layers: int = 8, heads: int = 4, hidden: int = 1024,
        dropout: float = 0.1, patch: int = 1,
    ) -> None:  # fmt: skip
        super().__init__()
        self.features, self.patch = features, patch
        self.input_process = nn.ModuleDict({"poseEmbedding": nn.Linear(features * patch, size)})
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("sines", _sines(_LONGEST, size)[:, None], persistent=False)
        layer = nn.TransformerEncoderLayer(size, heads, hidden, dropout, "gelu")
        self.seqTransEncoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        embed = nn.Sequential(nn.Linear(size, size), nn.SiLU(), nn.Linear(size, size))
        self.embed_timestep = nn.ModuleDict({"time_embed": embed})
        self.output_process = nn.ModuleDict({"poseFinal": nn.Linear(size, features * patch)})

    def forward(self, x: Tensor, stamps: Tensor) -> Tensor:
        """Computes an estimate (B, T, D) of x_0 from x_t (B, T, D) and steps (B,).

        Raises:
            ShapeError: another number of features, or frames that do not fill tokens.
        """
        frames = check_shape(x, f"B T {self.features}", "x")["T"]
        if frames % self.patch:
            raise ShapeError(f"{frames} frames do not divide into tokens of {self.patch}")
        tokens = self.input_process["poseEmbedding"](x.unflatten(1, (-1, self.patch)).flatten(2))
        step = self.embed_timestep["time_embed"](self.sines[stamps])  # a token of its own, the first
        tokens = torch.cat((step.transpose(0, 1), tokens.transpose(0, 1)))
        seen = self.seqTransEncoder(self.dropout(tokens + self.sines[: len(tokens)]))
        said = self.output_process["poseFinal"](seen[1:])
        return said.transpose(0, 1).unflatten(2, (self.patch, -1)).flatten(1, 2)


#: "thesis": MDM's size, which the thesis follows closely. "compact": trains on two cores. "small": for ablations.
SIZES = {
    "thesis": {"size": 512, "layers": 8, "heads": 4, "hidden": 1024},
    "compact": {"size": 256, "layers": 4, "heads": 4, "hidden": 512},
    "small": {"size": 128, "layers": 3, "heads": 4, "hidden": 256},
}
