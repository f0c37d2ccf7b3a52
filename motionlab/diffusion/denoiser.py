"""The network that estimates x_0 from x_t: a transformer encoder over frames, with the noising step as an extra token.

Source: thesis 4.1.2, Fig. 4.2; MDM (Tevet et al. 2022), official code, unconstrained model: the
same weights, by name and shape.
Differs, where asked: the known part of the state, with straight lines through it or a guess, and its mask as further
inputs (CondMDI; thesis 4.4.1); how long until the next known frame, added to every token (Harvey et al. 2020); several
frames in one token, which halves the work; where chosen joints should be, through a linear layer, beside the input
(thesis 4.2.4, "handle conditioning").
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from motionlab.baselines import nearest_known
from motionlab.diffusion.start import lines_between
from motionlab.errors import ShapeError, check_shape
from motionlab.skeleton import STANDARD

_LONGEST = 5000  # frames and steps that the table of sines holds
_HANDLE = 4  # numbers of a joint: the place it should have, metres, and 1 where it is a handle


def _sines(count: int, size: int) -> Tensor:
    """(count, size): sin and cos of position times 10000^(-2i / size), interleaved (Vaswani et al. 2017)."""
    position = torch.arange(count, dtype=torch.float32)[:, None]
    rate = torch.exp(torch.arange(0, size, 2, dtype=torch.float32) * (-math.log(10000.0) / size))
    table = torch.zeros(count, size)
    table[:, 0::2], table[:, 1::2] = torch.sin(position * rate), torch.cos(position * rate)
    return table


class _Sines(nn.Module):
    """Adds the table to tokens (L, B, size), with dropout."""

    def __init__(self, size: int, dropout: float) -> None:
        super().__init__()
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("pe", _sines(_LONGEST, size)[:, None], persistent=False)

    def forward(self, tokens: Tensor) -> Tensor:
        return self.dropout(tokens + self.pe[: len(tokens)])


class _Step(nn.Module):
    """The step's token (1, B, size): its row of sines through two layers."""

    def __init__(self, size: int, table: _Sines) -> None:
        super().__init__()
        self.sequence_pos_encoder = table
        self.time_embed = nn.Sequential(nn.Linear(size, size), nn.SiLU(), nn.Linear(size, size))

    def forward(self, stamps: Tensor) -> Tensor:
        return self.time_embed(self.sequence_pos_encoder.pe[stamps]).transpose(0, 1)


class _In(nn.Module):
    def __init__(self, inputs: int, size: int) -> None:
        super().__init__()
        self.poseEmbedding = nn.Linear(inputs, size)


class _Out(nn.Module):
    def __init__(self, size: int, outputs: int) -> None:
        super().__init__()
        self.poseFinal = nn.Linear(size, outputs)


