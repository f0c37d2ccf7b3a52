"""From the official closure of stage 3 to the lean one, a saving at a time; the energy is the same on every rung.

Each saving can be switched on alone. With none, the closure is the official one, ``OFFICIAL``: rotations are vectors
and are turned into matrices and back between any two parts, joints come from a full mesh, and a closure evaluates that
mesh five times, three of them for one frame. With all of them, it is that of ``humor.unknowns``, which every fit uses
by default.

Source: thesis 3.2.4 (what is slow); the official HuMoR fitting code (Rempe et al. 2021), as measured: 5 body
evaluations per closure of stage 3. The savings are ours.
Differs: the official code asks for the first frame's joints three times, in two frames of reference. The world is
fixed here, so that one answer serves, and the other two are paid for and dropped (without their share of the backward
pass). It evaluates the sequence in the world's frame and in the camera's; here twice in the world's.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from functools import partial

import torch
from torch import Tensor

from motionlab.heading import heading_frame
from motionlab.humor import rollout, stages, state
from motionlab.humor.body_shape import landmarks
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Cvae, Gaussian, Priors
from motionlab.humor.stages import Problem
from motionlab.humor.unknowns import Posed, Rolled, Unknowns, skeleton_of, to_matrix
from motionlab.skeleton import fk
from studies.official import rollout as official_rollout
from studies.official.body import body_joints_by_lbs, first_joints_by_lbs
from studies.official.rotation import alignment, matrix_to_axis_angle, pose_from_axis_angle

FIRST_FRAME_CALLS = 3
#: A stopwatch around each part of a closure: "first state", "chain", "body", "terms", "backward".
Mark = Callable[[str], AbstractContextManager]


@dataclass(frozen=True)
class Savings:
    """What a closure of stage 3 leaves out.

    frozen: gradients of the networks' weights. prior_after: the prior inside the chain; it is evaluated once for all
    steps. joints_only: the mesh; forward kinematics is enough. needed_frames: bodies that nobody looks at: one frame as
    a whole clip three times over, the sequence twice and filled up to the whole clip. matrices: rotation vectors
    between any two parts. exact_heading: the heading by acos. lean_layout: the state as a dict of parts, and autograd's
    record of every small operation: the derivative of the chain is written out.
    """

    frozen: bool = False
    prior_after: bool = False
    joints_only: bool = False
    needed_frames: bool = False
    matrices: bool = False
    exact_heading: bool = False
    lean_layout: bool = False


FAITHFUL = Savings()
LEAN = Savings(**{field.name: True for field in fields(Savings)})
FORMS = {"faithful": FAITHFUL, "lean": LEAN}
#: A name for what each saving does, in the order of the ladder.
NAMES = {
    "frozen": "weights frozen", "prior_after": "prior out of the loop", "joints_only": "joints, no mesh",
    "needed_frames": "needed frames only", "matrices": "matrices throughout", "exact_heading": "exact 2-D heading",
    "lean_layout": "lean layout, own derivative",
}  # fmt: skip


def rungs() -> Iterator[tuple[str, Savings]]:
    """("as shipped", none), ("weights frozen", the first), ... up to all, one more on each."""
    on = FAITHFUL
    yield "as shipped", on
    for field, name in NAMES.items():
        on = replace(on, **{field: True})
        yield name, on


@contextmanager
def weights_of(priors: Priors, on: Savings) -> Iterator[None]:
    """While it lasts the networks' weights need gradients unless that is saved; afterwards they are as they were, and
    the gradients are gone."""
    weights = [weight for model in (priors.motion, priors.pose) for weight in model.parameters()]
    before = [weight.requires_grad for weight in weights]
    try:
        for weight in weights:
            weight.requires_grad_(not on.frozen)
        yield
    finally:
        for weight, needed in zip(weights, before, strict=True):
            weight.requires_grad_(needed).grad = None


@contextmanager
def gradients(problem: Problem, unknown: Unknowns, on: Savings) -> Iterator[None]:
    """Clears the gradients of the unknowns; while it lasts, the networks' weights need some too unless frozen."""
    for value in unknown.named().values():
        value.grad = None
    with weights_of(problem.priors, on):
        yield


def exact_alignment(orientation: Tensor) -> Tensor:
    """The yaw rotation (B, 3, 3) of ``heading.heading_frame``."""
    return heading_frame(orientation[..., 0], orientation).turn


