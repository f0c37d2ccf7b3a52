"""Computes where a fit begins from what is visible: the root of stage 1, the first state and latents of stage 3.

Stage 1 begins (``testops.start_stage_1``) with the mean pose: laid onto visible joints (:func:`start_3d`), or put in
front of the camera by a search over orientations (:func:`start_2d`). Unseen frames: :func:`interpolate_unseen`.

Stage 3 begins with the motion of stage 2 (:func:`start_stage_3`). In lean mode z_t leads from where the roll-out *is*
to where stage 2 is next, as far as the prior allows,

    z_t = argmin 1/2 |x(x_t, z) - x*_{t+1}|^2_W + w/2 |(z - mu_t) / sigma_t|^2

by two Gauss-Newton steps from the posterior's mean. What one step misses the next makes up for, so that the start does
not drift away as that of the official code does (thesis 3.3.3, Fig. 3.10). W is in square metres: joints count as they
are, rotations with a lever of 0.3 m, velocities over one frame; what was not observed counts little.

Source: the official fitting code of HuMoR (Rempe et al. 2021), as described in its issues and read from its behaviour.
Differs: the official code starts every 3-D clip at identity, and a video at one orientation and one depth (from bones
counted as zero where they were not detected). Unseen frames stay there; here they are interpolated.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.baselines import interpolate
from motionlab.humor import state
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Cvae, Priors
from motionlab.humor.rollout import infer
from motionlab.humor.unknowns import Unknowns, of_first_state
from motionlab.motion import FPS, Motion
from motionlab.observation import BODY_25
from motionlab.skeleton import BALLS, STANDARD, UPRIGHT

#: The 24 bones of BODY_25.
_SIDED = (
    ("neck", "left_shoulder"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("mid_hip", "left_hip"),
    ("left_hip", "left_knee"), ("left_knee", "left_ankle"), ("left_ankle", "left_heel"), ("left_ankle", "left_big_toe"),
    ("left_big_toe", "left_small_toe"), ("nose", "left_eye"), ("left_eye", "left_ear"),
)  # fmt: skip
_OTHER_SIDE = ((a.replace("left", "right"), b.replace("left", "right")) for a, b in _SIDED)
_PAIRS = (("neck", "mid_hip"), ("neck", "nose"), *_SIDED, *_OTHER_SIDE)
_BONES = [tuple(map(BODY_25.index, pair)) for pair in _PAIRS]
#: An upright body that looks into the camera, whose axes are right, down and forward: the rotation vector (pi, 0, 0).
_FACING = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
#: The rigid part of the body, for the 3-D start: limbs count little, as they move.
_TORSO = STANDARD.indices(
    ["pelvis", "left_hip", "right_hip", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"]
)
_LIMB_WEIGHT = 0.02
_MIN_SPREAD = 0.02  # metres: the second principal spread below which visible points give no orientation
_STEP = 1e-2
#: Of the prior's weight while following: little, since a miss now is a miss in all frames to come.
DAMPING_ROLLOUT, DAMPING_SHOOTING = 0.02, 0.3
_LEG = ("hip", "knee", "ankle", "foot")
SITTING_LEGS = STANDARD.indices([f"{side}_{part}" for side in ("left", "right") for part in _LEG])
_SITTING = (math.radians(85), math.radians(25))  # of who sits: how far the legs bend, and each thigh points outwards
_LEVER = 0.3**2  # square metres per squared radian
#: The joint that tells most of a joint's rotation: its first child, or itself at the end of a limb.
_CHILD = [next((c for c, p in enumerate(STANDARD.parents) if p == j), j) for j in range(len(STANDARD))]


# ------------------------------------------------------------------------------------------------------- of stage 1
def start_3d(evidence: Evidence, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Computes root and orientation from visible joints: the mean pose, laid on by weighted Procrustes.

    rest (22, 3): joints of the mean pose, root at the origin, its orientation identity.

    Returns:
        trans (B, T, 3), orientation (B, T, 3, 3), and which frames (B, T) had enough to see.
    """
    share = torch.full((22,), _LIMB_WEIGHT).to(rest)
    share[_TORSO] = 1.0
    weight = evidence.weight * share
    total = weight.sum(-1).clamp(min=1e-6)[..., None]
    part = weight[..., None] / total[..., None]
    here, there = (part * rest).sum(-2), (part * evidence.values).sum(-2)
    x, y = rest - here[..., None, :], evidence.values - there[..., None, :]
    spread = torch.linalg.svdvals((part.sqrt() * x).double())[..., 1]
    enough = (weight > 0).sum(-1).ge(3) & spread.gt(_MIN_SPREAD)
    moment = torch.where(enough[..., None, None], y.mT @ (part * x), torch.eye(3).to(rest))
    turn = rotation.nearest(moment)
    return there - (turn @ here[..., None])[..., 0], turn, enough


