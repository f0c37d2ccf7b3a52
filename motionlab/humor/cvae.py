"""The conditional VAE over transitions: posterior, conditional prior and decoder, with the official names and shapes.

Source: HuMoR (Rempe et al. 2021), section 3 and its official code; thesis 3.1.1.
Differs: a model may have a linear layer past the decoder, ``skip``, which begins as "everything goes on at its
velocity" (and then knows velocities of the past, ``Cvae.causal``), and one past the encoder, ``direct``.
"""

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from motionlab.errors import DataError, ShapeError
from motionlab.humor.state import DELTA, OFFICIAL_DELTA_ORDER, OFFICIAL_ORDER, STATE

LATENT = 48


class Gaussian(NamedTuple):
    """A diagonal Gaussian over latents: mean and log_var, each (..., 48)."""

    mean: Tensor
    log_var: Tensor

    def sample(self, generator: torch.Generator) -> Tensor:
        """Draws one sample (..., 48)."""
        noise = torch.randn(self.mean.shape, generator=generator, dtype=self.mean.dtype, device=self.mean.device)
        return self.mean + noise * (0.5 * self.log_var).exp()

    def nll(self, z: Tensor) -> Tensor:
        """Computes -log N(z) (...), nats."""
        squared = (z - self.mean).square() * (-self.log_var).exp()
        return 0.5 * (squared + self.log_var + math.log(2 * math.pi)).sum(-1)


def kl(q: Gaussian, p: Gaussian) -> Tensor:
    """Computes KL(q || p) per latent dimension (..., 48), nats."""
    ratio = (q.log_var - p.log_var).exp() + (q.mean - p.mean).square() * (-p.log_var).exp()
    return 0.5 * (ratio - 1 + p.log_var - q.log_var)


class RowNorm(nn.GroupNorm):
    """GroupNorm of rows (..., C): the same numbers by layer norms of the groups, on a CPU twice as fast."""

    def forward(self, x: Tensor) -> Tensor:
        """Computes normed rows (..., C) from rows (..., C)."""
        groups = x.unflatten(-1, (self.num_groups, -1))
        normed = nn.functional.layer_norm(groups, groups.shape[-1:], eps=self.eps).flatten(-2)
        return torch.addcmul(self.bias, normed, self.weight)


class Mlp(nn.Module):
    """Linear -> GroupNorm(16) -> ReLU, and a last Linear; the last ``again`` inputs go to every later Linear too."""

    def __init__(self, inputs: int, widths: tuple[int, ...], outputs: int, again: int = 0) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in widths:
            layers += [nn.Linear(inputs, width), RowNorm(16, width), nn.ReLU()]
            inputs = width + again
        self.net = nn.Sequential(*layers, nn.Linear(inputs, outputs))
        self.again = again

    def forward(self, x: Tensor) -> Tensor:
        """Computes outputs (N, outputs) from inputs (N, inputs)."""
        skip, first = x[..., x.shape[-1] - self.again :], self.net[0]
        x = first(x)
        for layer in self.net[1:]:
            if self.again and isinstance(layer, nn.Linear):
                x = torch.cat((x, skip), dim=-1)
            x = layer(x)
        return x


