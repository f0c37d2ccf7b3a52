"""Completes a whole pose from a few of its joints, the handles, by diffusion of single poses (windows: ``inpainting``).

Three ways. ``keep``: the thesis's baseline, inpainting (Eq. 4.10) with rotations kept. ``complete`` with ``guidance``:
every estimate of x_0 is pulled to where its handles are at their targets (reconstruction guidance, Ho et al. 2022,
through forward kinematics). ``complete`` of a model that takes handles: thesis 4.2.4, "handle conditioning".
Behind any of them a few steps of inverse kinematics bring the handles home (``planting.reach_targets``).

Targets and poses are in the pose's own stuck frame (see ``masks``).
Source: thesis 4.2.4. Differs: the finish by inverse kinematics; handles are given by the places they should have.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.diffusion.features import Layout
from motionlab.diffusion.inpainting import Way, repair
from motionlab.diffusion.masks import told, units
from motionlab.diffusion.model import Trained
from motionlab.diffusion.planting import reach_targets
from motionlab.diffusion.sampling import DenoiseFunction, ddim
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

_STEPS = 50  # of the sampler
_FINISH = 20  # steps of inverse kinematics, at most
_ROUNDS = 64  # of a start's descent towards its handles, shared out over the steps of the sampler
_LEAST = 8  # of them in every step


def complete(
    model: Trained,
    targets: Tensor,
    which: Tensor,
    generator: torch.Generator,
    *,
    steps: int = _STEPS,
    finish: bool = True,
    guidance: float = 0.0,
) -> Motion:
    """Computes poses (B, 1) on the standard body whose handles are at their targets, or near them without ``finish``.

    A model that takes no handles, without guidance, makes poses that ignore them.

    Args:
        model: of single poses. targets: (B, 22, 3) metres; those of free joints are not read. which: bool (B, 22),
            the handles. steps: of DDIM. guidance: weight of the pull, in squared units of x per square metre.

    Raises:
        DataError: a model of longer motions, or a target that is not finite. ShapeError: other shapes.
    """
    _check(model, targets, which)
    targets = torch.where(which[..., None], targets, 0.0)
    denoise: DenoiseFunction = model.denoiser
    if model.recipe.handles:
        heard = {"handles": told(targets, which)[:, None]}
        if model.recipe.linear:
            heard["rounds"] = max(_LEAST, _ROUNDS // steps)
        denoise = lambda x, stamps: model.denoiser(x, stamps, **heard)  # noqa: E731
    if guidance:
        denoise = _pulled(denoise, model, targets, which, guidance)
    schedule = model.schedule.respaced(min(steps, len(model.schedule)))
    made = model.decode(ddim(denoise, schedule, model.noise(len(targets), generator)))
    return finished(made, targets, which) if finish else made


def _pulled(denoise: DenoiseFunction, model: Trained, targets: Tensor, which: Tensor, weight: float) -> DenoiseFunction:
    """The x_0 estimate less weight sqrt(alpha_bar) / 2 times the gradient in x_t of the handles' squared distances from
    their targets, after forward kinematics of the estimate."""
    level = dict(zip(model.schedule.stamps.tolist(), model.schedule.alpha_bar.tolist(), strict=True))

    def better(x: Tensor, stamps: Tensor) -> Tensor:
        with torch.enable_grad():
            at = x.detach().requires_grad_()
            x0 = denoise(at, stamps)
            far = (model.decode(x0).positions[:, 0] - targets).square().sum(-1)
            (slope,) = torch.autograd.grad((far * which).sum(), at)
        a = x.new_tensor([level[int(t)] for t in stamps])[:, None, None]
        return x0.detach() - weight * a.sqrt() / 2 * slope

    return better


def finished(motion: Motion, targets: Tensor, which: Tensor, steps: int = _FINISH) -> Motion:
    """Computes poses (B, 1) with their handles brought to the targets (B, 22, 3) by inverse kinematics."""
    goal = torch.where(which[..., None], targets, torch.nan)
    return reach_targets(motion, motion.skeleton.names, goal[:, None], steps=steps)


def keep(
    model: Trained,
    motion: Motion,
    which: Tensor,
    generator: torch.Generator,
    *,
    chains: bool = True,
    steps: int = _STEPS,
) -> Motion:
    """Computes poses (B, 1) by inpainting (Eq. 4.10): ``_kept_numbers`` of given poses stay, the rest is sampled."""
    _check(model, motion.positions[:, 0], which)
    return repair(model, motion, _kept_numbers(model.layout, which, chains), generator, Way(steps=steps))


def _kept_numbers(layout: Layout, which: Tensor, chains: bool = True) -> Tensor:
    """Which numbers (B, 1, D) are known for handles (B, 22): the rotations of the handles, and with ``chains`` those of
    all joints above them up to the pelvis; its height only where the pelvis is a handle.

    With chains the handles then stand to each other as they should, and are off by the pelvis's height alone.
    """
    joints = which.clone()
    if chains:
        for joint in range(len(STANDARD) - 1, 0, -1):
            joints[:, STANDARD.parents[joint]] |= joints[:, joint]
    root, contacts = which[:, :1], torch.zeros_like(which[:, :1])
    return torch.cat((joints, root, contacts), -1)[:, None, units(layout)]


def _check(model: Trained, targets: Tensor, which: Tensor) -> None:
    if model.recipe.frames != 1:
        remedy = 'take trained.motion_model("diffusion_handles") or "diffusion_pose"'
        raise DataError(f"a model of {model.recipe.frames} frames", place="completion", remedy=remedy)
    check_shape(targets, f"B {len(STANDARD)} 3", "targets")
    if which.shape != targets.shape[:-1] or which.dtype != torch.bool:
        raise ShapeError(f"which: expected bool {tuple(targets.shape[:-1])}, got {which.dtype} {tuple(which.shape)}")
    if not torch.where(which[..., None], targets, 0.0).isfinite().all():
        raise DataError("a target is not finite", place="targets", remedy="let that joint be free")
