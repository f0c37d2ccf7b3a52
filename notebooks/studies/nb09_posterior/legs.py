"""What is left open about hidden joints of a fitted clip: its posterior in the few directions that move them most.

The unknowns of stage 3 near a fit, q = 0 at the fit, are scaled so that a unit is about what is not known beforehand:

    x0 (root, pose, velocities), betas;   z_t = z*_t + sigma_t sum_k C_kt q_k,   C the cosine transform of time

with K low frequencies for each of the 48 latents. In the directions V of ``curvature`` the posterior is near N(0, 1);
emcee draws c from the exact energy of the exact roll-out at q = V c. Everything else goes along as the curvature says
it does on average; its own scatter, and what camera, weights and the model itself may have wrong, is fixed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from motionlab.baselines import cosine_transform
from motionlab.errors import DataError
from motionlab.humor import state, unknowns
from motionlab.humor.energies import JOINTS, RGB_LIGHT, Weights
from motionlab.humor.evidence import Observation3D, evidence
from motionlab.humor.priors import Priors
from motionlab.humor.stages import Problem, motion_terms
from motionlab.humor.testops import Fitted
from motionlab.humor.unknowns import Rolled, Unknowns
from motionlab.motion import Motion
from motionlab.observation import Observation2D
from motionlab.skeleton import STANDARD
from studies.nb09_posterior import curvature
from studies.nb09_posterior.curvature import Directions

LEGS = tuple(STANDARD.indices([f"{side}_{part}" for side in ("left", "right") for part in ("knee", "ankle", "foot")]))
#: What is not known beforehand of x0 and shape, standard deviations: metres, 6 numbers of a rotation, the pose prior's
#: latents, metres and radians per second, betas. Weak: they only bound what neither data nor priors see.
_UNKNOWN = {
    "trans": 1.0, "orient": 1.0, "latent": 2.0, "trans_vel": 3.0, "root_orient_vel": 3.0, "joints_vel": 3.0,
    "betas": 1.0,
}  # fmt: skip
_STEP = 3e-3


@dataclass(frozen=True, eq=False)
class Point:
    """One fitted clip as the point q = 0: its problem and unknowns with G = W = 1, and the latents' size there.

    sigma (T - 1, 48): of the motion prior along the roll-out. frequencies: K above.
    """

    problem: Problem
    unknown: Unknowns
    sigma: Tensor
    frequencies: int

    @property
    def size(self) -> int:
        """Number of unknowns N."""
        return sum(self._sizes()) + self.frequencies * self.sigma.shape[1]

    @cached_property
    def ridge(self) -> Tensor:
        """What bounds the unknowns beside the energy (N,): 1 for x0 and shape; of the latents their prior is in it."""
        waves = self.frequencies * self.sigma.shape[1]
        return torch.cat((torch.ones(self.size - waves), torch.full((waves,), 1e-3))).double()

    @property
    def nat(self) -> float:
        """What the weighted energy calls a nat: the motion prior's weight."""
        return self.problem.weights.motion_prior[2]

    def at(self, q: Tensor) -> tuple[Problem, Unknowns]:
        """The problem, once for every row of q (B, N), and its unknowns there."""
        rows = torch.zeros(len(q), dtype=torch.long)
        *parts, waves = q.to(self.sigma).split([*self._sizes(), self.frequencies * self.sigma.shape[1]], 1)
        found = self.unknown.rows(rows).named()
        for (name, unit), part in zip(_UNKNOWN.items(), parts, strict=True):
            found[name] = found[name] + unit * part.reshape(found[name].shape)
        change = self.cosine.mT @ waves.unflatten(1, (self.frequencies, -1))  # (B, T - 1, 48)
        found["z"] = found["z"] + (self.sigma * change)[:, None]
        return self.problem.rows(rows), Unknowns(**found)

    def _sizes(self) -> list[int]:
        named = self.unknown.named()
        return [named[n].numel() for n in _UNKNOWN]

    @cached_property
    def cosine(self) -> Tensor:
        """Orthonormal rows (K, T - 1)."""
        return cosine_transform(len(self.sigma), torch.float32)[: self.frequencies]

    def ways(self, rolled: Rolled) -> Tensor:
        """Where the legs are about the pelvis, (B, T, 6, 3), metres; nought where they were seen."""
        joints = rolled.body.joints
        return (joints[:, :, list(LEGS)] - joints[:, :, :1]) * self.hidden[..., None]

    def roll(self, q: Tensor) -> Rolled:
        """The motions at q (B, N)."""
        problem, unknown = self.at(q)
        return unknowns.roll(unknown, problem.priors, problem.evidence)

    def energy(self, q: Tensor) -> Tensor:
        """Stage 3's energy (B,) at q (B, N), nats."""
        problem, unknown = self.at(q)
        return sum(motion_terms(problem, unknown).values()).double() / self.nat

    @cached_property
    def hidden(self) -> Tensor:
        """Which knees, ankles and feet no detection shows, (T, 6)."""
        return self.problem.evidence.trust[0][:, list(LEGS)] < 1


