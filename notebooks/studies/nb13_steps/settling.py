"""How the predicted motion changes while it is denoised: when it is settled, at which frequencies and where.

Source: thesis 4.4.2: the prediction begins as "some mean motion" and "can change drastically, and can do so late".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.baselines import cosine_transform
from motionlab.diffusion import sampling
from motionlab.diffusion.model import Trained
from motionlab.diffusion.sampling import NoiseSchedule
from motionlab.motion import FPS, Motion

#: Bands of frequency in Hz, from (including) to; cosine k of T frames has k fps / (2 T).
BANDS = {"still": (0.0, 0.1), "below 1 Hz": (0.1, 1.0), "1 to 4 Hz": (1.0, 4.0), "above 4 Hz": (4.0, 1e9)}
LEGS, ARMS = ("hip", "knee", "ankle", "foot"), ("collar", "shoulder", "elbow", "wrist")


@dataclass(frozen=True, eq=False)
class Path:
    """The estimates of x_0 along one denoising.

    estimates (S, N, T, D): normalised, in the order of sampling, the last is the result. left (S,): share of the steps
    that is left behind each, 0 at the last. model: whose they are.
    """

    estimates: Tensor
    left: Tensor
    model: Trained

    def at(self, left: float) -> int:
        """Index of the first estimate with no more than this share of the steps left."""
        return int((self.left <= left + 1e-9).nonzero()[0])

    def motion(self, index: int) -> Motion:
        """One estimate as motions (N, T)."""
        return self.model.decode(self.estimates[index])


def record(
    model: Trained, count: int, generator: torch.Generator, *, steps: int = 100, along: NoiseSchedule | None = None
) -> Path:
    """``count`` motions by respaced DDPM, with all estimates of x_0.

    along: another schedule for the same network (:func:`printed`); default: the one it was trained on.
    """
    few, found = (along or model.schedule).respaced(steps), []

    def keep(x: Tensor, x0: Tensor, t: int) -> Tensor:
        found.append(x0.cpu())
        return x

    sampling.ddpm(model.denoiser, few, model.noise(count, generator), generator, after=keep)
    return Path(torch.stack(found), torch.arange(steps - 1, -1, -1) / steps, model)


def printed(trained_on: NoiseSchedule) -> NoiseSchedule:
    """The schedule as the thesis prints Eq. 4.4, without the square, for a network that was trained with it.

    At each step the network is told the stamp of its own schedule where as much of the signal is left: it meets no
    noise that it does not know; only where the steps are spent differs.
    """
    other = sampling.cosine(len(trained_on), power=1.0)
    noise = [torch.logit(s.alpha_bar) for s in (trained_on, other)]
    nearest = (noise[0][None] - noise[1][:, None]).abs().argmin(1)
    return NoiseSchedule(other.alpha_bar, trained_on.stamps[nearest])


# ------------------------------------------------------------------------------------------------- measures
def columns(model: Trained) -> dict[str, Tensor]:
    """Which numbers (D,) are the root's (place and heading), the legs', the arms'."""
    names = model.layout.skeleton.names[1:]
    parts = {"root": ({"groups": ["root", "orient"]})}
    parts |= {k: {"joints": [n for n in names if n.endswith(v)]} for k, v in (("legs", LEGS), ("arms", ARMS))}
    return {name: model.layout.mask(1, **what)[0] for name, what in parts.items()}


def far(path: Path) -> Tensor:
    """Mean distance (S, N) of the joints from the final motion's, over that between two samples' final motions.

    1 is as far as another motion. Joints as they stand in the frame of the model.
    """
    final = path.motion(-1).positions
    other = (final - final.roll(1, 0)).norm(dim=-1).mean()
    steps = range(len(path.estimates))
    return torch.stack([(path.motion(k).positions - final).norm(dim=-1).mean((-1, -2)) for k in steps]) / other


def by_band(path: Path) -> dict[str, dict[str, Tensor]]:
    """group -> band -> (S,): root mean square change that is still to come, over that between two samples' results."""
    x = cosine_transform(path.estimates.shape[-2]) @ path.estimates
    to_come, between = (x - x[-1]).square(), (x[-1] - x[-1].roll(1, 0)).square()
    hertz = torch.arange(x.shape[-2]) * FPS / (2 * x.shape[-2])
    found: dict[str, dict[str, Tensor]] = {}
    for group, chosen in columns(path.model).items():
        found[group] = {}
        for band, (low, high) in BANDS.items():
            rows = (hertz >= low) & (hertz < high)
            change, scale = (y[..., rows, :][..., chosen].mean((-1, -2, -3)) for y in (to_come, between))
            found[group][band] = (change / scale.clamp(min=1e-12)).sqrt()
    return found


def share_late(path: Path, left: float = 0.1) -> Mapping[str, float]:
    """Share of the whole way of the estimate, step by step, that it goes in the last steps, by group.

    ``left`` itself is what a change that never slows down gives.
    """
    found = {}
    for group, chosen in columns(path.model).items():
        way = path.estimates[..., chosen].diff(dim=0).square().mean((-1, -2)).sqrt().mean(-1)
        found[group] = (way[path.at(left) :].sum() / way.sum()).item()
    return found


def spread(path: Path) -> Tensor:
    """Root mean square (S, N) of each estimate's distance from the data's mean, over that of the final ones."""
    size = path.estimates.square().mean((-1, -2)).sqrt()
    return size / size[-1].mean()