class Cvae(nn.Module):
    """The three networks. States are in the canonical frame of the past one.

    width: of the hidden layers, 1024 in the official model (9,725,976 parameters); a multiple of 32, as the decoder's
    last norm is half as wide and has 16 groups; 64 is the least that can learn.
    There is no normalisation of inputs or outputs: what training uses is folded into the weights.
    skip: with a linear layer from the past state to the raw changes, beside the decoder. direct: with one from both
    states to the mean of z, beside the encoder. Neither is in the official model.

    Raises:
        ShapeError: the width is no multiple of 32.
    """

    latent = LATENT

    def __init__(self, width: int = 1024, *, skip: bool = False, direct: bool = False) -> None:
        super().__init__()
        if width < 32 or width % 32:
            raise ShapeError(f"width: expected a multiple of 32, got {width}")
        self.width = width
        self.encoder = Mlp(2 * STATE, (width,) * 4, 2 * LATENT)
        self.prior_net = Mlp(STATE, (width,) * 4, 2 * LATENT)
        self.decoder = Mlp(STATE + LATENT, (width, width, width // 2), DELTA, again=LATENT)
        self.skip = nn.Linear(STATE, DELTA, bias=False) if skip else None
        self.direct = nn.Linear(2 * STATE, LATENT) if direct else None

    @property
    def causal(self) -> bool:
        """Whether velocities of its states are backward differences, or central ones, which know the next frame."""
        return self.skip is not None

    def posterior(self, past: Tensor, now: Tensor) -> Gaussian:
        """Computes q(z | past, now) from states (..., 339), both in the frame of the past one."""
        both = torch.cat((past, now), dim=-1)
        mean, log_var = _rows(self.encoder, both).chunk(2, dim=-1)
        return Gaussian(mean if self.direct is None else mean + self.direct(both), log_var)

    def prior(self, past: Tensor) -> Gaussian:
        """Computes p(z | past) from states (..., 339) in their own heading frame."""
        return Gaussian(*_rows(self.prior_net, past).chunk(2, dim=-1))

    def decode(self, past: Tensor, z: Tensor) -> Tensor:
        """Computes raw changes and contact logits (..., 216) of the next state; ``state.apply`` adds them."""
        raw = _rows(self.decoder, torch.cat((past, z), dim=-1))
        return raw if self.skip is None else raw + self.skip(past)

    def frozen(self) -> Self:
        """Returns itself, in evaluation mode, its weights without gradients: what a fit wants."""
        return self.eval().requires_grad_(requires_grad=False)


def _rows(net: nn.Module, x: Tensor) -> Tensor:
    return net(x.reshape(-1, x.shape[-1])).unflatten(0, x.shape[:-1])


@torch.no_grad()
def reorder(model: Cvae, *, back: bool = False) -> Cvae:
    """Changes in place a model with official weights into one that takes and gives our order of numbers, or back."""
    order, delta = (each.argsort() if back else each for each in (OFFICIAL_ORDER, OFFICIAL_DELTA_ORDER))
    direct = () if model.direct is None else ((model.direct, 2),)
    first = ((model.encoder.net[0], 2), (model.prior_net.net[0], 1), (model.decoder.net[0], 1), *direct)
    for layer, states in first:
        weight, size = layer.weight, states * STATE
        weight[:, :size] = weight[:, :size].unflatten(1, (states, STATE))[..., order.to(weight.device)].flatten(1)
    last = model.decoder.net[-1]
    last.weight.copy_(last.weight[delta]), last.bias.copy_(last.bias[delta])
    if model.skip is not None:
        model.skip.weight.copy_(model.skip.weight[delta][:, order])
    return model


def official_weights(model: Cvae) -> dict[str, Tensor]:
    """Returns a model's weights as the official code has them: what a checkpoint holds, and ``from_weights`` reads."""
    return reorder(copy.deepcopy(model), back=True).state_dict()


def from_weights(weights: dict[str, Tensor], path: Path, remedy: str) -> Cvae:
    """Builds a frozen model from a state dict with the official names; ``path`` and ``remedy`` are for the errors.

    Raises:
        DataError: names or shapes are others, or a number is not finite.
    """
    first = weights.get("prior_net.net.0.weight")
    if first is None or first.ndim != 2 or first.shape[1] != STATE or first.shape[0] % 32:
        raise DataError("no prior_net.net.0.weight of shape (width, 339)", path=path, remedy=remedy)
    model = Cvae(len(first), skip="skip.weight" in weights, direct="direct.weight" in weights)
    return reorder(filled(model, weights, "tensors do not fit HuMoR's networks", path, remedy))


def filled(model: nn.Module, weights: Mapping[str, Tensor], unfit: str, path: Path, remedy: str) -> nn.Module:
    """Returns a model, frozen, with the weights of a state dict, whose norms need not have counted their batches.

    Raises:
        DataError: names or shapes are others (``unfit``), or a number is not finite.
    """
    counts = {name: value for name, value in model.state_dict().items() if name.endswith("num_batches_tracked")}
    try:
        model.load_state_dict(counts | {name: value.float() for name, value in weights.items()})
    except RuntimeError as error:
        raise DataError(f"{unfit}: {str(error).splitlines()[-1].strip()}", path=path, remedy=remedy) from error
    finite(weights, path, remedy)
    return model.frozen()


def finite(tensors: Mapping[str, Tensor], path: Path, remedy: str) -> None:
    """Raises DataError where a tensor holds a number that is not finite."""
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise DataError("numbers that are not finite", path=path, place=name, remedy=remedy)
