"""Estimates x_0 as if data were Gaussian, with a network that corrects the estimate: for windows and for single poses.

Windows (``Spectral``):
In the cosine basis over time, X = C x, every number of a motion has its own power S (T, D). Were motions Gaussian with
that power, the best guess of x_0 from x_t = sqrt(a) x_0 + sqrt(1 - a) noise would be the Wiener filter
sqrt(a) S / (a S + 1 - a) X_t, wrong by the deviation sqrt(S (1 - a) / (a S + 1 - a)). The network gives what is
missing, in units of that deviation: quick changes, of which motion has little, stay small whatever it says. Its input
is the guess, brought to unit size, in place of x_t: there is less noise in it.

A model that takes known numbers corrects the guess made from them (``start.InitialGuess``) instead of the mean, and
more freely far from them: the same filter and deviation, with a power that ``start.doubt`` makes smaller. Its input is
that guess besides the input of a model without known numbers, from whose weights it can start; or, where smooth curves
are its guess, besides the filter's estimate unscaled, so that from pure noise it sees no noise.

Source: Karras et al. 2022 (EDM), preconditioning, whose data is white, S = 1; the filter: Wiener 1949.
Differs from the thesis and MDM, whose network gives x_0 itself.

Single poses (``Linear``):
Poses x (D) have covariance U diag(L) U^T and joints p = A U^T x + rest, the rest with covariance R: what of a joint's
place is not linear in the pose. Were they Gaussian: given x_t = sqrt(a) x_0 + sqrt(1 - a) noise, U^T x_0 has mean
m = sqrt(a) L / s U^T x_t and variance v = (1 - a) L / s, s = a L + 1 - a (Wiener, as above); handles at y move
it by the gain v A^T (A v A^T + R + r)^-1 (y - p): ridge regression of the pose on its handles where there is only
noise. A few steps of steepest descent in |U^T (x - m)|^2 / v + |y - p(x)|^2 / r, by the exact kinematics, follow, which
move most what is least certain. The network gives what is missing, in units of sqrt(v), and a few more steps bring the
handles back.

Poses are not Gaussian, and with ``recalls`` they are a mixture: each training pose z_i with a Gaussian of ``_NEAR`` the
covariance about it. The z_i are averaged by how near x_t and the handles are to sqrt(a) z_i and its joints p_i,
|y - p_i|^2 / (2 h^2), and the rest is as above around that mean. h grows with the distance of the nearest pose, so that
handles far from every pose average over many.

Source: the Gaussian's conditional mean; Parzen 1962; Karras et al. 2022 (preconditioning); thesis 4.2.4 has the network
alone.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from motionlab.baselines import cosine_transform
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.start import InitialGuess, doubt, smooth_curves
from motionlab.errors import ShapeError

_LEAST = 1e-6  # of a power or a variance; less is a number that never changes
_CLOSE = 1e-2**2 / 4  # r, square metres: how near a handle has to come
_ROUNDS = 8  # steps of descent
_BEFORE = 2  # of them before the network; the rest is behind it, and left out while it is trained
_THIN = 2  # every so many-th pose is recalled while it is trained
_NEAR = 0.2  # of the covariance: that about a pose that is recalled
_FIRM, _LOOSE = 1e-2**2, 2.0  # h^2 = FIRM + LOOSE times the least mean square over handles' coordinates, square metres


def power(x0: Tensor, seen: Tensor | None = None) -> Tensor:
    """Computes the mean power S (T, D) of normalised motions (B, T, D) in the cosine basis.

    seen (B, D): 0 where a motion's numbers were not recorded and do not count; None: all count."""
    each = (cosine_transform(x0.shape[-2]).to(x0) @ x0).square()
    if seen is None:
        return each.mean(0).clamp(min=_LEAST)
    seen = seen.to(each)[:, None]
    return ((each * seen).sum(0) / seen.sum(0).clamp(min=1.0)).clamp(min=_LEAST)


