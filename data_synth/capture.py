"""From a motion to what a 2-D detector would say of it: keypoints, line of sight, noise and honest confidence.

Truth never reaches a fitter: :func:`observe` keeps what only a judge may see apart, in a ``Truth``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.linalg import solve_banded
from torch import Tensor

from data_synth.body import tree_distance
from data_synth.occluders import Occluder
from data_synth.score import uniform
from data_synth.sight import gap_to, shell
from motionlab.body import BodyModel, lbs
from motionlab.errors import NotConverged
from motionlab.motion import Motion, velocity
from motionlab.observation import BODY_25, Camera, Observation2D, look_at, project

#: The joint of the 22 that each keypoint shows; the other eleven are vertices of the body.
#: Source: the mapping that HuMoR and SMPLify use. Differs: OpenPose's own neck lies midway between the shoulders.
JOINTS = {name: name for name in BODY_25 if name.endswith(("shoulder", "elbow", "wrist", "hip", "knee", "ankle"))}
JOINTS |= {"neck": "neck", "mid_hip": "pelvis"}
#: Spread of human annotators by keypoint, as a share of the person's size: how hard a keypoint is to place.
#: Source: COCO keypoint evaluation (17 keypoints), COCO-WholeBody (feet); neck and mid hip as shoulder and hip.
DIFFICULTY = {
    "nose": 0.026, "eye": 0.025, "ear": 0.035, "shoulder": 0.079, "elbow": 0.072, "wrist": 0.062, "hip": 0.107,
    "knee": 0.087, "ankle": 0.089, "big_toe": 0.068, "small_toe": 0.066, "heel": 0.066, "neck": 0.079,
    "mid_hip": 0.107,
}  # fmt: skip
SIZE = 0.7  # metres: square root of the image area of a standing adult, COCO's measure of size
SKILL = 0.25  # of an annotator's spread: so far does the detector miss a clear, resting keypoint
SHUTTER = 0.5  # share of a frame's time that the shutter is open
_IMAGE = (1280, 720)  # pixels of a drawn camera
NEAR = 0.03  # metres at the person's depth: an error below this counts as a hit, and confidence is its probability


@dataclass(frozen=True, eq=False)
class Truth:
    """What only a judge may see. T frames, 25 keypoints of BODY_25.

    pixels (T, 25, 2): their true image. visible (T, 25): in the image, with nothing in between. clear (T, 25): share of
    the keypoint's surroundings that no occluder covers. sigma (T, 25): pixels, the noise per coordinate that was drawn.
    near (T,): pixels that NEAR is long.
    """

    pixels: Tensor
    visible: Tensor
    clear: Tensor
    sigma: Tensor
    near: Tensor


def keypoints(motion: Motion, body: BodyModel) -> Tensor:
    """The 25 keypoints (..., T, 25, 3) in metres, world: joints by FK, nose to heels by skinning their vertices."""
    surface = [name for name in BODY_25 if name not in JOINTS]
    vertices = [body.keypoint_vertices[name] for name in surface]
    skin = lbs(body, motion.skeleton, motion.root, motion.rot, vertices=vertices)
    joints = motion.positions[..., motion.skeleton.indices(list(JOINTS.values())), :]
    order = [*surface, *JOINTS]
    return torch.cat((skin, joints), dim=-2)[..., [order.index(name) for name in BODY_25], :]


def observe(
    motion: Motion, body: BodyModel, camera: Camera, generator: torch.Generator, occluders: Sequence[Occluder] = (), *,
    correlation: float = 0.5,
) -> tuple[Observation2D, Truth]:  # fmt: skip
    """What a detector sees of one clip, and apart from it the truth behind it.

    The error of each coordinate is Gaussian with

        sigma^2 = (SKILL DIFFICULTY_k SIZE f/z e^(0.3 n) h)^2 + (SHUTTER v)^2 / 12 + 0.3^2

    in pixels: f/z pixels per metre at the person's depth, n ~ N(0, 1) per frame and keypoint (images
    differ), h = 1 + 2 (1 - clear), and 2.5 times that behind the person's own body, v pixels per frame
    (motion blur: a streak of length L spreads L / sqrt(12)). Errors follow an AR(1) process in time.

        confidence = P(error < NEAR f/z) = 1 - exp(-(NEAR f/z)^2 / (2 sigma^2))

    so it is calibrated by construction: of the keypoints with confidence c a share c is that near.
    Undetected (confidence 0, pixel (0, 0)): out of the image, wholly covered by occluders, covered in part
    or by the own body and unlucky (it is found with probability ``clear`` and 0.7), or confidence < 0.05.

    occluders: they block the view. correlation: of the error from one frame to the next.
    """
    points = keypoints(motion, body)
    pixels, depth = project(camera, points)
    size = pixels.new_tensor([camera.width, camera.height])
    inside = (depth > 0.05) & ((pixels >= 0) & (pixels < size)).all(-1)
    focal = camera.intrinsics[0, 0].to(points)
    scale = focal / depth.mean(-1, keepdim=True).clamp(min=0.1)  # (T, 1) pixels per metre

    clear, centre_free = _clear(points, camera, occluders)
    self_hidden = _self_hidden(motion, body, points, camera)

    hard = points.new_tensor([DIFFICULTY[name.removeprefix("left_").removeprefix("right_")] for name in BODY_25])
    hindrance = (1 + 2 * (1 - clear)) * torch.where(self_hidden, 2.5, 1.0)
    luck = (0.3 * torch.randn(clear.shape, generator=generator)).exp()
    blur = SHUTTER * velocity(pixels, 1.0, dim=0).norm(dim=-1)
    spread = SKILL * SIZE * hard * scale * hindrance * luck
    sigma = (spread**2 + blur**2 / 12 + 0.3**2).sqrt()
    near = NEAR * scale
    confidence = 1 - torch.exp(-(near**2) / (2 * sigma**2))

    error = sigma[..., None] * _steady_noise(pixels.shape, correlation, generator)
    chance = torch.where(self_hidden, 0.7, 1.0) * clear
    found = torch.rand(clear.shape, generator=generator) < chance
    detected = inside & found & (confidence >= 0.05)
    seen = torch.where(detected[..., None], pixels + error, 0.0)
    observation = Observation2D(seen, torch.where(detected, confidence, 0.0), BODY_25, motion.fps, camera, motion.name)
    visible = inside & centre_free & ~self_hidden
    return observation, Truth(pixels, visible, clear, sigma, near[:, 0])


def frame_motion(
    motion: Motion, generator: torch.Generator, *, around: float = 180.0, by: float = 180.0,
    stand: tuple[float, float] = (0.8, 2.2),
) -> Camera:  # fmt: skip
    """A plausible camera that keeps the person in view for the whole motion, from a random side.

    Drawn: the direction in which it stands, ``by`` degrees to both sides of ``around`` about the world's z from +x; its
    height from ``stand`` metres; its horizontal angle of view from 35 to 60 degrees. It looks at the middle of the
    motion from as near as keeps 25 cm around every joint in the image.

    Raises:
        NotConverged: no distance up to 200 m shows the whole motion.
    """
    side, eye_height, angle = (uniform(generator, *ends) for ends in ((around - by, around + by), stand, (35.0, 60.0)))
    width, height = _IMAGE
    focal = width / 2 / math.tan(math.radians(angle) / 2)
    joints = motion.positions.reshape(-1, 3)
    low, high = joints.amin(0), joints.amax(0)
    target = (low + high) / 2
    toward = torch.tensor([math.cos(math.radians(side)), math.sin(math.radians(side)), 0.0]).to(joints)
    cloud = (joints[:, None] + torch.cartesian_prod(*3 * [joints.new_tensor([-0.25, 0.25])])).reshape(-1, 3)
    for distance in torch.logspace(0.0, 2.3, 120).tolist():
        eye = target + distance * toward
        eye[2] = eye_height
        camera = look_at(eye, target, focal=focal, width=width, height=height)
        pixels, depth = project(camera, cloud)
        if (depth > 0.3).all() and ((pixels > 0) & (pixels < pixels.new_tensor([width, height]))).all():
            return camera
    raise NotConverged("no distance up to 200 m shows the whole motion")


def _clear(points: Tensor, camera: Camera, occluders: Sequence[Occluder]) -> tuple[Tensor, Tensor]:
    """Share (T, 25) of nine sight lines to and around each point that pass all occluders; whether its own does."""
    right, down = camera.rotation[:2].to(points)
    turns = torch.arange(8) * (torch.pi / 4)
    ring = 0.04 * (turns.cos()[:, None] * right + turns.sin()[:, None] * down)
    probes = points[:, :, None] + torch.cat((torch.zeros(1, 3).to(points), ring))  # (T, 25, 9, 3)
    free = torch.ones(probes.shape[:-1], dtype=torch.bool)
    for occluder in occluders:
        gap, _ = gap_to(occluder.vertices, occluder.faces, camera.centre.to(points), probes.reshape(1, -1, 3))
        free &= (gap <= 0).reshape(free.shape)
    return free.float().mean(-1).to(points), free[..., 0]


def _self_hidden(motion: Motion, body: BodyModel, points: Tensor, camera: Camera) -> Tensor:
    """Whether (T, 25) the person's own body covers a keypoint.

    A joint lies inside the flesh. It is covered when the sight line enters the body more than 5 cm before
    it, unless it enters the flesh of a joint at most two bones away less than 20 cm before it. A keypoint on
    the skin may lie 2 cm behind the entry.
    """
    hull = shell(body)
    vertices = lbs(body, motion.skeleton, motion.root, motion.rot, vertices=hull.vertices)
    gap, face = gap_to(vertices, hull.faces, camera.centre.to(points), points)
    is_joint = torch.tensor([name in JOINTS for name in BODY_25])
    joint = torch.tensor([motion.skeleton.index(JOINTS.get(name, "pelvis")) for name in BODY_25])
    own = is_joint & (tree_distance(motion.skeleton)[joint, hull.carrier[face]] <= 2)
    allowed = torch.where(own, 0.2, torch.where(is_joint, 0.05, 0.02))
    return gap > allowed


def _steady_noise(shape: Sequence[int], correlation: float, generator: torch.Generator) -> Tensor:
    """Unit Gaussian noise (T, ...) with the given correlation between neighbouring frames."""
    drawn = torch.randn(shape, generator=generator)
    fresh = (1 - correlation**2) ** 0.5
    drawn[0] /= fresh  # the first frame starts in the steady state
    recurrence = torch.tensor([[1.0], [-correlation]]).repeat(1, len(drawn))  # each frame less the share of the last
    whole = solve_banded((1, 0), recurrence.numpy(), fresh * drawn.flatten(1).numpy())
    return torch.from_numpy(whole).to(drawn).reshape(drawn.shape)
