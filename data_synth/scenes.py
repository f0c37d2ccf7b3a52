"""The lab videos of the thesis as scenes with truth: two seconds of somebody, a camera, what stands in the way, what
the detector says, and what it gets wrong.

Nobody in them is in the training corpus: the subject that it holds out, and people drawn here.
Source: thesis 3.2 ("a variety of motion; fast, slow, abnormal, and with occlusions"), Figs. 3.2, 3.3 and 3.5.
"""

import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import torch
from torch import Tensor

from data_synth import capture, corrupt
from data_synth.actions import ACTIONS
from data_synth.body import capsule_body
from data_synth.occluders import Occluder, desk_before, wall
from data_synth.score import uniform
from data_synth.stunts import tumble
from data_synth.subjects import SUBJECTS, Subject, proportioned
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D

#: The keypoints that show each of the 22 joints; a joint is seen where one of them is detected.
SHOWN_BY = {joint: (point,) for point, joint in capture.JOINTS.items()} | {
    "spine1": ("mid_hip", "neck"), "spine2": ("mid_hip", "neck"), "spine3": ("neck",),
    "head": ("nose", "left_ear", "right_ear"), "left_collar": ("left_shoulder",), "right_collar": ("right_shoulder",),
    "left_foot": ("left_big_toe",), "right_foot": ("right_big_toe",),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scene:
    """B clips of one case. What a fit may see is ``observation`` and ``cameras``; the rest is for the judge.

    truth: (B, T) with a skeleton per clip. observation: (B, T, 25), BODY_25. cameras: one per clip.
    pixels (B, T, 25, 2): the true image. seen (B, T, 22): joints that the detector had a right to see, before
    anything was corrupted. wrong (B, T, 25): detections that were corrupted. occluders: what stands in the way of
    each clip.
    """

    name: str
    truth: Motion
    observation: Observation2D
    cameras: tuple[Camera, ...]
    pixels: Tensor
    seen: Tensor
    wrong: Tensor
    occluders: tuple[tuple[Occluder, ...], ...]

    def __len__(self) -> int:
        return len(self.cameras)

    def clip(self, index: int) -> Observation2D:
        """One clip's observation with its camera."""
        o, camera = self.observation, self.cameras[index]
        return replace(o, keypoints=o.keypoints[index], confidence=o.confidence[index], camera=camera, name=self.name)


def person(index: int, generator: torch.Generator) -> Subject:
    """Somebody the corpus does not know: the first is the subject that it holds out, the others are drawn."""
    if index == 0:
        return SUBJECTS[-1]
    around = partial(uniform, generator)
    parts = ("thigh", "shin", "trunk", "shoulders", "arm", "forearm", "hips")
    skeleton = proportioned(around(0.94, 1.07), **{part: around(0.95, 1.05) for part in parts})
    return Subject(
        f"stranger {index}", skeleton, walk_ratio=around(0.0060, 0.0067), step_width=around(0.08, 0.14),
        arm_swing=around(0.75, 1.3), bounce=around(0.8, 1.25), twist=around(0.8, 1.3), lean=around(0.0, 0.08),
        elbow=around(0.2, 0.42), toe_out=around(0.05, 0.22), carriage=around(0.14, 0.24), tempo=around(0.9, 1.12),
    )  # fmt: skip


def film(case: str, count: int = 8, *, seed: int = 0, frames: int = 60) -> Scene:
    """``count`` clips of a case of ``CASES``. Clip i is the same whatever the count; cases of one shooting (walking
    with and without the failure) have the same people, cameras and noise.

    Raises:
        KeyError: no such case; lists them.
    """
    if case not in CASES:
        raise KeyError(f"no case {case!r}; cases are {', '.join(CASES)}")
    shooting, failure = CASES[case]
    generators = [_generator(seed, shooting.__name__, index) for index in range(count)]
    shots = [(*shooting(index, generator, frames), generator) for index, generator in enumerate(generators)]
    return _filmed(case, shots, failure, seed)


def film_recorded(view: str, motions: Sequence[Motion], *, seed: int = 0, facing: bool = False) -> Scene:
    """Films recorded motions (T), all of one length, with contacts, in a view of ``VIEWS``: one clip for each. The same
    motion has the same camera and noise in every view.

    facing: the camera stands within 45 degrees of where the person looks at the middle frame, else anywhere.
    """
    shots = []
    for index, motion in enumerate(motions):
        generator = _generator(seed, "recorded", index)
        where = {"around": _facing(motion), "by": 45.0} if facing else {}
        camera = capture.frame_motion(motion, generator, stand=(1.1, 1.8), **where)
        shots.append((motion, camera, VIEWS[view](motion, camera), generator))
    return _filmed(view, shots, None, seed)


def _filmed(case: str, takes: Sequence[tuple], failure: Callable | None, seed: int) -> Scene:
    """The scene of takes: motion, camera, what stands in the way, and the generator of the detector's noise."""
    shots = []
    for index, (motion, camera, things, generator) in enumerate(takes):
        clean, hidden = capture.observe(motion, _flesh(), camera, generator, things)
        own = _generator(seed, case, index)  # a failure does not disturb the draws of the shooting
        seen, wrong = failure(clean, own) if failure else (clean, torch.zeros_like(clean.visible))
        shots.append((clean.visible, seen.keypoints, seen.confidence, wrong, hidden.pixels))
    visible, keypoints, confidence, wrong, pixels = map(torch.stack, zip(*shots, strict=True))
    motions, cameras, things, _ = zip(*takes, strict=True)
    observation = Observation2D(keypoints, confidence, BODY_25, motions[0].fps, None, case)
    seen = joints_seen(visible, motions[0].skeleton.names)
    return Scene(case, together(motions), observation, cameras, pixels, seen, wrong, tuple(map(tuple, things)))


def without(scene: Scene, frames: Iterable[int]) -> Scene:
    """The same scene with nothing detected in the given frames; negative ones count from the end."""
    observation, gone = corrupt.drop_frames(scene.observation, frames := list(frames))
    seen = scene.seen.clone()
    seen[:, frames] = False
    return replace(scene, observation=observation, wrong=scene.wrong | gone, seen=seen)


def gap_frames(place: str, length: int, frames: int = 60) -> list[int]:
    """``length`` frames, the clip's at most, at its beginning ("first"), from its middle on ("middle") or at its end.

    A gap that would reach beyond the end begins earlier.
    """
    length = min(length, frames)
    start = {"first": 0, "middle": min(frames // 2, frames - length), "last": frames - length}[place]
    return list(range(start, start + length))


def held_out(count: int, *, seed: int = 0, frames: int = 60) -> Motion:
    """``count`` clips (B, T) of everyday motion by people that the corpus does not know, for fits in 3-D."""
    actions = ("walk", "reach", "sit", "turn", "wave", "crouch", "walk", "dance")
    draws = [_generator(seed, "held out", i) for i in range(count)]
    return together([_window(actions[i % len(actions)], i, draw, frames) for i, draw in enumerate(draws)])


def together(motions: Sequence[Motion]) -> Motion:
    """Clips of equal length as one batch (B, T) with a skeleton each, offsets (B, 1, 22, 3)."""
    first = motions[0]
    offsets = torch.stack([m.skeleton.offsets for m in motions])[:, None]
    return Motion(
        replace(first.skeleton, offsets=offsets), torch.stack([m.root for m in motions]),
        torch.stack([m.rot for m in motions]), first.fps, torch.stack([m.contacts for m in motions]),
    )  # fmt: skip


def joints_seen(detected: Tensor, names: Sequence[str]) -> Tensor:
    """Which of the joints (..., 22) are shown by detected keypoints (..., 25)."""
    shown = [[BODY_25.index(point) for point in SHOWN_BY[name]] for name in names]
    return torch.stack([detected[..., points].any(-1) for points in shown], -1)


# ------------------------------------------------------------------------------------------------ shootings
Shot = tuple[Motion, Camera, Sequence[Occluder]]


def _easy(index: int, generator: torch.Generator, frames: int) -> Shot:
    motion = _window(("walk", "reach", "turn", "idle")[index % 4], index, generator, frames)
    return motion, capture.frame_motion(motion, generator), ()


def _facing_it(index: int, generator: torch.Generator, frames: int) -> Shot:
    """Easy, and filmed from the front: where the official start of a fit is not wrong to begin with."""
    motion = _window(("walk", "reach", "wave", "idle")[index % 4], index, generator, frames)
    return motion, capture.frame_motion(motion, generator, around=_facing(motion), by=45.0), ()


def _walking(index: int, generator: torch.Generator, frames: int) -> Shot:
    motion = _window("walk", index, generator, frames, speed=1.2)
    return motion, capture.frame_motion(motion, generator), ()


def _sitting(index: int, generator: torch.Generator, frames: int) -> Shot:
    """Sitting down behind a desk that hides whatever is below 0.65 m: the legs from the first frame."""
    motion = _window("sit", index, generator, frames, seconds=1.0)
    camera = capture.frame_motion(motion, generator, around=_facing(motion), by=60.0, stand=(1.1, 1.8))
    return motion, camera, (desk_before(motion, camera, hidden=0.65),)


def _passing(index: int, generator: torch.Generator, frames: int) -> Shot:
    """Walking across the view; from a third of the clip on, a low wall hides the legs."""
    motion = _window("walk", index, generator, frames, speed=1.2)
    camera = capture.frame_motion(motion, generator, around=_across(motion, index), by=25.0, stand=(1.2, 1.8))
    return motion, camera, (_low_wall(motion, camera, frames // 3),)


def _dancing(index: int, generator: torch.Generator, frames: int) -> Shot:
    motion = _window("dance", index, generator, frames)
    return motion, capture.frame_motion(motion, generator), ()


def _rolling(index: int, generator: torch.Generator, frames: int) -> Shot:
    motion = _window("floor", index, generator, frames, rolls=2, way=("kneel", "seat")[index % 2])
    return motion, capture.frame_motion(motion, generator, stand=(1.4, 2.2)), ()


def _tumbling(index: int, generator: torch.Generator, frames: int) -> Shot:
    motion = tumble(person(index, generator), generator, frames=frames)
    return motion, capture.frame_motion(motion, generator, around=_across(motion, index), by=40.0), ()


#: Case -> how it is shot, and what the detector then gets wrong.
CASES: dict[str, tuple[Callable, Callable | None]] = {
    "easy": (_easy, None),
    "walking": (_walking, None),
    "sitting, legs hidden": (_sitting, None),
    "walking, legs hidden": (_passing, None),
    "walking, two legs from one": (_passing, corrupt.two_legs_from_one),
    "limb flips": (_walking, partial(corrupt.flip_limbs, share=0.2, length=4)),
    "false detections": (_easy, partial(corrupt.false_detections, share=0.08, length=6)),
    "dance": (_dancing, None),
    "floor roll": (_rolling, None),
    "tumble": (_tumbling, None),
    "facing the camera": (_facing_it, None),
}


def _behind_a_wall(motion: Motion, camera: Camera) -> Sequence[Occluder]:
    """A low wall, from a third of the clip on where somebody walks past it; a desk where nobody goes anywhere."""
    start, way = motion.frames // 3, motion.root[-1, :2] - motion.root[motion.frames // 3, :2]
    return (_low_wall(motion, camera, start),) if way.norm() > 0.3 else (desk_before(motion, camera, hidden=0.85),)


#: View of a recorded motion -> what stands between it and the camera.
VIEWS: dict[str, Callable[[Motion, Camera], Sequence[Occluder]]] = {
    "plain view": lambda motion, camera: (),
    "legs behind a desk": lambda motion, camera: (desk_before(motion, camera, hidden=0.65),),
    "behind a low wall": _behind_a_wall,
}


# ------------------------------------------------------------------------------------------------ how it is done
_flesh = cache(capsule_body)


def _generator(seed: int, what: str, index: int) -> torch.Generator:
    digest = hashlib.sha256(f"scene/{seed}/{what}/{index}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)


def _window(action: str, index: int, generator: torch.Generator, frames: int, **options) -> Motion:
    """The part of an action that shows it: the way down to the seat, a steady walk, the liveliest roll or dance."""
    long = {"walk": "seconds", "dance": "seconds", "idle": "seconds"}.get(action)
    options |= {long: frames / 30 + 3.0} if long else {}
    motion = ACTIONS[action](person(index, generator), generator, **options).motion
    spare = motion.frames - frames
    if action == "sit":
        start = int((motion.root[:, 2] < motion.root[0, 2] - 0.01).nonzero()[0]) - 4
    elif action in ("floor", "dance"):  # the left of the pelvis is what a roll turns most; a dance is known by its arms
        path = motion.rot[:, 0, :, 0] if action == "floor" else (motion.positions - motion.root[:, None]).flatten(1)
        start = int((path.diff(dim=0).norm(dim=-1).unfold(0, frames - 1, 1).sum(-1)).argmax())
    else:
        start = spare // 2 if long else int(torch.randint(max(spare, 0) + 1, (), generator=generator))
    start = min(max(start, 0), max(spare, 0))
    at = torch.arange(start, start + frames).clamp(max=motion.frames - 1)  # the last pose stays
    return replace(motion, root=motion.root[at], rot=motion.rot[at], contacts=motion.contacts[at])


def _facing(motion: Motion) -> float:
    """Direction in which the pelvis looks at the middle frame, degrees from the world's +x."""
    forward = motion.rot[motion.frames // 2, 0, :, 2]
    return math.degrees(math.atan2(forward[1], forward[0]))


def _across(motion: Motion, index: int) -> float:
    """Direction across the way that somebody goes, degrees from the world's +x; to the left of it every other time."""
    way = motion.root[-1] - motion.root[0]
    return math.degrees(math.atan2(way[1], way[0])) + (90.0 if index % 2 else -90.0)


def _low_wall(motion: Motion, camera: Camera, start: int) -> Occluder:
    """A wall 0.7 of the way to the person that hides what is below 0.85 metres from frame ``start`` on."""
    eye, ground = camera.centre.double(), motion.root[:, :2].double()
    base = eye[:2] + 0.7 * (ground - eye[:2])
    way = (base[-1] - base[start]) / (base[-1] - base[start]).norm()
    height = float(eye[2] + 0.7 * (0.85 - eye[2]))
    return wall(tuple(base[start].tolist()), tuple((base[-1] + 2.0 * way).tolist()), height=height)
