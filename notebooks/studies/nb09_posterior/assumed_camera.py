"""How far, how tall, from how high: what one image cannot tell apart where the camera is assumed, five numbers.

A fit under an assumed camera has the person's shape in the image, not its size. With the pose as fitted,

    p' = e^s (p - r) + e^d (x e^-k, y e^-k, z),     r = (x, y, z) the pelvis, camera axes;     focal length f e^k

s, d, k: logarithms of size, depth and focal length over the assumed ones; the camera is turned up by a and stands h
higher. The image knows d - s - k; feet on a floor know how pitch and height go with distance; what ends the ridge is
what is known beforehand.

Source: Foreman-Mackey et al. 2013 (emcee; a chain of 50 autocorrelation times may be reported).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import emcee
import numpy as np
import torch
from torch import Tensor

from data_synth.scenes import Scene
from motionlab.errors import NotConverged
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.humor.energies import body_25_confidence, gmof
from motionlab.humor.testops import Fitted
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from motionlab.skeleton import STANDARD

PIXEL = 6.0  # pixels: standard deviation of a keypoint of confidence 1; HuMoR's 0.001 beside its 0.075 says 6.1
FOOT = 0.02  # metres: how well a joint of the foot in contact is known to be at its resting height
FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")
#: Standard deviations of what is known beforehand of log size, log distance (next to nothing), log focal length, pitch
#: (rad) and height of the camera (m).
UNTOLD = (0.05, 10.0, 0.3, 0.15, 0.4)
#: What a client can measure: which of the five, and how well.
KNOWLEDGE = {
    "nothing": {},
    "the focal length": {2: 0.01},
    "and the camera's height and pitch": {2: 0.01, 3: 0.005, 4: 0.01},
}


@dataclass(frozen=True, eq=False)
class View:
    """F frames of one fitted person before the camera that the fit assumed; float64, metres, pixels.

    points (F, 25, 3): landmarks in camera axes as fitted; pelvis (F, 3). pixels (F, 25, 2), weight (F, 25): detected.
    camera: as assumed. feet (F, 4, 3): ankles and balls of the feet, camera axes; touching (F, 4); resting (4,): height
    of each above the floor while it touches. size: log of the fitted stature over the standard one.
    """

    points: Tensor
    pelvis: Tensor
    pixels: Tensor
    weight: Tensor
    camera: Camera
    feet: Tensor
    touching: Tensor
    resting: Tensor
    size: float

    def log_prob(self, theta: Tensor, middle: Tensor, sizes: Tensor) -> Tensor:
        """Computes the log density of theta (B, 5), nats. All frames count as one: a pose is off in all alike."""
        grow, far, zoom = (x.exp()[:, None, None, None] for x in theta[:, :3].unbind(-1))
        sideways = torch.cat((1 / zoom, 1 / zoom, torch.ones_like(zoom)), -1)  # the pelvis stays where the image has it

        def moved(points: Tensor) -> Tensor:
            return grow * (points - self.pelvis[:, None]) + far * sideways * self.pelvis[:, None]

        place, k = moved(self.points), self.camera.intrinsics
        pixels = zoom * torch.stack((k[0, 0], k[1, 1])) * place[..., :2] / place[..., 2:].clamp(min=0.05) + k[:2, 2]
        miss = torch.where(self.weight[..., None] > 0, pixels - self.pixels, 0.0)
        up = turned(self.camera.rotation[:, 2], theta[:, 3])
        above = (moved(self.feet) @ up[:, None, :, None])[..., 0] - grow[..., 0] * self.resting
        above = above + (self.camera.centre[2] + theta[:, 4])[:, None, None]
        seen = (self.weight.square()[..., None] * gmof(miss)).sum((-1, -2)).mean(-1) / PIXEL**2
        stands = (self.touching * (above / FOOT).square()).sum(-1).mean(-1)
        return -0.5 * (seen + stands + ((theta - middle) / sizes).square().sum(-1))


def turned(up: Tensor, tilt: Tensor) -> Tensor:
    """Computes the world's up (B, 3) in the axes of cameras that are turned about their x axis by tilt (B,)."""
    c, s = tilt.cos(), tilt.sin()
    return torch.stack((up[0].expand_as(c), c * up[1] - s * up[2], s * up[1] + c * up[2]), -1)


def view(fit: Motion, betas: Tensor, observation: Observation2D, camera: Camera, frames: Tensor) -> View:
    """Makes the view of one clip (T,) of a fit with shape (8,), its detections and its camera, in frames (F,)."""
    camera, positions, turns = camera.to(torch.float64), *(x[frames].double() for x in fit.world)
    shape = betas.double()

    def local(points: Tensor) -> Tensor:
        return points @ camera.rotation.mT + camera.translation

    rest = replace(STANDARD, offsets=offsets(shape)).rest_positions()[..., 1]
    feet, finite = STANDARD.indices(FEET), observation.keypoints[frames].isfinite().all(-1)
    touching = fit.contacts[frames][:, [fit.skeleton.contact_names.index(name) for name in FEET]].double()
    weight = body_25_confidence(torch.where(finite, observation.confidence[frames].double(), 0.0))
    return View(
        local(landmarks(positions, turns, shape)), local(positions[:, 0]), observation.keypoints[frames].double(),
        weight, camera, local(positions[:, feet]), touching, (rest - rest.amin() + STANDARD.sole)[feet],
        float(_stature(rest).log()),
    )  # fmt: skip