def start_2d(evidence: Evidence, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Computes root and orientation from keypoints: orientations from a grid, the position in closed form for each.

    For an orientation the pinhole equations are linear in the position t: with q the turned landmark in the camera
    and (a, b) its pixel on the plane at depth one, t_x - a t_z = a q_z - q_x, t_y - b t_z = b q_z - q_y. Of 144
    orientations (16 headings; upright, leaning 50 degrees each way, lying each way) the sequence with the least
    reprojection error and turning is found over time (Viterbi): the person does not flip from frame to frame.

    rest (25, 3): landmarks of the mean pose, root at the origin, its orientation identity.

    Returns:
        trans (B, T, 3), orientation (B, T, 3, 3), and which frames (B, T) had enough to see, 4 keypoints.
    """
    poses, upright_cost = (each.to(rest) for each in _orientations())
    trans, cost = _place(evidence, poses, rest)  # (B, T, N, 3), (B, T, N)
    enough = (evidence.weight > 0).sum(-1) >= 4
    cost = torch.where(enough[..., None], cost + upright_cost, 0.0)
    path = _viterbi(cost, rotation.geodesic(poses[:, None], poses[None]).square())
    return trans.take_along_dim(path[..., None, None], 2)[:, :, 0], poses[path], enough


def interpolate_unseen(trans: Tensor, turn: Tensor, known: Tensor, fps: float) -> tuple[Tensor, Tensor]:
    """Computes root (B, T, 3) and orientation (B, T, 3, 3) interpolated where not ``known`` (B, T); ends hold.

    A clip of which nothing is known stands upright at the origin, its feet on the floor, and looks along +y.
    """
    none = ~known.any(-1)
    up, height = UPRIGHT.to(turn), STANDARD.standing_height().to(trans)
    trans = torch.where(none[:, None, None], torch.nn.functional.pad(height[None], (2, 0)), trans)
    turn = torch.where(none[:, None, None, None], up, turn)
    still = torch.eye(3).to(turn).expand(*turn.shape[:2], 21, 3, 3)
    motion = Motion(STANDARD, trans, torch.cat((turn[:, :, None], still), 2), fps)
    whole = interpolate(motion, known | none[:, None])
    return whole.root, whole.rot[:, :, 0]


def start_facing(evidence: Evidence, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Computes the official start of a video: root (B, T, 3) and orientation (B, T, 3, 3), the same in every frame.

    On the camera's axis at depth f * (mean bone in metres) / (mean bone in pixels), in the frame with the most
    detections; bones that were not detected count as 0 pixels, which puts a person half seen too far away.

    rest (25, 3): landmarks of the mean pose, metres.
    """
    view, frames = evidence.view, evidence.values.shape[1]
    most = (evidence.weight > 0).sum(-1).argmax(-1)
    rows = torch.arange(len(most))
    pixels, seen = evidence.values[rows, most], evidence.weight[rows, most] > 0
    a, b = torch.tensor(_BONES).mT
    length = torch.where(seen[:, a] & seen[:, b], (pixels[:, a] - pixels[:, b]).norm(dim=-1), 0.0).mean(-1)
    depth = view.intrinsics[:, 0, 0] * (rest[a] - rest[b]).norm(dim=-1).mean() / length.clamp(min=1.0)
    place = view.centre + depth[:, None] * view.rotation[:, 2]  # the camera looks along its third row
    turn = view.rotation.mT @ _FACING.to(rest)
    return place[:, None].repeat(1, frames, 1), turn[:, None].repeat(1, frames, 1, 1)


def _orientations() -> tuple[Tensor, Tensor]:
    """144 root orientations (144, 3, 3) in the world, and what each costs for not being upright."""
    ways = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0], [0, 0, -1.0]])
    lean = torch.cat((torch.zeros(1, 3), math.radians(50) * ways, math.radians(95) * ways))
    yaw = torch.arange(16) * (2 * math.pi / 16)
    turns = rotation.rotation_about("z", yaw)[:, None] @ UPRIGHT @ rotation.exp(lean)
    return turns.flatten(0, 1), torch.tensor([0.0, *(4 * [1.0]), *(4 * [1.5])]).repeat(16) * 0.02