def chain(model: Cvae, first: Tensor, z: Tensor, on: Savings) -> rollout.Rollout:
    """The roll-out from first states (B, 339), world, by latents (B, T, 48), with the prior of each."""
    if on.lean_layout:
        found = rollout.rollout(model, first, z, with_prior=on.prior_after)
        if on.prior_after:
            return found
        past = torch.cat((first[:, None], found.states[:, :-1]), 1)
        each = [model.prior(x) for x in state.localise(past, state.heading(past)).unbind(1)]
        return found._replace(prior=Gaussian(*(torch.stack(column, 1) for column in zip(*each, strict=True))))
    align = exact_alignment if on.exact_heading else alignment
    return official_rollout.rollout(model, first, z, align=align, prior_inside=not on.prior_after)


@dataclass(frozen=True, eq=False)
class _Body:
    """Poses in the closure's own form: matrices (..., 22, 3, 3), or rotation vectors (..., 22, 3)."""

    on: Savings
    betas: Tensor
    frames: int  #: of the whole clip: what the official body layer is made for

    def form(self, rot: Tensor) -> Tensor:
        return rot if self.on.matrices else matrix_to_axis_angle(rot)

    def rot(self, pose: Tensor) -> Tensor:
        return pose if self.on.matrices else pose_from_axis_angle(pose)

    def vectors(self, pose: Tensor) -> Tensor:
        return matrix_to_axis_angle(pose) if self.on.matrices else pose

    def sequence(self, trans: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Joints (B, T, 22, 3) and landmarks (B, T, 25, 3)."""
        steps, missing = trans.shape[1], self.frames - trans.shape[1]
        if missing and not self.on.needed_frames:
            filled = (torch.cat((x, x[:, -1:].expand(-1, missing, *x.shape[2:])), 1) for x in (trans, pose))
            joints, marks = self.sequence(*filled)
            return joints[:, :steps], marks[:, :steps]
        if not self.on.joints_only:
            return body_joints_by_lbs(trans, self.vectors(pose), self.betas)
        joints, turns = fk(skeleton_of(self.betas), trans, self.rot(pose))
        return joints, landmarks(joints, turns, self.betas)

    def first(self, trans: Tensor, pose: Tensor) -> Tensor:
        """Joints (B, 22, 3) of one frame, in one batch of as many frames as the sequence has unless that is saved."""
        if self.on.needed_frames:
            return self.sequence(trans[:, None], pose[:, None])[0][:, 0]
        if not self.on.joints_only:
            return first_joints_by_lbs(trans, self.vectors(pose), self.betas, self.frames)
        trans, pose = (x[:, None].expand(-1, self.frames, *x.shape[1:]) for x in (trans, pose))
        return self.sequence(trans, pose)[0][:, 0]


def first_state(unknown: Unknowns, priors: Priors, body: _Body) -> Tensor:
    """x0 (B, 339), world. orient: 6 numbers or a rotation vector."""
    trans, orient = unknown.trans, unknown.orient
    decoded = body.form(priors.pose.decode(unknown.latent))
    if body.on.matrices:
        root = to_matrix(orient)
    else:
        root = orient if orient.shape[-1] == 3 else matrix_to_axis_angle(to_matrix(orient))
    pose = torch.cat((root[:, None], decoded), 1)
    for _ in range(1 if body.on.needed_frames else FIRST_FRAME_CALLS):
        joints = body.first(trans, pose)
    rot = body.rot(pose)
    parts = {"trans": trans, "root_orient": rot[:, 0], "pose_body": rot[:, 1:], "joints": joints}
    speeds = {"trans_vel": unknown.trans_vel, "root_orient_vel": unknown.root_orient_vel}
    return state.pack(parts | speeds | {"joints_vel": unknown.joints_vel.unflatten(-1, (22, 3))})


def body_of(unknown: Unknowns, evidence: Evidence, on: Savings) -> _Body:
    """The body that a closure asks, as :func:`first_state` takes it. The evidence is that of the whole clip."""
    return _Body(on, unknown.betas, max(evidence.values.shape[1], unknown.z.shape[1] + 1))


def roll_out(unknown: Unknowns, priors: Priors, first: Tensor, body: _Body) -> tuple[Tensor, rollout.Rollout, Tensor]:
    """From the first state: states (B, T, 339), the roll-out, and poses in the body's own form."""
    rolled = chain(priors.motion, first, unknown.z, body.on)
    states = torch.cat((first[:, None], rolled.states), 1)
    parts = state.unpack(states)
    return states, rolled, body.form(torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3))


