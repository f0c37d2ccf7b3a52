"""What a fit leaves open: other motions that explain what was seen as well, and regions of hidden joints.

    fitted = testops.fit(observation, priors, solver="shooting")
    draws = posterior.sample(fitted, 32, generator=generator)
    draws.summary()  # "left ankle, 0.8 to 2.0 s: 17 cm at 90 %"

Around the end of a fit ``shooting`` knows coordinates nu in which stage 3's energy E is close to 1/2 |nu|^2. With w the
motion prior's weight, so that E / w is in nats, and p ~ exp(-E / (T w)),

    nu ~ N(0, T w),      every draw rolled out exactly.

An energy is too sure. So ``places`` widens regions until they held what they promise on recorded people who were kept
apart for that (split-conformal, by person).

Source: Lee, Barber and Willett 2023 (conformal prediction where people bring many numbers each). Calibration:
``notebooks/studies/nb09_posterior``.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor.coordinates import linearised, unwhiten
from motionlab.humor.testops import Fitted
from motionlab.humor.unknowns import motion_of
from motionlab.motion import Motion, runs
from motionlab.skeleton import STANDARD

#: Nats that count as one, and a floor of model error in metres: chosen on 12 recorded people ("val") behind walls
#: and desks, by the likelihood of their hidden limbs (notebook 09, ``calibration.chosen``).
TEMPERATURE, FLOOR = 30.0, 0.08
#: Level -> how many deviations wide a region is that held so much of the hidden limbs of those people.
RADII = {0.5: 1.49, 0.8: 2.47, 0.9: 3.65}
#: Joints whose places are calibrated: where they are hidden.
_LIMBS = torch.tensor([n.endswith(("knee", "ankle", "foot", "elbow", "wrist")) for n in STANDARD.names])
_TOGETHER = 32  # draws rolled out at once: 4 MB of gains each
_SHORTEST = 5  # frames: what is hidden for less is not spoken of


@dataclass(frozen=True, eq=False)
class Draws:
    """Motions that one clip could have been.

    fit: the motion (T,) that the fit found. motions: K others (K, T). hidden (T, J): limbs' joints that nothing showed.
    diagnostics: what the fit says against itself.
    """

    fit: Motion
    motions: Motion
    hidden: Tensor
    diagnostics: tuple[str, ...] = ()

    def changed(self, how: Callable[[Motion], Motion]) -> Self:
        """Returns the same draws, each of their motions changed alike: moved, or made larger."""
        return replace(self, fit=how(self.fit), motions=how(self.motions))

    limbs = _LIMBS  # which joints (J,) are of limbs, whose places are calibrated

    def places(self, level: float = 0.9) -> tuple[Tensor, Tensor]:
        """Computes regions that hold a level of hidden joints: centres c (T, J, 3) and S (T, J, 3, 3), metres.

        A region is (x - c)^T S^-1 (x - c) <= 1. It is about the pelvis, drawn where the fit has it: how far away the
        whole person stands is another question. Of joints that were seen it promises nothing.

        Raises:
            ValueError: a level without a radius.
        """
        if level not in RADII:
            raise ValueError(f"level: expected one of {', '.join(map(str, RADII))}, got {level}")
        mean, spread = places_of(self.motions)
        floor = FLOOR**2 * torch.eye(3).to(spread)
        return self.fit.root[:, None] + mean, RADII[level] ** 2 * (spread + floor)

    def summary(self, level: float = 0.9) -> list[str]:
        """Returns sentences: of every limb's joint while hidden, its region's mean half-width in cm; and doubts."""
        width = 100 * self.places(level)[1].diagonal(dim1=-2, dim2=-1).mean(-1).sqrt()
        said = []
        for joint, name in enumerate(self.fit.skeleton.names):
            for start, end in [span for span in runs(self.hidden[:, joint]) if span[1] - span[0] >= _SHORTEST]:
                span = f"{start / self.fit.fps:.1f} to {(end - 1) / self.fit.fps:.1f} s"
                size = f"{width[start:end, joint].mean():.0f} cm at {100 * level:.0f} %"
                said.append(f"{name.replace('_', ' ')}, {span}: {size}")
        return [*said, *self.diagnostics]


def sample(
    fitted: Fitted, count: int, *, generator: torch.Generator, clip: int = 0, temperature: float | Tensor = TEMPERATURE
) -> Draws:
    """Draws ``count`` motions of a clip of a fit by shooting: about 0.7 s for 32 motions of two seconds.

    temperature: how many nats of the energy count as one, for all draws or for each (K,); at 1 the energy is believed.

    Raises:
        DataError: a fit by another solver, which keeps no coordinates. ValueError: no draws, or a temperature below 0.
    """
    motions = rolled(fitted, count, generator, clip, temperature)
    said = () if fitted.diagnostics is None else fitted.diagnostics.sentences()
    hidden = (fitted.problem.evidence.confidence_per_joint[clip] < 1) & _LIMBS
    return Draws(fitted.motion.clip(clip), motions, hidden, tuple(s for s in said if f"clip {clip}:" in s))


def rolled(fitted: Fitted, count: int, generator: torch.Generator, clip: int, temperature: float | Tensor) -> Motion:
    """Draws the motions (K, T) of :func:`sample` alone."""
    if fitted.problem is None or fitted.unknown is None:
        remedy = 'fit with solver="shooting", and let stage 3 run'
        raise DataError("a fit that keeps no problem and unknowns: nothing to draw around", remedy=remedy)
    heat = torch.as_tensor(temperature, dtype=torch.float32).expand(max(count, 0))
    if count < 1 or not bool((heat > 0).all()):
        raise ValueError(f"expected at least one draw and temperatures above 0, got {count} and {temperature}")
    row = torch.tensor([clip])
    problem, unknown = fitted.problem.rows(row), fitted.unknown.rows(row)
    loop = linearised(problem, unknown)
    shapes, parts = {"nu": loop.base.shape[1:], "first": loop.first.shape[1:2]}, []
    for size in (heat * problem.weights.motion_prior[2]).sqrt().split(_TOGETHER):
        rows = torch.zeros(len(size), dtype=torch.long)
        noise = {name: torch.randn(len(size), *shape, generator=generator) for name, shape in shapes.items()}
        new = {name: size.reshape(-1, *(1,) * (x.ndim - 1)) * x for name, x in noise.items()}
        with torch.no_grad():
            parts.append(unwhiten(problem.rows(rows), unknown.rows(rows), loop.rows(rows), new)[1].body)
    whole = {name: torch.cat([getattr(part, name) for part in parts]) for name in ("root", "rot", "betas")}
    return motion_of(parts[0]._replace(**whole), problem.evidence.fps)


def places_of(motions: Motion) -> tuple[Tensor, Tensor]:
    """Computes where joints of K motions are about the pelvis: means (T, J, 3) and covariances (T, J, 3, 3), metres."""
    places = motions.positions - motions.root[..., None, :]
    off = places - places.mean(0)
    return places.mean(0), torch.einsum("ktja,ktjb->tjab", off, off) / max(len(off) - 1, 1)