class Denoiser(nn.Module):
    """features: numbers per frame. size: of a token. told: with known values and their mask as inputs. arrival: told
    also how far the next known frame is. patch: frames in a token. handles: numbers per frame that the places of
    handles are embedded in; 0: it takes none. before: tokens are normalised before attention, not behind it as in
    MDM, and once more at the end: trains where little of what is asked can be learned (Xiong et al. 2020).

    "small", "compact" and "thesis" sizes: ``SIZES``.
    """

    def __init__(
        self,
        features: int,
        *,
        size: int = 512,
        layers: int = 8,
        heads: int = 4,
        hidden: int = 1024,
        dropout: float = 0.1,
        told: bool = False,
        arrival: bool = False,
        patch: int = 1,
        handles: int = 0,
        before: bool = False,
    ) -> None:
        super().__init__()
        if arrival and not told:
            raise ValueError("arrival: only a model that is told of known frames can count to them")
        self.features, self.told, self.arrival, self.patch = features, told, arrival, patch
        self.handles = nn.Linear(_HANDLE * len(STANDARD), handles) if handles else None
        self.input_process = _In((features * (3 if told else 1) + handles) * patch, size)
        self.sequence_pos_encoder = _Sines(size, dropout)
        layer = nn.TransformerEncoderLayer(size, heads, hidden, dropout, "gelu", norm_first=before)
        norm = nn.LayerNorm(size) if before else None
        self.seqTransEncoder = nn.TransformerEncoder(layer, layers, norm, enable_nested_tensor=False)
        self.embed_timestep = _Step(size, self.sequence_pos_encoder)
        self.output_process = _Out(size, features * patch)

    def forward(
        self,
        x: Tensor,
        stamps: Tensor,
        known: Tensor | None = None,
        mask: Tensor | None = None,
        handles: Tensor | None = None,
        guess: Tensor | None = None,
    ) -> Tensor:
        """Computes an estimate (B, T, D) of x_0 from x_t (B, T, D) and steps (B,).

        known (B, T, D), mask (B, T, D) or (T, D): what is known of x_0 and where (1); for a model that is told, which
        sees straight lines through it (``start.lines_between``), or guess (B, T, D), if there is one. handles (B, T,
        22, 4): see ``_HANDLE``; zeros, as in None, for joints that are free.

        Raises:
            ShapeError: another number of features, or known parts or handles for a model that is told of none.
        """
        frames = check_shape(x, f"B T {self.features}", "x")["T"]
        if frames % self.patch:
            raise ShapeError(f"{frames} frames do not divide into tokens of {self.patch}")
        if (known is not None) != (mask is not None) or (mask is not None and not self.told):
            raise ShapeError("known and mask belong together, and to a model that is told of them")
        if self.told:
            mask = torch.zeros_like(x) if mask is None else mask.to(x).expand_as(x)
            known = (
                guess if guess is not None else torch.zeros_like(x) if known is None else lines_between(known, mask > 0)
            )
            x = torch.cat((x, known, mask), -1)
        if handles is not None and self.handles is None:
            raise ShapeError("handles: this model hears of none")
        if self.handles is not None:
            held = x.new_zeros(*x.shape[:2], self.handles.in_features) if handles is None else handles.flatten(2)
            x = torch.cat((x, self.handles(held.to(x))), -1)
        tokens = self.input_process.poseEmbedding(x.unflatten(1, (-1, self.patch)).flatten(2))
        if self.arrival:
            tokens = tokens + self.sequence_pos_encoder.pe[_until_known(mask)[:, :: self.patch], 0]
        tokens = torch.cat((self.embed_timestep(stamps), tokens.transpose(0, 1)))
        said = self.output_process.poseFinal(self.seqTransEncoder(self.sequence_pos_encoder(tokens))[1:])
        return said.transpose(0, 1).unflatten(2, (self.patch, -1)).flatten(1, 2)


def _until_known(mask: Tensor) -> Tensor:
    """Frames (B, T) until the next frame that is known whole, 0 there, T where none comes; mask (B, T, D)."""
    frames = mask.shape[1]
    time, whole = torch.arange(frames, device=mask.device), (mask > 0).all(-1)
    following = nearest_known(whole)[1]
    return torch.where((following >= time) & whole.any(-1, keepdim=True), following - time, frames)


def widened(weights: Mapping[str, Tensor], features: int) -> dict[str, Tensor]:
    """Computes the weights of a denoiser that takes known values and their mask from those of one that does not; the
    new columns are zero.

    The columns of a token, for each of its frames: x_t (``features``), the known part, the mask.
    """
    found = dict(weights)
    for name, value in weights.items():
        if name.endswith("poseEmbedding.weight"):
            each = value.unflatten(1, (-1, features))
            found[name] = torch.cat((each, torch.zeros_like(each), torch.zeros_like(each)), -1).flatten(1)
    return found


#: "thesis": MDM's size, which the thesis follows closely. "compact": trains on two cores. "small": for ablations.
SIZES = {
    "thesis": {"size": 512, "layers": 8, "heads": 4, "hidden": 1024},
    "compact": {"size": 256, "layers": 4, "heads": 4, "hidden": 512},
    "small": {"size": 128, "layers": 3, "heads": 4, "hidden": 256},
}