def points(
    fitted: Fitted,
    observation: Observation2D | Observation3D,
    priors: Priors,
    *,
    weights: Weights | None = None,
    frequencies: int = 12,
) -> list[Point]:
    """A point for every clip of a fit (lean mode, one window), from its first state and latents.

    Raises:
        DataError: a fit in several windows, or without stage 3.
    """
    if len(fitted.starts) > 1 or 3 not in fitted.stages:
        raise DataError("expected a fit with stage 3 in one window", remedy="fit at most 60 frames at a time")
    weights = weights or (RGB_LIGHT if isinstance(observation, Observation2D) else JOINTS)
    seen = evidence(observation, cameras=fitted.cameras)
    found = []
    for index in range(len(fitted.z)):
        row = torch.tensor([index])
        problem = Problem(seen.rows(row), priors, weights)
        unknown = _unknown(fitted, index, priors)
        with torch.no_grad():
            rolled = unknowns.roll(unknown, priors, problem.evidence)
        sigma = (0.5 * rolled.rollout.prior.log_var[0]).exp()
        found.append(Point(problem, unknown, sigma, min(frequencies, len(sigma))))
    return found


def _unknown(fitted: Fitted, index: int, priors: Priors) -> Unknowns:
    """The unknowns (1, 1, ...) of a clip, its pose latent by Gauss-Newton from the encoder's."""
    parts = state.unpack(fitted.first[index, :1])
    latent = _latent(parts["pose_body"][0], priors)
    unknown = {
        "trans": parts["trans"], "orient": unknowns.from_matrix(parts["root_orient"], "lean"), "latent": latent[None],
        "trans_vel": parts["trans_vel"], "root_orient_vel": parts["root_orient_vel"],
        "joints_vel": parts["joints_vel"].flatten(-2), "z": fitted.z[index, :1],
    }  # fmt: skip
    camera = None if fitted.cameras is None else torch.zeros(1, 3)
    return Unknowns(**{n: x[None] for n, x in unknown.items()}, betas=fitted.betas[index : index + 1], camera=camera)


def _latent(body: Tensor, priors: Priors, steps: int = 30) -> Tensor:
    """The latent (32,) that decodes to a body (21, 3, 3)."""
    with torch.no_grad():
        latent = priors.pose.encode(body).mean.double()
        model = priors.pose

        def decoded(x: Tensor) -> Tensor:
            return model.decode(x.float()).flatten(-3).double()

        step = 1e-2 * torch.eye(len(latent), dtype=torch.float64)
        for _ in range(steps):
            miss = decoded(latent) - body.flatten().double()
            slope = (decoded(latent + step) - decoded(latent - step)) / 2e-2
            latent = latent - torch.linalg.solve(slope @ slope.mT + 1e-6 * torch.eye(len(latent)), slope @ miss)
        return latent.float()


