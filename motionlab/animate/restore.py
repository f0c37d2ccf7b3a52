"""Denoises recordings, poses bodies from handles, generates motion.

    repaired(motion)                                  # what trembles or jumps
    posed(motion, ("left_wrist", "head"))             # all but the places of these
    generated(4.0)                                    # a new motion, or what may follow on one

Source: thesis 4.2.1 (denoising), 4.2.4 (poses from handles), 4.2.3 (generation).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from motionlab import baselines, cleaning, rotation
from motionlab.animate.corrections import WINDOW, KeyMask, Rig, by_windows, on_model_body
from motionlab.animate.filling import DRAWS, Animated, curves, found_joints, inbetween, network
from motionlab.animate.foot_locking import lock_feet
from motionlab.baselines import Noise, denoised
from motionlab.contact import resting_heights, with_contacts
from motionlab.diffusion import completer
from motionlab.diffusion.model import motion_model
from motionlab.diffusion.poses import finished, load
from motionlab.errors import DataError
from motionlab.heading import heading_frame, local_to_world, world_to_local_positions
from motionlab.ik import reach_targets
from motionlab.motion import FPS, Motion, runs
from motionlab.retarget import retarget
from motionlab.rigs import find_joints
from motionlab.skeleton import BALLS, FEET, STANDARD

ROUGH, PLAIN = "completer_rough", "diffusion_plain"  # corrects what was smoothed; makes new motion
CLEAN = Noise(0.35 * math.pi / 180, 0.0015)  # as much is measured on clean recordings
_WORTH = math.radians(1.0)  # with less noise of joints a smoother alone is closer
_MANY = 250  # steps of the sampler that begins
_SECONDS = (0.5, 600.0)  # of new motion: half a window's worth is hardly one, and ten minutes take two to make
_JUMPS = 0.2  # share of frames; with more it is noise that jumps
_LEAST = 12  # frames in which noise can be measured
_LASTS = "errors that last, as those of poses from video, are not measured: for these give --noise 2,10, and --drift"
_ANCHOR = 0.5  # seconds in which the path's drift is one
_CALM = 9  # frames over which poses from handles are smoothed, at the models' rate


def _measured_noise(motion: Motion) -> Noise:
    """Measures the noise of a motion (T) that is new in every frame, from the median sixth difference in time.

    Of independent noise these have 924 times its variance; motion, which is smooth, has hardly any. Lasting noise is
    not seen.
    """
    if motion.frames < _LEAST:
        what = f"too short to measure noise: {_LEAST} frames are needed, it has {motion.frames}"
        raise DataError(what, path=motion.name, place="noise", remedy="give --noise")
    size = 0.6745 * 924**0.5
    turn = rotation.log(motion.rot[:-1].double().mT @ motion.rot[1:].double()).diff(n=5, dim=0).abs()
    joints = turn.quantile(0.5, dim=0).mean(-1) / size
    live = joints[joints > 1e-5]
    shift = motion.root.double().diff(n=6, dim=0).abs().quantile(0.5, dim=0).mean() / size
    return Noise(float(live.median()) if len(live) else 0.0, float(shift))


def repaired(
    motion: Motion, noise: Noise | None = None, *, method: str | None = None, drift: bool = False, plant: bool = True
) -> Animated:
    """Computes a motion (T) without glitches and noise, and says what was found.

    Frames that no body reaches (``cleaning``) are filled in from those around (``filling.inbetween``). Noise is then
    smoothed away by a Kalman smoother of its size; ``network`` says what to add to what that leaves. Noise that is
    given is believed; None: measured, and left where there is no more of it than clean recordings have.

    method: "network" or "curves", of both; None: for noise the network from ``_WORTH`` on, for jumps what ``inbetween``
    chooses. drift: also take away what the path drifts by, as that of poses from video does (:func:`_anchored`).

    Raises:
        DataError: no such method, or a skeleton whose joints are not known.
    """
    if method not in (None, "network", "curves"):
        raise DataError(f"{method!r} repairs nothing", place="--method", remedy="use network or curves")
    given = noise is not None
    noise = noise or _measured_noise(motion)
    noisy = max(noise.turn, noise.shift) > 0 if given else noise.turn > CLEAN.turn or noise.shift > CLEAN.shift
    size = f"noise: joints tremble by {math.degrees(noise.turn):.2f} degrees, the root by {1000 * noise.shift:.1f} mm"
    notes = [size + ", as given" * given]
    if not noisy:
        notes.append("there is none to take away" if given else "that is no more than in clean recordings: it stays")
        notes += [_LASTS] * (not given)
    jumps, quiet = _jumps(motion), not (noisy or drift)
    if jumps.any():
        spans = ", ".join(f"{a}" if b == a + 1 else f"{a}-{b - 1}" for a, b in runs(jumps))
        notes.append(f"frames that jump: {spans}; they are made anew from those around")
        found = inbetween(motion, KeyMask.of(motion, ~jumps), method=method, plant=plant and quiet)
        motion = found.motion
        if quiet:
            return Animated(motion, (*notes, *found.notes))
        notes.append(found.notes[0])
    if quiet:
        return Animated(motion, (*notes, "no frame jumps: the motion stays as it is"))
    method = method or ("network" if noise.turn >= _WORTH else "curves")
    smooth = denoised(motion, noise) if noisy else motion
    body = Rig.of(motion, smooth, KeyMask.of(motion), lift=retarget(smooth).floor)
    made = body.joints
    if noisy and method == "network":
        fill = partial(completer.load(ROUGH).complete, tremble=noise.turn)
        made = body.corrected(by_windows(fill, body.missing_joints))
    how = ", and the network corrects what that blurs" if method == "network" else " by a smoother alone"
    notes += ["noise is smoothed away" + how] * noisy
    if drift:
        made, way = _anchored(made), made.root
        far = float((made.root - way)[-1].norm())
        notes.append(f"the path goes by the feet that stand: it ends {far:.2f} m from where it did")
    return Animated(body.to_own_rig(made, plant=plant), (*notes, *body.notes(plant)))


def _jumps(motion: Motion) -> Tensor:
    """(T,): frames that no body reaches from those before and behind."""
    if motion.frames < 3:
        return torch.zeros(motion.frames, dtype=torch.bool)
    found = cleaning.faults(retarget(motion).motion)["teleport"]
    return found if 0 < found.float().mean() < _JUMPS else torch.zeros_like(found)


def _anchored(joints: Motion) -> Motion:
    """The 22 joints (T) on a path on which the foot that stands stands still, raised or lowered to the floor.

    What stands is the lowest of ankles and balls. Its velocity, the median and then a mean over ``_ANCHOR`` seconds, is
    the path's drift. Who flies for half of that time, or slides, is held in place: this is for walks.
    """
    skeleton, near = joints.skeleton, max(round(_ANCHOR * joints.fps / 2), 1)
    feet = joints.positions[:, skeleton.indices(FEET)]
    above = feet[..., 2] - resting_heights(skeleton)[[skeleton.contact_names.index(name) for name in FEET]]
    lowest = (above[1:] + above[:-1]).argmin(-1)
    speed = feet.diff(dim=0)[torch.arange(len(lowest)), lowest]
    weight = torch.hann_window(2 * near + 3, periodic=False)[1:-1].to(speed)
    for blur in (lambda x: x.median(-1).values, lambda x: x @ (weight / weight.sum())):
        index = torch.arange(-near, len(speed) + near).clamp(0, len(speed) - 1)
        speed = blur(speed[index].unfold(0, 2 * near + 1, 1))
    root = joints.root - torch.cat((torch.zeros_like(speed[:1]), speed)).cumsum(0)
    made = replace(joints, root=root)
    low = made.positions[:, skeleton.indices(BALLS), 2].amin(-1).quantile(0.02)
    return replace(made, root=root + (skeleton.sole - low) * torch.tensor([0.0, 0.0, 1.0]).to(root))


def posed(motion: Motion, known: Sequence[str], *, plant: bool = True) -> Animated:
    """Computes a motion (T) of which only the places of some joints are known, and where it stands and faces.

    Every pose is completed by itself, calmed over time, and brought to the places by inverse kinematics.

    Raises:
        DataError: an unknown joint or one that no standard joint stands for.
    """
    names = find_joints(motion.skeleton, motion.name)
    owners = {own: standard for standard, own in names.items()}
    joints = sorted(found_joints(motion, known))
    lost = [motion.skeleton.names[j] for j in joints if j not in owners]
    if lost or not joints:
        remedy = f"use some of {', '.join(names)}"
        raise DataError(f"no standard joint stands for {', '.join(lost) or 'nothing'}", place="--known", remedy=remedy)
    nothing = KeyMask.of(motion)
    body = Rig.of(motion, curves(motion, nothing), nothing)
    given, _ = on_model_body(Rig.of(motion, motion, nothing).at_model_rate()[0])
    which = torch.zeros(len(STANDARD), dtype=torch.bool)
    which[STANDARD.indices([owners[j] for j in joints])] = True
    made = body.to_own_rig(body.corrected(lambda *_: _from_handles(given, which)), plant=plant)
    targets = motion.positions[:, joints]
    reached = reach_targets(made, [motion.skeleton.names[j] for j in joints], targets, steps=40)
    far = (reached.positions[:, joints] - targets).norm(dim=-1)
    which = ", ".join(motion.skeleton.names[j] for j in joints)
    note = f"{which}: at most {1000 * float(far.max()):.2g} mm from where they were"
    read = "read from the file besides: where the body stands and which way it faces"
    why = "on 17 people it had never seen, the other joints were 0.73 times as far off as without a network"
    return Animated(reached, (f"method: network, because {why}", note, read, *body.notes(plant)))


def _from_handles(given: Motion, which: Tensor) -> Motion:
    """Poses (T) on the models' body, handles where ``given`` has them; else only place and heading are read."""
    frame = heading_frame(given.root[:, None], given.rot[:, None, 0])
    local, which = world_to_local_positions(frame, given.positions[:, None])[:, 0], which.expand(given.frames, -1)
    world = local_to_world(frame, finished(load().complete(local, which), local, which))
    made = replace(given, root=world.root[:, 0], rot=world.rot[:, 0], contacts=None)
    window = min(_CALM, made.frames - 1 + made.frames % 2)
    return with_contacts(baselines.smoothed(made, window) if window > 2 else made)


