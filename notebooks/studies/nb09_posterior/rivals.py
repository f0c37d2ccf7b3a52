"""Four directions found more cheaply than by a fit's curvature: what do they hold of legs' freedom, and of errors?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from studies.nb09_posterior.legs import LEGS, Open
from studies.nb09_posterior.tables import quartiles

OURS, RANDOM = "the energy's, at the fit", "random, of the energy's posterior"
_DRAWS = 20  # of four random directions, whose shares are averaged


def bases(clip: Open) -> dict[str, Tensor]:
    """Orthonormal ways (M, k) for the hidden legs of a clip to move, by how they were found.

    The units are what is not known beforehand of any unknown; latents: of the motion prior's alone. Neither looks at
    the observation. Phase and size: the velocity of the fitted path of either leg, and its distance from its middle.
    """
    count, latents = clip.size, clip.point.frequencies * clip.point.sigma.shape[1]
    return {
        OURS: clip.directions.shapes,
        "of the unknowns' units, no energy": _main(clip.slopes, count),
        "of the latents' prior alone": _main(clip.slopes[:, -latents:], count),
        "earlier or later, further or less, of either leg": gait(clip),
    }


def _main(root: Tensor, count: int) -> Tensor:
    """The main axes (M, count) of root root^T, root (M, N)."""
    return torch.linalg.eigh(root @ root.mT).eigenvectors[:, -count:]


def gait(clip: Open) -> Tensor:
    """The trivial ones (M, 4): each leg's fitted path about the pelvis, shifted in time and made larger."""
    hidden = clip.point.hidden[..., None].double()
    (rolled,) = clip.roll(torch.zeros(1, clip.size, dtype=torch.float64))[1]
    joints = rolled.body.joints[0].double()
    path = joints[:, list(LEGS)] - joints[:, :1]
    later = hidden * torch.gradient(path, dim=0)[0]
    larger = hidden * (path - (hidden * path).sum(0) / hidden.sum(0).clamp(min=1))
    left = torch.arange(len(LEGS)) < len(LEGS) // 2
    ways = [(leg[:, None] * way).flatten() for way in (later, larger) for leg in (left, ~left)]
    u, size, _ = torch.linalg.svd(torch.stack(ways, 1), full_matrices=False)
    return u[:, size > 1e-9 * size[0]]  # a leg that was seen has none


def shares(basis: Tensor, clip: Open, away: Tensor) -> tuple[float, float]:
    """What a basis (M, k) holds of the variance that the energy leaves open, and of the square of an error (M,)."""
    root = clip.slopes @ torch.cat((clip.directions.vectors, clip.directions.rest), 1)
    found = [(basis.mT @ x).square().sum() / x.square().sum() for x in (root, away)]
    return float(found[0]), float(found[1])


def random_shares(clip: Open, away: Tensor, generator: torch.Generator) -> tuple[float, float]:
    """:func:`shares` of four directions that are drawn from the energy's posterior, mean over ``_DRAWS`` fours."""
    root = clip.slopes @ torch.cat((clip.directions.vectors, clip.directions.rest), 1)
    noise = torch.randn(_DRAWS, root.shape[1], clip.size, generator=generator, dtype=root.dtype)
    found = torch.tensor([shares(torch.linalg.qr(root @ each).Q, clip, away) for each in noise])
    return tuple(found.mean(0).tolist())


def compared(
    clips: Sequence[Open], truths: Sequence[Tensor], generator: torch.Generator
) -> dict[str, list[tuple[float, float]]]:
    """:func:`shares` of every clip by how its directions were found; truths: legs about the pelvis (T, 6, 3)."""
    found: dict[str, list[tuple[float, float]]] = {}
    for clip, truth in zip(clips, truths, strict=True):
        nought = torch.zeros(1, clip.size, dtype=torch.float64)
        away = ((truth - clip.roll(nought)[0][0]) * clip.point.hidden[..., None]).flatten().double()
        for name, basis in bases(clip).items():
            found.setdefault(name, []).append(shares(basis, clip, away))
        found.setdefault(RANDOM, []).append(random_shares(clip, away, generator))
    return found


def rows(found: Mapping[str, Sequence[tuple[float, float]]]) -> list[dict[str, str]]:
    """A row per kind: medians and quartiles over clips, and in how many the energy's own hold more of the error."""
    ours = [error for _, error in found[OURS]]
    return [
        {
            "four directions": name,
            "of the energy's own variance, %": quartiles([100 * variance for variance, _ in each], 0),
            "of the square of the fits' errors, %": quartiles([100 * error for _, error in each], 0),
            "clips in which the energy's hold more of the error": (
                "-" if name == OURS else f"{sum(a > b for a, (_, b) in zip(ours, each, strict=True))} of {len(each)}"
            ),
        }
        for name, each in found.items()
    ]
