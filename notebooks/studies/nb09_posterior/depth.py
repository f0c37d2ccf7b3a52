"""How far away, how tall, how high the camera: what one camera cannot tell apart, and what would tell it.

A person twice as large at twice the distance gives the same image, and stands on a floor twice as far below the camera.
Three numbers move a fitted person, whose pose stays:

    p' = e^d r + e^s (p - r)  in camera axes, r the pelvis;     the camera stands h higher above the floor

s, d: logarithms of size and of distance over the fitted ones. The image knows d - s; a prior on stature knows s a
little; feet on the floor know the camera's height over the floor in body lengths, that is metres once it is measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.errors import ShapeError
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.humor.energies import SIGMA, body_25_confidence, gmof
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from motionlab.skeleton import STANDARD

NAMES, UNITS = ("size", "distance", "camera height"), ("log", "log", "m")
PIXEL = 6.0  # pixels: standard deviation of a keypoint of confidence 1; HuMoR's 0.001 beside its 0.075 says 6.1
STATURE = 0.05  # standard deviation of the logarithm of a grown-up's stature
FOOT = 0.02  # metres: how well a joint of the foot in contact is known to be at its resting height
_ENOUGH = 1e-12  # of the energy: a Gauss-Newton step that gains less is the last
FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")


@dataclass(frozen=True)
class Known:
    """What is known beside the image. stature, camera: standard deviations, of log size and of the camera's height in
    metres. feet: that feet in contact stand on the floor."""

    stature: float = STATURE
    feet: bool = False
    camera: float = 1.0


#: From the image alone to a camera that was measured.
KNOWLEDGE = {
    "image": Known(stature=0.5),
    "and stature": Known(),
    "and feet on a floor": Known(feet=True),
    "and camera height to 5 cm": Known(feet=True, camera=0.05),
    "and camera height to 1 cm": Known(feet=True, camera=0.01),
}


@dataclass(frozen=True, eq=False)
class View:
    """F frames of one fitted person before a camera; float64, metres, pixels.

    points (F, 25, 3): landmarks in camera axes as fitted; pelvis (F, 3). pixels (F, 25, 2), weight (F, 25): detected.
    focal (2,), middle (2,): of the image. up (3,): the world's up in camera axes. height: of the camera as given.
    feet (F, 4, 3): ankles and balls of the feet, camera axes; touching (F, 4): 1 where the fit says so; resting (4,):
    height above the floor of each while it touches. size: log of the fitted stature over the standard one.
    """

    points: Tensor
    pelvis: Tensor
    pixels: Tensor
    weight: Tensor
    focal: Tensor
    middle: Tensor
    up: Tensor
    height: float
    feet: Tensor
    touching: Tensor
    resting: Tensor
    size: float

    def residuals(self, theta: Tensor, known: Known) -> tuple[Tensor, Tensor]:
        """Of theta (..., 3): of the image (..., F, 25, 2), pixels, and of all else (..., M), standard deviations."""
        size, away, rise = theta.unbind(-1)
        grow, far = (x.exp()[..., None, None, None] for x in (size, away))
        place = far * self.pelvis[:, None] + grow * (self.points - self.pelvis[:, None])
        pixels = self.focal * place[..., :2] / place[..., 2:].clamp(min=0.05) + self.middle
        miss = torch.where(self.weight[..., None] > 0, pixels - self.pixels, 0.0)
        prior = torch.stack(((size + self.size) / known.stature, rise / known.camera), -1)
        if not known.feet:
            return miss, prior
        feet = far * self.pelvis[:, None] + grow * (self.feet - self.pelvis[:, None])
        above = (self.height + rise)[..., None, None] + (feet * self.up).sum(-1) - grow[..., 0] * self.resting
        return miss, torch.cat((prior, (self.touching * above / FOOT).flatten(-2)), -1)

    def log_prob(self, theta: Tensor, known: Known) -> Tensor:
        """Of theta (..., 3), nats."""
        miss, rest = self.residuals(theta, known)
        seen = self.weight.square()[..., None] * gmof(miss)
        return -0.5 * seen.sum((-1, -2, -3)) / PIXEL**2 - 0.5 * rest.square().sum(-1)

    def laplace(self, known: Known, steps: int = 50) -> tuple[Tensor, Tensor]:
        """The most probable theta (3,), by damped Gauss-Newton, and a factor (3, 3) of the covariance there."""

        def whole(theta: Tensor) -> Tensor:
            miss, rest = self.residuals(theta, known)
            robust = miss / (1 + (miss / SIGMA).square()).sqrt()
            return torch.cat(
                ((self.weight[..., None] * robust).flatten() / PIXEL, rest)
            )  # half its square is the energy

        theta, damp = torch.zeros(3, dtype=torch.float64), 1e-3
        r, slope = whole(theta), torch.func.jacrev(whole)(theta)
        for _ in range(steps):
            hessian = slope.mT @ slope
            step = torch.linalg.solve(hessian + damp * torch.diag(hessian.diagonal()), slope.mT @ r)
            there = whole(theta - step)
            less = (r.square().sum() - there.square().sum()) / r.square().sum()
            if less > 0:
                theta, damp = theta - step, damp / 5
                r, slope = there, torch.func.jacrev(whole)(theta)
                if less < _ENOUGH:
                    break
            else:  # the curvature here is known
                damp *= 5
        return theta, torch.linalg.cholesky(torch.linalg.inv(slope.mT @ slope))

    def moved(self, rise: float) -> View:
        """As if somebody had measured the camera's height wrong by so much, metres."""
        return replace(self, height=self.height + rise)


