"""How far, how tall, from how high: what one image cannot tell apart where the camera is assumed, five numbers.

A fit under an assumed camera has the person's shape in the image, not its size. With the pose as fitted,

    p' = e^s (p - r) + e^d (x e^-k, y e^-k, z),     r = (x, y, z) the pelvis, camera axes;     focal length f e^k

s, d, k: logarithms of size, depth and focal length over the assumed ones; the camera is turned up by a and stands h
higher. The image knows d - s - k; feet on a floor know how pitch and height go with distance; what ends the ridge is
what is known beforehand.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from data_synth.scenes import Scene
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.humor.energies import body_25_confidence, gmof
from motionlab.humor.testops import Fitted
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from motionlab.skeleton import STANDARD
from studies.nb09_posterior.walkers import Chain, walkers

NAMES = ("stature (log)", "distance (log)", "focal length (log)", "pitch (rad)", "camera height (m)")
PIXEL = 6.0  # pixels: standard deviation of a keypoint of confidence 1; HuMoR's 0.001 beside its 0.075 says 6.1
FOOT = 0.02  # metres: how well a joint of the foot in contact is known to be at its resting height
FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")


#: Standard deviations of what is known beforehand, in the order of NAMES; of the distance next to nothing.
UNTOLD = (0.05, 10.0, 0.3, 0.15, 0.4)
#: What a client can measure: which numbers, and how well.
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

    def before(self, told: Mapping[int, float], exact: Tensor) -> tuple[Tensor, Tensor]:
        """Returns middle and deviations (5,) of what is known beforehand; what was told is exact (5,)."""
        middle, sizes = torch.zeros(len(NAMES)).double(), torch.tensor(UNTOLD, dtype=torch.float64)
        middle[0] = -self.size
        for number, size in told.items():
            middle[number], sizes[number] = exact[number], size
        return middle, sizes

    def log_prob(self, theta: Tensor, middle: Tensor, sizes: Tensor) -> Tensor:
        """Computes the log density of theta (B, 5), nats. All frames count as one: a pose is off in all alike."""
        grow, far, zoom = (x.exp()[:, None, None, None] for x in theta[:, :3].unbind(-1))
        tilt, rise = theta[:, 3], theta[:, 4]

        sideways = torch.cat((1 / zoom, 1 / zoom, torch.ones_like(zoom)), -1)  # the pelvis stays where the image has it

        def moved(points: Tensor) -> Tensor:
            return grow * (points - self.pelvis[:, None]) + far * sideways * self.pelvis[:, None]

        place, k = moved(self.points), self.camera.intrinsics
        focal = torch.stack((k[0, 0], k[1, 1]))
        pixels = zoom * focal * place[..., :2] / place[..., 2:].clamp(min=0.05) + k[:2, 2]
        miss = torch.where(self.weight[..., None] > 0, pixels - self.pixels, 0.0)
        up = turned(self.camera.rotation[:, 2], tilt)
        above = (moved(self.feet) @ up[:, None, :, None])[..., 0] + (self.camera.centre[2] + rise)[:, None, None]
        above = above - grow[..., 0] * self.resting
        seen = (self.weight.square()[..., None] * gmof(miss)).sum((-1, -2)).mean(-1) / PIXEL**2
        stands = (self.touching * (above / FOOT).square()).sum(-1).mean(-1)
        return -0.5 * (seen + stands + ((theta - middle) / sizes).square().sum(-1))


def turned(up: Tensor, tilt: Tensor) -> Tensor:
    """Computes the world's up (B, 3) in the axes of cameras that are turned about their x axis by tilt (B,)."""
    c, s, o = tilt.cos(), tilt.sin(), torch.zeros_like(tilt)
    about_x = torch.stack((o + 1, o, o, o, c, -s, o, s, c), -1).unflatten(-1, (3, 3))
    return about_x @ up