def generated(seconds: float, *, start: Motion | None = None, seed: int = 0, plant: bool = True) -> Animated:
    """Draws a new motion of so many seconds on the standard body, or what may follow on ``start``, which stays.

    New motion begins with two seconds at once; the rest goes on from what is there, piece by piece.

    Raises:
        DataError: fewer or more seconds than ``_SECONDS``, or a start whose joints are not known.
    """
    if not _SECONDS[0] <= seconds <= _SECONDS[1]:  # not a number is neither
        remedy = f"ask for {_SECONDS[0]:g} to {_SECONDS[1]:g} s"
        raise DataError(f"cannot make {seconds:g} s of motion", place="--seconds", remedy=remedy)
    draws = torch.Generator().manual_seed(seed)
    if start is None:
        return _new(round(seconds * FPS), draws, plant)
    more = max(round(seconds * start.fps), 1)
    index = torch.arange(start.frames + more).clamp(max=start.frames - 1)
    longer = replace(start.clip(index), contacts=None)
    keep = KeyMask.of(longer, torch.arange(len(index)) < start.frames)
    body = Rig.of(longer, curves(longer, keep), keep)
    motion = body.to_own_rig(body.corrected(network(draws, body.missing_joints)), plant=plant)
    return Animated(motion, (f"made by the model {DRAWS}, which goes on from the end", *body.notes(plant)))


def _new(frames: int, draws: torch.Generator, plant: bool) -> Animated:
    motion = _on_floor(motion_model(PLAIN).sample(1, draws, steps=_MANY).clip(0))
    if frames > WINDOW:
        motion = motion.clip(torch.arange(frames).clamp(max=WINDOW - 1))
        known = (torch.arange(frames) < WINDOW)[:, None].expand(-1, len(STANDARD) + 2)
        motion = network(draws, torch.zeros(len(STANDARD), dtype=torch.bool))(motion, known)
    motion = motion.cut(0, frames)
    if plant:
        motion = lock_feet(motion.clip(None), slow=False).clip(0)
    who = f"{PLAIN}, and after two seconds by {DRAWS}" if frames > WINDOW else PLAIN
    return Animated(replace(motion, name="generated", notes=()), (f"made by the model {who}",))


def _on_floor(motion: Motion) -> Motion:
    """A motion (T) that floats, let down until a foot, hand or knee touches the floor in a tenth of the frames."""
    heights = motion.positions[:, STANDARD.contact_indices, 2] - resting_heights(STANDARD)
    up = heights.amin(-1).quantile(0.1).clamp(min=0.0)
    return replace(motion, root=motion.root - up * torch.tensor([0.0, 0.0, 1.0]))