def view(fit: Motion, betas: Tensor, observation: Observation2D, camera: Camera, frames: Tensor) -> View:
    """One clip (T,) of a fit with shape (8,), its detections and its camera, in some frames (F,).

    Raises:
        ShapeError: a batch, or a fit without contacts.
    """
    if fit.root.ndim != 2 or fit.contacts is None:
        raise ShapeError("view: expected one clip (T,) with contacts")
    camera, positions, turns = camera.to(torch.float64), *(x[frames].double() for x in fit.world)
    shape = betas.double()

    def local(points: Tensor) -> Tensor:
        return points @ camera.rotation.mT + camera.translation

    rest = replace(STANDARD, offsets=offsets(shape)).rest_positions()[..., 1]
    feet = STANDARD.indices(FEET)
    touching = fit.contacts[frames][:, [fit.skeleton.contact_names.index(name) for name in FEET]].double()
    k = camera.intrinsics
    return View(
        local(landmarks(positions, turns, shape)), local(positions[:, 0]), observation.keypoints[frames].double(),
        seen_weight(observation, frames), torch.stack((k[0, 0], k[1, 1])), k[:2, 2], camera.rotation[:, 2],
        float(camera.centre[2]), local(positions[:, feet]), touching,
        (rest - rest.amin() + STANDARD.sole)[feet], float(_stature(rest).log()),
    )  # fmt: skip


def _stature(rest: Tensor) -> Tensor:
    """From the lowest to the highest joint of a rest pose, heights (22,), over the standard skeleton's."""
    standard = STANDARD.rest_positions()[..., 1].to(rest)
    return (rest.amax() - rest.amin()) / (standard.amax() - standard.amin())


def seen_weight(observation: Observation2D, frames: Tensor) -> Tensor:
    """Confidences (F, 25), neck and hips at zero as in a fit."""
    seen = observation.confidence[frames].double()
    finite = observation.keypoints[frames].isfinite().all(-1)
    return body_25_confidence(torch.where(finite, seen, 0.0))


def true_numbers(view: View, truth: Motion, camera: Camera, frames: Tensor) -> Tensor:
    """What theta (3,) is in truth, the pose of the fit being what it is: the true stature over the fitted one, the true
    distance of the pelvis over the fitted one (mean over the frames), and no change of height."""
    camera = camera.to(torch.float64)
    pelvis = truth.root[frames].double() @ camera.rotation.mT + camera.translation
    away = (pelvis.norm(dim=-1) / view.pelvis.norm(dim=-1)).log().mean()
    rest = truth.skeleton.rest_positions().double().reshape(-1, len(STANDARD), 3)[0, :, 1]
    return torch.stack((_stature(rest).log() - view.size, away, torch.zeros((), dtype=torch.float64)))