def _place(evidence: Evidence, poses: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Best world positions (B, T, N, 3) of N orientations, and their robust reprojection errors (B, T, N). Errors are
    in units of the person's apparent size, weighted by confidence."""
    view = evidence.view
    k = view.intrinsics[:, None, None]
    plane = (evidence.values - k[..., :2, 2]) / torch.stack((k[..., 0, 0], k[..., 1, 1]), -1)  # (B, T, K, 2)
    weight = evidence.weight.square()
    q = torch.einsum("bij,njk,lk->bnli", view.rotation, poses, rest)  # (B, N, K, 3), camera axes
    a, b = plane[:, :, None].unbind(-1)
    w = weight[:, :, None]
    o = torch.zeros_like(a)
    rows = torch.stack((torch.stack((o + 1, o, -a), -1), torch.stack((o, o + 1, -b), -1)), -2)  # (B, T, 1, K, 2, 3)
    right = torch.stack((a * q[:, None, ..., 2] - q[:, None, ..., 0], b * q[:, None, ..., 2] - q[:, None, ..., 1]), -1)
    normal = torch.einsum("btnk,btnkri,btnkrj->btnij", w, rows, rows) + 1e-6 * torch.eye(3).to(rest)
    moment = torch.einsum("btnk,btnkri,btpkr->btpi", w, rows, right)
    local = torch.linalg.solve(normal, moment[..., None])[..., 0]
    depth = local[..., 2].clamp(0.5, 50.0)
    # where the depth is not sensible, the other two follow from a sensible one
    local = torch.cat((local[..., :2] * (depth / local[..., 2].clamp(min=0.5))[..., None], depth[..., None]), -1)
    seen = q[:, None] + local[..., None, :]
    error = (seen[..., :2] / seen[..., 2:].clamp(min=0.1) - plane[:, :, None]) * depth[..., None, None]  # metres
    cost = (w * (error.square().sum(-1) / (0.04 + error.square().sum(-1)))).sum(-1) / w.sum(-1).clamp(min=1e-6)
    world = torch.einsum("bji,btnj->btni", view.rotation, local) + view.centre[:, None, None]
    return world, cost


def _viterbi(cost: Tensor, change: Tensor, weight: float = 0.3) -> Tensor:
    """The cheapest path (B, T) through costs (B, T, N), with ``weight`` times ``change`` (N, N) for every step."""
    total, back = cost[:, 0], []
    for now in cost.unbind(1)[1:]:
        best, origin = (total[:, :, None] + weight * change).min(1)
        total, back = best + now, [*back, origin]
    path = [total.argmin(-1)]
    for origin in reversed(back):
        path.append(origin.gather(1, path[-1][:, None])[:, 0])
    return torch.stack(path[::-1], 1)


# ------------------------------------------------------------------------------------------------------- of stage 3
def above_floor(joints: Tensor) -> Tensor:
    """Computes how high the lower foot of joints (..., T, 22, 3) is above the floor, median over frames: (...)."""
    return joints[..., STANDARD.indices(BALLS), 2].amin(-1).median(-1).values - STANDARD.sole


def seated(motion: Motion) -> Motion:
    """Returns motions (B, T) with the legs of somebody who sits: thighs level and apart, shins upright."""
    rot = motion.rot.clone()
    yaw = rotation.yaw(rot[:, :, 0])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        hip, *below = STANDARD.indices([f"{side}_{part}" for part in _LEG])
        bend = rotation.rotation_about("x", torch.tensor(_SITTING[0]).to(rot))
        thigh = rotation.rotation_about("z", yaw + sign * _SITTING[1]) @ UPRIGHT.to(rot) @ bend.mT
        rot[:, :, hip] = rot[:, :, 0].mT @ thigh
        rot[:, :, below] = torch.stack((bend, *2 * [torch.eye(3).to(rot)]))
    return replace(motion, rot=rot)


def start_stage_3(
    motion: Motion, latent: Tensor, shared: dict[str, Tensor], confidence: Tensor, priors: Priors, mode: str = "lean",
    weight: float = 1e-3, damping: float = DAMPING_ROLLOUT,
) -> tuple[Unknowns, Tensor | None]:  # fmt: skip
    """Computes the unknowns of stage 3 from stage 2's motion; in lean mode also factors of z.

    Factors (B, T - 1, 48, 48) make the energy round in the coordinates z = z_0 + factor u: L^-T of
    (T - t) H_t + w diag(1 / sigma^2) = L L^T, with H_t the Gauss-Newton matrix of one way, as what z_t does to the
    frame after it stays done in all that follow.

    Args:
        motion (B, T): of stage 2. latent (B, T, 32): its pose latents. shared: its betas, camera.
        confidence (B, T, 22): how much each joint of it is to be believed, 0 to 1; used in lean mode.
        weight: of the motion prior beside a square metre, w. damping: share on the way.
    """
    states = state.from_motion(motion, causal=priors.motion.causal)
    with torch.no_grad():
        if mode == "lean":
            z, curvature, sharp = _follow(priors.motion, states, confidence, damping * weight)
            factors = _factors(curvature, sharp, weight)
        else:
            z, factors = infer(priors.motion, states)[0].mean, None
    return of_first_state(states[:, 0], latent[:, 0], mode, z=z, **shared), factors


def _follow(model: Cvae, states: Tensor, confidence: Tensor, weight: float) -> tuple[Tensor, Tensor, Tensor]:
    """z (B, T - 1, 48) of a roll-out from the first of states (B, T, 339) that is steered to follow them, the
    Gauss-Newton matrices (B, T - 1, 48, 48) of the ways, and the prior's 1 / sigma^2 (B, T - 1, 48).

    confidence (B, T, 22): of each joint of stage 2; where it is 0, z is the prior's mean. weight: w above."""
    now, found, curvature, precision = states[:, 0], [], [], []
    for aim, share in zip(states[:, 1:].unbind(1), confidence[:, 1:].unbind(1), strict=True):
        frame = state.heading(now)
        past, aim = state.localise(now, frame), state.localise(aim, frame)
        prior, z = model.prior(past), model.posterior(past, aim).mean
        sharp = (-prior.log_var).exp().clamp(max=1e4)
        root = _importance(share).sqrt()
        for _ in range(2):
            miss, slope = _linearised(model, past, z, aim, root)
            gauss_newton = slope @ slope.mT
            pull = (slope @ miss[..., None])[..., 0] + weight * sharp * (z - prior.mean)
            z = z - torch.linalg.solve(gauss_newton + torch.diag_embed(weight * sharp + 1e-6), pull)
        now = state.globalise(state.apply(past, model.decode(past, z))[0], frame)
        found.append(z), curvature.append(gauss_newton), precision.append(sharp)
    return tuple(torch.stack(each, 1) for each in (found, curvature, precision))


def _factors(curvature: Tensor, sharp: Tensor, weight: float) -> Tensor:
    left = torch.arange(curvature.shape[1], 0, -1).to(sharp)
    whole = left[:, None, None] * curvature + torch.diag_embed(weight * sharp + 1e-6)
    factor = torch.linalg.cholesky(whole.double())
    return torch.linalg.solve_triangular(factor.mT, torch.eye(whole.shape[-1]).to(factor), upper=True).to(sharp)


def _linearised(model: Cvae, past: Tensor, z: Tensor, aim: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted miss (B, 339) of the next state, and its derivative (B, 48, 339) in z by finite differences."""
    size = z.shape[-1]
    around = torch.cat((torch.zeros(1, size), _STEP * torch.eye(size))).to(z) + z[:, None]
    past = past[:, None].expand(-1, size + 1, -1)
    after, _ = state.apply(past, model.decode(past, around))
    return root * (after[:, 0] - aim), root[:, None] * (after[:, 1:] - after[:, :1]) / _STEP


def _importance(confidence: Tensor) -> Tensor:
    """W (B, 339) from how much each joint (B, 22) is believed."""
    whole, child = confidence.mean(-1, keepdim=True), confidence[:, _CHILD[1:]]
    parts = {
        "trans": whole, "trans_vel": whole / FPS**2, "root_orient": _LEVER * whole, "pose_body": _LEVER * child,
        "root_orient_vel": _LEVER * whole / FPS**2, "joints": confidence, "joints_vel": confidence / FPS**2,
    }  # fmt: skip
    sizes = {name: torch.Size(shape).numel() // parts[name].shape[1] for name, shape in state.SHAPES.items()}
    return torch.cat([parts[name].repeat_interleave(size, 1) for name, size in sizes.items()], 1)