def posed(unknown: Unknowns, evidence: Evidence, states: Tensor, pose: Tensor, body: _Body) -> Posed:
    """Joints and landmarks of all frames, and where the camera sees them."""
    trans, camera = states[..., state.SLICES["trans"]], unknown.camera
    joints, marks = body.sequence(trans, pose)
    if not body.on.needed_frames:
        marks = body.sequence(trans, pose)[1]
    seen = joints if evidence.view is None else evidence.view.pixels(marks, camera)
    return Posed(trans, body.rot(pose), joints, seen, body.betas, camera)


def roll(unknown: Unknowns, priors: Priors, evidence: Evidence, on: Savings, mark: Mark = nullcontext) -> Rolled:
    """Stage 3's motion, as ``unknowns.roll``; its parts are marked. The evidence is that of the whole clip."""
    body = body_of(unknown, evidence, on)
    with mark("first state"):
        first = first_state(unknown, priors, body)
    with mark("chain"):
        states, rolled, pose = roll_out(unknown, priors, first, body)
    with mark("body"):
        return Rolled(states, rolled, posed(unknown, evidence, states, pose, body))


def official_pose(unknown: Unknowns, priors: Priors, evidence: Evidence) -> Posed:
    """Stages 1 and 2 at the official price, arguments as ``unknowns.pose``; orient (B, T, 3)."""
    body = matrix_to_axis_angle(priors.pose.decode(unknown.latent))
    pose = torch.cat((unknown.orient[..., None, :], body), -2)
    joints, marks = body_joints_by_lbs(unknown.trans, pose, unknown.betas)
    seen = joints if evidence.view is None else evidence.view.pixels(marks, unknown.camera)
    return Posed(unknown.trans, pose_from_axis_angle(pose), joints, seen, unknown.betas, unknown.camera)


#: Fields of a ``Problem`` in official mode: what the official code does, at its price.
OFFICIAL = {"mode": "official", "pose": official_pose, "roll": partial(roll, on=FAITHFUL)}


def terms(
    problem: Problem, unknown: Unknowns, on: Savings, *, mark: Mark = nullcontext, **how: bool
) -> dict[str, Tensor]:
    """Stage 3's weighted terms (G,); how: grown, contacts, as of ``stages.motion_terms``."""
    with weights_of(problem.priors, on):
        rolled = roll(unknown, problem.priors, problem.evidence, on, mark)
        with mark("terms"):
            return stages.rolled_terms(problem, rolled, **how)


def closure(problem: Problem, unknown: Unknowns, on: Savings, *, mark: Mark = nullcontext, **how) -> Tensor:
    """What an optimiser pays for: the energy (G,), detached, and all gradients, left in ``.grad``.

    Gradients of the weights, where there are any, are made and dropped; official fits, which never clear them, pay for
    their sum, too.
    """
    with gradients(problem, unknown, on):
        value = sum(terms(problem, unknown, on, mark=mark, **how).values())
        with mark("backward"):
            value.sum().backward()
    return value.detach()


def chain_alone(problem: Problem, unknown: Unknowns, on: Savings) -> Callable[[], None]:
    """The roll-out and nothing else, forwards and back: sums of squares of its states and logits, and its prior's nats.

    Gradients go to the first state and to z, and to the weights where they are not frozen.
    """
    priors, z = problem.priors, unknown.z.detach().requires_grad_()
    body = _Body(on, unknown.betas, z.shape[1] + 1)
    with torch.no_grad():
        first = first_state(unknown, priors, body)
    first.requires_grad_()

    def run() -> None:
        first.grad = z.grad = None
        with weights_of(priors, on):
            found = chain(priors.motion, first, z, on)
            parts = found.states.square().sum(), found.contact_logits.square().sum(), found.prior.nll(found.z).sum()
            sum(parts).backward()

    return run


def bodies_alone(problem: Problem, unknown: Unknowns, on: Savings) -> Callable[[], None]:
    """All body evaluations of a closure and nothing else, forwards and back, for the poses that its roll-out finds."""
    with torch.no_grad():
        posed = roll(unknown, problem.priors, problem.evidence, on).body
    body = _Body(on, posed.betas.detach().requires_grad_(), posed.root.shape[1])
    trans, pose = posed.root.requires_grad_(), body.form(posed.rot).requires_grad_()

    def run() -> None:
        trans.grad = pose.grad = body.betas.grad = None
        for _ in range(1 if on.needed_frames else FIRST_FRAME_CALLS):
            first = body.first(trans[:, 0], pose[:, 0])
        joints, marks = body.sequence(trans, pose)
        if not on.needed_frames:
            marks = body.sequence(trans, pose)[1]
        sum(x.square().sum() for x in (first, joints, marks)).backward()

    return run