def view(fit: Motion, betas: Tensor, observation: Observation2D, camera: Camera, frames: Tensor) -> View:
    """Makes the view of one clip (T,) of a fit with shape (8,), its detections and its camera, in frames (F,)."""
    camera, positions, turns = camera.to(torch.float64), *(x[frames].double() for x in fit.world)
    shape = betas.double()

    def local(points: Tensor) -> Tensor:
        return points @ camera.rotation.mT + camera.translation

    rest = replace(STANDARD, offsets=offsets(shape)).rest_positions()[..., 1]
    feet, seen = STANDARD.indices(FEET), observation.confidence[frames].double()
    finite = observation.keypoints[frames].isfinite().all(-1)
    touching = fit.contacts[frames][:, [fit.skeleton.contact_names.index(name) for name in FEET]].double()
    return View(
        local(landmarks(positions, turns, shape)), local(positions[:, 0]), observation.keypoints[frames].double(),
        body_25_confidence(torch.where(finite, seen, 0.0)), camera, local(positions[:, feet]), touching,
        (rest - rest.amin() + STANDARD.sole)[feet], float(_stature(rest).log()),
    )  # fmt: skip


def _stature(rest: Tensor) -> Tensor:
    """From the lowest to the highest joint of a rest pose, heights (22,), over the standard skeleton's."""
    standard = STANDARD.rest_positions()[..., 1].to(rest)
    return (rest.amax() - rest.amin()) / (standard.amax() - standard.amin())


def true_numbers(seen: View, truth: Motion, camera: Camera, frames: Tensor) -> Tensor:
    """Computes what theta (5,) is in truth, the pose of the fit being what it is."""
    camera = camera.to(torch.float64)
    pelvis = truth.root[frames].double() @ camera.rotation.mT + camera.translation
    away = (pelvis[:, 2] / seen.pelvis[:, 2]).log().mean()
    rest = truth.skeleton.rest_positions().double().reshape(-1, len(STANDARD), 3)[0, :, 1]
    zoom = (camera.intrinsics[0, 0] / seen.camera.intrinsics[0, 0]).log()
    up, was = camera.rotation[:, 2], seen.camera.rotation[:, 2]
    tilt = torch.atan2(up[2], -up[1]) - torch.atan2(was[2], -was[1])
    rise = camera.centre[2] - seen.camera.centre[2]
    return torch.stack((_stature(rest).log() - seen.size, away, zoom, -tilt, rise))


def walked(
    seen: View, exact: Tensor, told: Mapping[int, float], generator: torch.Generator, *, many: int = 24, **how
) -> Chain:
    """Draws the five numbers by walkers that start about what is known; how: goes to ``walkers``."""
    middle, sizes = seen.before(told, exact)
    about = middle + 0.02 * torch.randn(many, len(NAMES), generator=generator, dtype=torch.float64)
    about[:, 1] += about[:, 0] + about[:, 2]  # nearly as large in the image
    return walkers(lambda x: seen.log_prob(x, middle, sizes), about, generator=generator, **how)


def asked(
    fit: Fitted, scene: Scene, frames: Tensor, generator: Callable[[str], torch.Generator], **how
) -> tuple[dict[str, list[tuple[Chain, Tensor]]], Tensor]:
    """Draws the five numbers of every clip under every knowledge: chains and true numbers; distances (C,), metres."""
    found, away = {name: [] for name in KNOWLEDGE}, []
    for k, camera in enumerate(scene.cameras):
        seen = view(fit.motion.clip(k), fit.betas[k], scene.clip(k), fit.cameras[k], frames)
        exact = true_numbers(seen, scene.truth.clip(k), camera, frames)
        away.append(seen.pelvis[:, 2].mean() * exact[1].exp())
        for name, told in KNOWLEDGE.items():
            found[name].append((walked(seen, exact, told, generator(f"{name} {k}"), **how), exact))
    return found, torch.stack(away)


def rows(found: Mapping[str, list[tuple[Chain, Tensor]]], away: Tensor) -> list[dict[str, object]]:
    """Makes a row per state of knowledge: how far off distance and stature may be, and how many clips hold the truth.

    found: chains and true numbers of the same clips, at distances (C,), metres.
    """
    table = []
    for name, clips in found.items():
        draws = [chain.draws() for chain, _ in clips]
        half = torch.stack([d.quantile(0.95, 0) - d.quantile(0.05, 0) for d in draws]) / 2
        ranks = torch.stack([(d < t).double().mean(0) for d, (_, t) in zip(draws, clips, strict=True)])
        inside = ((ranks > 0.05) & (ranks < 0.95)).sum(0).tolist()
        table.append({
            "told": name, "distance, half of the 90 %, cm": (100 * half[:, 1] * away).median().item(),
            "stature, cm": (170 * half[:, 0]).median().item(),
            "truth in the 90 %: distance": f"{inside[1]} of {len(clips)}", "stature": f"{inside[0]} of {len(clips)}",
        })  # fmt: skip
    return table