class Spectral(nn.Module):
    """A denoiser: the Wiener estimate from the data's spectrum, plus a network's correction.

    network: (x_t, stamps, ...) -> (B, T, D). alpha_bar: of all noising steps. frames, features, recalls: as of
    ``start.InitialGuess``. guessed: a network that is told what is known corrects that guess of the rest; False: it
    corrects smooth curves through what is known, and the mean where a number is known at no time. ``spectrum`` (T, D)
    is data, measured by ``power`` and stored with the weights.
    """

    def __init__(
        self,
        network: nn.Module,
        alpha_bar: Tensor,
        frames: int,
        features: int,
        recalls: int = 0,
        *,
        guessed: bool = True,
    ) -> None:
        super().__init__()
        self.network, self.told = network, network.told
        self.register_buffer("spectrum", torch.ones(frames, features))
        self.start = InitialGuess(frames, features, recalls) if self.told and guessed else None
        self.register_buffer("alpha_bar", alpha_bar.float(), persistent=False)
        self.register_buffer("cosines", cosine_transform(frames), persistent=False)

    def forward(
        self,
        x: Tensor,
        stamps: Tensor,
        known: Tensor | None = None,
        mask: Tensor | None = None,
        own: Tensor | None = None,
        both: bool = False,
        **told: Tensor | None,
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Computes an estimate (B, T, D) of x_0; arguments as for the network. Where mask is set it equals ``known``.

        own (B,): in training, the motions that the windows were cut from, not to be recalled. both: returns the guess
        that the network corrects, too.
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
            start = smooth_curves(known, given) if self.start is None else self.start(known, given, own)
            open_ = self._open(doubt(given), a)
            guess = start + open_**2 * wiener(x - a.sqrt() * start)
            told["guess"], shown = start, guess if self.start is None else shown
        said = self.network(shown, stamps, known, mask, **told)
        made = guess + open_ * (self.cosines.T @ ((s * (1 - a) / total).sqrt() * (self.cosines @ said)))
        return (made, guess) if both else made

    def recall(self, x: Tensor, clips: Tensor) -> None:
        """Measures the initial guess on windows: see ``start.InitialGuess.measure``."""
        self.start.measure(x, clips, torch.Generator().manual_seed(0))

    def _open(self, doubt: Tensor, a: Tensor) -> Tensor:
        """(B, T, D), of the deviation that x_t leaves open, what is still open where that of x_0 is only ``doubt`` of
        what it is where nothing is known; were the spectrum flat. ``doubt`` itself at pure noise, 1 without noise."""
        s = self.spectrum.mean(0)
        return doubt * ((a * s + 1 - a) / (a * doubt**2 * s + 1 - a)).sqrt()


class Linear(nn.Module):
    """A denoiser of single poses: the estimate as if poses were Gaussian, plus a network's correction.

    network: (x, stamps, ...) -> (B, 1, D); it sees the estimate, not x_t. alpha_bar: of all noising steps.
    The buffers are data: U (D, D), L (D,), A (66, D), R (66, 66), the mean of the joints (66,) in metres, and the
    normaliser's mean and scale (D,); of poses recalled the coordinates U^T z_i (N, D), joints (N, 66) and motions (N,).
    ``measure`` and ``recall`` fill them in.
    """

    def __init__(self, network: nn.Module, alpha_bar: Tensor, layout: Layout, recalls: int = 0) -> None:
        super().__init__()
        self.network, self.told, self.layout, self.recalls = network, network.told, layout, recalls
        size, places = layout.size, 3 * len(layout.skeleton)
        shapes = {"basis": (size, size), "power": (size,), "slope": (places, size), "rest": (places, places)}
        shapes |= {"middle": (places,), "mean": (size,), "scale": (size,)}
        for name, shape in shapes.items():
            self.register_buffer(name, torch.ones(shape))
        if recalls:
            self.register_buffer("codes", torch.zeros(recalls, size, dtype=torch.half))
            self.register_buffer("joints", torch.zeros(recalls, places, dtype=torch.half))
            self.register_buffer("clips", torch.full((recalls,), -1.0))
        self.register_buffer("alpha_bar", alpha_bar.float(), persistent=False)

    @torch.no_grad()
    def measure(self, x: Tensor, normaliser: Normaliser) -> None:
        """Measures the buffers on normalised poses (N, 1, D)."""
        self.mean.copy_(normaliser.mean)
        self.scale.copy_(normaliser.scale)
        self.basis.copy_(torch.eye(len(self.basis)))
        x, joints = x[:, 0].double(), self._joints(x[:, 0]).double()
        centred = joints - joints.mean(0)
        power, basis = torch.linalg.eigh(x.mT @ x / len(x))
        coordinates = x @ basis
        slope = (centred.mT @ coordinates / len(x)) / power.clamp(min=_LEAST)
        rest = centred - coordinates @ slope.mT
        found = (basis, power.clamp(min=_LEAST), slope, rest.mT @ rest / len(x), joints.mean(0))
        for buffer, value in zip((self.basis, self.power, self.slope, self.rest, self.middle), found, strict=True):
            buffer.copy_(value)

    @torch.no_grad()
    def recall(self, x: Tensor, clips: Tensor) -> None:
        """Stores the first ``recalls`` of normalised poses (N, 1, D), and their motions (N,), after ``measure``."""
        if len(x) < self.recalls:
            raise ShapeError(f"x: expected {self.recalls} poses or more, got {len(x)}")
        codes = x[: self.recalls, 0] @ self.basis
        self.codes.copy_(codes)
        self.joints.copy_(self._joints(codes))
        self.clips.copy_(clips[: self.recalls])

    def forward(
        self,
        x: Tensor,
        stamps: Tensor,
        handles: Tensor | None = None,
        own: Tensor | None = None,
        rounds: int | None = None,
    ) -> Tensor:
        """Computes an estimate (B, 1, D) of x_0 from x_t (B, 1, D), steps (B,) and handles (B, 1, 22, 4), as for the
        network. own (B,): motions that must not be recalled, in training those that the poses were cut from. rounds:
        steps of descent, ``_ROUNDS`` unless said."""
        rounds = _ROUNDS if rounds is None else rounds
        if x.ndim != 3 or x.shape[1] != 1:
            raise ShapeError(f"x: expected single poses (B, 1, {self.layout.size}), got {tuple(x.shape)}")
        a = self.alpha_bar[stamps][:, None].to(x)
        power, recalled, at = self.power, 0.0, x[:, 0] @ self.basis
        if self.recalls:
            power = _NEAR * power
            recalled = self._recalled(at, a, power, handles, own)
        s = a * power + 1 - a
        mean, variance = (a.sqrt() * power * at + (1 - a) * recalled) / s, (1 - a) * power / s
        told, held = {}, None if handles is None else _held(handles[:, 0])
        if handles is not None:
            told = {"handles": handles}
        if held is not None:
            mean = self._down(self._moved(mean, variance, *held), mean, variance, held, min(_BEFORE, rounds))
        said = self.network((mean @ self.basis.mT)[:, None], stamps, **told)[:, 0]
        made = mean + variance.sqrt() * said
        if held is not None and not self.training:
            made = self._down(made, made, variance, held, rounds - _BEFORE)
        return (made @ self.basis.mT)[:, None]

    def _recalled(self, at: Tensor, a: Tensor, power: Tensor, handles: Tensor | None, own: Tensor | None) -> Tensor:
        """Coordinates (B, D), the mean of the z_i by what x_t, of coordinates ``at`` (B, D), and the handles say."""
        every = slice(None, None, _THIN if self.training else 1)
        codes, joints, clips = self.codes[every].to(at), self.joints[every].to(at), self.clips[every]
        sharp = 1 / (a * power + 1 - a)
        odds = (a.sqrt() * at * sharp) @ codes.mT - (a * sharp) @ codes.square().mT / 2
        if own is not None:
            odds = odds.masked_fill(clips == own[:, None], -torch.inf)
        if handles is not None:
            seen = handles[:, 0, :, 3].repeat_interleave(3, -1)
            goal = seen * handles[:, 0, :, :3].flatten(1)
            far = (goal.square().sum(-1, keepdim=True) - 2 * goal @ joints.mT + seen @ joints.square().mT).clamp(min=0)
            others = far if own is None else far.masked_fill(clips == own[:, None], torch.inf)
            near = others.amin(-1, keepdim=True).clamp(max=1.0) / seen.sum(-1, keepdim=True).clamp(min=1)
            odds = odds - far / (2 * (_FIRM + _LOOSE * near))
        return odds.softmax(-1).nan_to_num(0.0) @ codes

    def _joints(self, coordinates: Tensor) -> Tensor:
        """Places (B, 66), metres, of the joints of poses by their coordinates U^T x (B, D), on the layout's body."""
        x = coordinates @ self.basis.mT
        return self.layout.decode(x[:, None] * self.scale + self.mean, 1.0).positions.reshape(len(x), -1)

    def _moved(self, mean: Tensor, variance: Tensor, targets: Tensor, seen: Tensor, places: Tensor) -> Tensor:
        """Coordinates (B, D) that know of handles (``_held``), were joints linear in them."""
        slope, rest = self.slope[places], self.rest[places[:, :, None], places[:, None]]
        eye = torch.eye(places.shape[1]).to(rest)
        spread = (slope * variance[:, None]) @ slope.mT + rest + _CLOSE * eye
        square = seen[:, :, None] * spread * seen[:, None] + torch.diag_embed(1 - seen)
        off = seen * (targets - self.middle[places] - (slope @ mean[..., None])[..., 0])
        weight = torch.cholesky_solve(off[..., None], torch.linalg.cholesky(square))
        return mean + variance * (slope.mT @ weight)[..., 0]

    def _down(
        self, start: Tensor, mean: Tensor, variance: Tensor, held: tuple[Tensor, Tensor, Tensor], rounds: int
    ) -> Tensor:
        """Coordinates (B, D) after so many steps from ``start``, the mean still being the mean."""
        step = torch.zeros_like(start)
        for _ in range(rounds):
            at = (start + step).detach()
            step = step + self._descended(at, at - mean.detach(), variance, *held)
        return start + step

    def _descended(
        self, at: Tensor, gone: Tensor, variance: Tensor, targets: Tensor, seen: Tensor, places: Tensor
    ) -> Tensor:
        """A step (B, D) from coordinates ``at``, ``gone`` from the mean: down the slope in units of the variance, as
        far as is best were the kinematics linear."""
        with torch.enable_grad():
            here = at.clone().requires_grad_()
            joints = self._joints(here).gather(1, places)
            (pull,) = torch.autograd.grad((seen * (targets - joints)).square().sum() / (2 * _CLOSE), here)
        with torch.no_grad():
            down = -(variance * pull + gone)
            small = 1e-2 / down.abs().amax(-1, keepdim=True).clamp(min=1e-6)
            change = seen * (self._joints(at + small * down).gather(1, places) - joints) / small
            square = (down.square() / variance).sum(-1)
            return down * (square / (square + change.square().sum(-1) / _CLOSE).clamp(min=1e-9))[:, None]


def _held(handles: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
    """Of handles (B, 22, 4), of which no pose has more than K: targets (B, 3 K) and which of them count, 0 or 1, and
    their places among the 66. None where there are none."""
    count = int((handles[..., 3] > 0).sum(1).max())
    if count == 0:
        return None
    order = handles[..., 3].argsort(1, descending=True)[:, :count]  # (B, K): handles first
    held = handles.gather(1, order[..., None].expand(-1, -1, 4))
    places = (3 * order[..., None] + torch.arange(3, device=order.device)).flatten(1)
    return held[..., :3].flatten(1), held[..., 3].repeat_interleave(3, -1), places
