"""What the data's spectrum alone says about x_0, and a network that only corrects it.

In the cosine basis over time, X = C x, every number of a motion has its own power S (T, D). Were motions Gaussian with
that power, the best guess of x_0 from x_t = sqrt(a) x_0 + sqrt(1 - a) noise would be the Wiener filter
sqrt(a) S / (a S + 1 - a) X_t, wrong by the deviation sqrt(S (1 - a) / (a S + 1 - a)). The network gives what is
missing, in units of that deviation: quick changes, of which motion has little, stay small whatever it says. And it is
shown the guess, brought to unit size, in place of x_t: there is less noise in it.

A model that is told what is known corrects what that says (``start.InitialGuess``) instead of the mean, and the more
freely the farther what is known: the same filter and deviation, with a power that ``start.doubt`` makes smaller. It
sees the start besides, and what a model that is told nothing sees: it can go on from the weights of one.

Source: Karras et al. 2022 (EDM), preconditioning, whose data is white, S = 1; the filter: Wiener 1949.
Differs from the thesis and MDM, whose network gives x_0 itself.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from motionlab.baselines import cosine_transform
from motionlab.diffusion.start import InitialGuess, doubt

_LEAST = 1e-6  # of a power; a number that never changes has none


def power(x0: Tensor) -> Tensor:
    """Mean power S (T, D) of normalised motions (B, T, D) in the cosine basis."""
    return (cosine_transform(x0.shape[-2]).to(x0) @ x0).square().mean(0).clamp(min=_LEAST)


class Spectral(nn.Module):
    """network: (x_t, stamps, ...) -> (B, T, D). alpha_bar: of all noising steps. frames, features, recalls: as of
    ``start.InitialGuess``.

    ``spectrum`` (T, D) is data, measured by ``power`` and stored with the weights.
    """

    def __init__(self, network: nn.Module, alpha_bar: Tensor, frames: int, features: int, recalls: int = 0) -> None:
        super().__init__()
        self.network, self.told = network, network.told
        self.register_buffer("spectrum", torch.ones(frames, features))
        self.start = InitialGuess(frames, features, recalls) if self.told else None
        self.register_buffer("alpha_bar", alpha_bar.float(), persistent=False)
        self.register_buffer("cosines", cosine_transform(frames), persistent=False)

    def forward(
        self,
        x: Tensor,
        stamps: Tensor,
        known: Tensor | None = None,
        mask: Tensor | None = None,
        own: Tensor | None = None,
        **told: Tensor | None,
    ) -> Tensor:
        """Estimate (B, T, D) of x_0; arguments as for the network. Where mask says so it is ``known``, exactly.

        own (B,): in training, the motions that the windows were cut from, not to be recalled.
        """
        a, s = self.alpha_bar[stamps][:, None, None].to(x), self.spectrum.to(x)
        total = a * s + 1 - a

        def wiener(x: Tensor) -> Tensor:
            return self.cosines.T @ (a.sqrt() * s / total * (self.cosines @ x))

        guess, open_ = wiener(x), 1.0
        shown = guess / (a * s.square() / total).mean((1, 2), keepdim=True).sqrt()
        if self.told:
            if mask is None:
                known, mask = torch.zeros_like(x), torch.zeros_like(x)
            given = mask.expand_as(x) > 0
            start, open_ = self.start(known, given, own), self._open(doubt(given), a)
            guess = start + open_**2 * wiener(x - a.sqrt() * start)
            told["guess"] = start
        said = self.network(shown, stamps, known, mask, **told)
        return guess + open_ * (self.cosines.T @ ((s * (1 - a) / total).sqrt() * (self.cosines @ said)))

    def recall(self, x: Tensor, clips: Tensor) -> None:
        """See ``start.InitialGuess.measure``."""
        self.start.measure(x, clips, torch.Generator().manual_seed(0))

    def _open(self, doubt: Tensor, a: Tensor) -> Tensor:
        """(B, T, D), of the deviation that x_t leaves open, what is still open where that of x_0 is only ``doubt`` of
        what it is where nothing is known; were the spectrum flat. ``doubt`` itself at pure noise, 1 without noise."""
        s = self.spectrum.mean(0)
        return doubt * ((a * s + 1 - a) / (a * doubt**2 * s + 1 - a)).sqrt()