def _stature(rest: Tensor) -> Tensor:
    """From the lowest to the highest joint of a rest pose, heights (22,), over the standard skeleton's."""
    standard = STANDARD.rest_positions()[..., 1].to(rest)
    return (rest.amax() - rest.amin()) / (standard.amax() - standard.amin())


def true_numbers(seen: View, truth: Motion, camera: Camera, frames: Tensor) -> Tensor:
    """Computes what theta (5,) is in truth, the pose of the fit being what it is."""
    camera = camera.to(torch.float64)
    pelvis = truth.root[frames].double() @ camera.rotation.mT + camera.translation
    rest = truth.skeleton.rest_positions().double().reshape(-1, len(STANDARD), 3)[0, :, 1]
    tilts = [torch.atan2(up[2], -up[1]) for up in (seen.camera.rotation[:, 2], camera.rotation[:, 2])]
    away = (pelvis[:, 2] / seen.pelvis[:, 2]).log().mean()
    zoom = (camera.intrinsics[0, 0] / seen.camera.intrinsics[0, 0]).log()
    rise = camera.centre[2] - seen.camera.centre[2]
    return torch.stack((_stature(rest).log() - seen.size, away, zoom, tilts[0] - tilts[1], rise))


def walkers(
    log_prob: Callable[[Tensor], Tensor], start: Tensor, generator: torch.Generator,
    steps: int, block: int, least: float,
) -> Tensor:  # fmt: skip
    """Draws (N, n) from a posterior over few numbers by emcee: walkers begin at start (W, n), and go on until at two
    looks in a row, ``block`` steps apart, their chain is ``least`` autocorrelation times long.

    Raises:
        NotConverged: it is not after so many steps.
    """

    @torch.no_grad()
    def of(points: np.ndarray) -> np.ndarray:
        found = log_prob(torch.from_numpy(points)).double().numpy(force=True)
        return np.where(np.isfinite(found), found, -np.inf)

    random = np.random.RandomState(int(torch.randint(2**31 - 1, (), generator=generator)))  # what emcee takes
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]  # which follow a bent ridge
    sampler = emcee.EnsembleSampler(*start.shape, of, vectorize=True, moves=moves)
    state, looks = emcee.State(start.double().numpy(force=True), random_state=random.get_state()), 0
    while sampler.iteration < steps:
        state = sampler.run_mcmc(state, min(block, steps - sampler.iteration))
        longest = sampler.get_autocorr_time(tol=0).max()
        cut = min(math.ceil(5 * longest), sampler.iteration // 2) if np.isfinite(longest) else sampler.iteration // 2
        long = (sampler.iteration - cut) / sampler.get_autocorr_time(discard=cut, tol=0).clip(min=1)
        looks = looks + 1 if (long >= least).all() else 0  # not so where a time is not finite
        if looks == 2:
            return torch.from_numpy(sampler.get_chain(discard=cut, flat=True))
    raise NotConverged(f"after {steps} steps {long.min():.0f} of {least:g} autocorrelation times")


def asked(
    fit: Fitted, scene: Scene, frames: Tensor, generator: Callable[[str], torch.Generator], **how
) -> tuple[dict[str, list[tuple[Tensor, Tensor]]], Tensor]:
    """Draws the five numbers of every clip under every knowledge: draws and true numbers; distances (C,), metres."""
    found, away = {name: [] for name in KNOWLEDGE}, []
    for k, camera in enumerate(scene.cameras):
        seen = view(fit.motion.clip(k), fit.betas[k], scene.clip(k), fit.cameras[k], frames)
        exact = true_numbers(seen, scene.truth.clip(k), camera, frames)
        away.append(seen.pelvis[:, 2].mean() * exact[1].exp())
        for name, told in KNOWLEDGE.items():
            seeds, middle = generator(f"{name} {k}"), torch.tensor((-seen.size, 0, 0, 0, 0), dtype=torch.float64)
            sizes = torch.tensor(UNTOLD, dtype=torch.float64)
            for number, size in told.items():
                middle[number], sizes[number] = exact[number], size
            start = middle + 0.02 * torch.randn(24, len(UNTOLD), generator=seeds, dtype=torch.float64)
            start[:, 1] += start[:, 0] + start[:, 2]  # nearly as large in the image
            draws = walkers(lambda x, m=middle, s=sizes, v=seen: v.log_prob(x, m, s), start, seeds, **how)
            found[name].append((draws, exact))
    return found, torch.stack(away)


def rows(found: Mapping[str, list[tuple[Tensor, Tensor]]], away: Tensor) -> list[dict[str, object]]:
    """Makes a row per state of knowledge: how far off distance and stature may be, and how many clips hold the truth;
    of draws and true numbers of clips at distances (C,), metres."""
    table = []
    for name, clips in found.items():
        half = torch.stack([d.quantile(0.95, 0) - d.quantile(0.05, 0) for d, _ in clips]) / 2
        ranks = torch.stack([(d < t).double().mean(0) for d, t in clips])
        inside = ((ranks > 0.05) & (ranks < 0.95)).sum(0).tolist()
        table.append({
            "told": name, "distance, half of the 90 %, cm": (100 * half[:, 1] * away).median().item(),
            "stature, cm": (170 * half[:, 0]).median().item(),
            "truth in the 90 %: distance": f"{inside[1]} of {len(clips)}", "stature": f"{inside[0]} of {len(clips)}",
        })  # fmt: skip
    return table