@dataclass(frozen=True, eq=False)
class Open:
    """What is open about the hidden legs of one clip: a Gaussian at ``centre`` (N,), and the directions that count.

    mean (k,): of Laplace's posterior in the directions, of covariance 1 there; not nought, since a fit stops early.
    """

    point: Point
    centre: Tensor
    directions: Directions
    slopes: Tensor
    mean: Tensor

    @property
    def size(self) -> int:
        """Number of directions k."""
        return len(self.mean)

    def log_prob(self, c: Tensor, temperature: float = 1.0) -> Tensor:
        """Of c (B, k), nats: the exact energy of the exact roll-out, over a temperature."""
        return -self.point.energy(self._q(c)) / temperature

    def _q(self, c: Tensor) -> Tensor:
        return (self.centre + c.double() @ self.directions.vectors.mT).float()

    def roll(self, c: Tensor, chunk: int = 64) -> tuple[Tensor, list[Rolled]]:
        """The hidden legs about the pelvis (B, T, 6, 3) at c (B, k), and the roll-outs they come from, in pieces."""
        with torch.no_grad():
            rolled = [self.point.roll(self._q(part)) for part in c.split(chunk)]
            return torch.cat([self.point.ways(each) for each in rolled]), rolled

    def motions(self, c: Tensor) -> Motion:
        """The motions (B, T) at c (B, k)."""
        with torch.no_grad():
            return unknowns.motion_of(self.point.roll(self._q(c)).body, self.point.problem.evidence.fps)

    def coordinates(self, ways: Tensor) -> Tensor:
        """How far legs (B, T, 6, 3) lie along the directions, (B, k), from the legs at the centre."""
        away = ways * self.point.hidden[..., None] - self.roll(self.mean.new_zeros(1, self.size))[0]
        return away.flatten(1).double() @ self.directions.shapes / self.directions.spread

    def scatter(self, count: int, generator: torch.Generator) -> Tensor:
        """What the other directions add to the legs, to first order: draws (count, T, 6, 3) of mean 0."""
        rest = self.directions.rest
        noise = torch.randn(count, rest.shape[1], generator=generator, dtype=rest.dtype)
        moved = noise @ rest.mT @ self.slopes.mT
        return moved.float().unflatten(1, (*self.point.hidden.shape, 3))

    def width(self) -> float:
        """Root mean square of a hidden joint's displacement under Laplace's posterior in the directions, metres."""
        return float((self.directions.spread.square().sum() / self.point.hidden.sum()).sqrt())


def opened(point: Point, count: int = 4) -> Open:
    """The directions that move the hidden legs of a clip most, one Gauss-Newton step after the fit.

    Raises:
        DataError: every leg was seen in every frame.
    """
    if not point.hidden.any():
        raise DataError("no knee, ankle or foot is hidden", remedy="nothing about the legs is open")
    with torch.no_grad():
        like = point.roll(torch.zeros(1, point.size))

        def function(q: Tensor) -> tuple[Tensor, Tensor]:
            problem, unknown = point.at(q)
            rolled = point.roll(q)
            return curvature.residuals(problem, unknown, rolled, like), point.ways(rolled).flatten(1)

        slopes, legs = curvature.slopes_of(function, point.size, step=_STEP)
        hessian = slopes.mT @ slopes + torch.diag(point.ridge)
    centre = descended(point, hessian)
    found = curvature.directions(hessian, legs, count)
    here = Open(point, centre, found, legs, torch.zeros(count, dtype=torch.float64))
    with torch.no_grad():
        unit = 0.5 * torch.eye(count, dtype=torch.float64)
        slope = here.log_prob(unit) - here.log_prob(-unit)  # a central difference over one standard deviation
    return Open(point, here.centre, found, legs, slope.clamp(-3.0, 3.0))


def descended(point: Point, hessian: Tensor, steps: int = 6) -> Tensor:
    """From the fit further down to q (N,) by Newton's steps with one curvature (N, N): a fit stops early."""
    factor = torch.linalg.cholesky(hessian)
    lengths = torch.tensor([0.0, 0.1, 0.25, 0.5, 1.0], dtype=torch.float64)[:, None]
    q = torch.zeros(point.size, dtype=torch.float64)
    for _ in range(steps):
        at = q.float()[None].requires_grad_()
        (pull,) = torch.autograd.grad(point.energy(at).sum(), at)
        step = torch.cholesky_solve(pull[0].double()[:, None] + (point.ridge * q)[:, None], factor)[:, 0]
        with torch.no_grad():
            tried = q - lengths * step
            energy = point.energy(tried) + 0.5 * (point.ridge * tried.square()).sum(-1)
        best = int(energy.nan_to_num(nan=torch.inf).argmin())
        if best == 0:
            break
        q = tried[best]
    return q


def truth_about_pelvis(truth: Motion) -> Tensor:
    """The true legs about the pelvis (T, 6, 3) of one clip, as ``Point.ways`` gives them."""
    joints = truth.positions
    return joints[:, list(LEGS)] - joints[:, :1]
