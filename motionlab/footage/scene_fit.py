"""Several people of one footage, seen by one camera: fits in a batch, long footage in windows that are kept on disk.

Where the camera's place is not known, a fit of the seconds that show most finds one for all: the mean of what each of
them says. Then they are fitted together under it. Footage of more than ``MAX_FRAMES`` frames is fitted in windows of
``WINDOW``; one that is done is kept, so that a rerun goes on where the last one stopped. What they share is blended.

A fit knows adults. A scene that is 1.7 times as large looks the same to a camera that stands 1.7 times as far off: so a
child of 1 m is fitted as an adult of 1.7 m, and everything is then made smaller again.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from motionlab import checkpoint, posterior, rotation
from motionlab.baselines import interpolate
from motionlab.files import writing
from motionlab.humor import body_shape, testops
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.humor.feedback_solver import Plan
from motionlab.humor.priors import Priors
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D
from motionlab.optimise import begins
from motionlab.posterior import Draws
from motionlab.skeleton import BALLS, STANDARD

#: Frames (at 30 fps) that are fitted at once, and the windows of more: their length and what neighbours share.
MAX_FRAMES, WINDOW, OVERLAP = 180, 120, 24
BATCH = 8  # people who are fitted at once: 120 frames of one take about 0.5 GB
_SHOWN = 15  # frames for which somebody may be unseen and still be shown
MIN_KEYPOINTS = 4  # keypoints that place a person
_KEYS = ("root", "rot", "contacts", "betas", "latent_chi2")  # of each person
USED = [k for k in range(len(BODY_25)) if k not in UNUSED_BODY_25]  # keypoints of BODY_25 that a fit uses
STATURE = 1.84  # metres: the standard body from sole to crown, as ``body.BodyModel`` draws it
SMALL = 0.75  # from less of the standard's size on, a fit without ``height`` is doubtful
_BONE_FRAMES = 5  # in which a bone must be seen
_FEET = {"heel": 0.015, "big_toe": 0.015, "ankle": 0.08}  # metres above the floor
_BONES = [("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")]
_MODES = {"shooting": "lean", "rollout": "official"}  # of a fit by each solver: with rollout all of it is the original


@dataclass(frozen=True, eq=False)
class SceneFit:
    """P people of one scene, T frames at 30 fps, world coordinates, z up.

    motions: one per person, of the whole footage, on the fitted bones; unseen times are filled in. shown (P, T): seen,
    or only for a moment not. seen: keypoints of BODY_25 (P, T, 25, 2). camera: one for all. latent_chi2 (P,): see
    ``testops.FitDiagnostics``. windows: how many. stopped: whether Ctrl-C ended it.
    draws: of each person, other motions that explain as well what was seen, where they were asked for.
    """

    motions: tuple[Motion, ...]
    shown: Tensor
    seen: Observation2D
    camera: Camera
    latent_chi2: Tensor
    windows: int
    notes: tuple[str, ...]
    stopped: bool = False
    draws: tuple[Draws, ...] = ()


@dataclass(frozen=True, eq=False)
class SceneFitConfig:
    """How the people of a scene are fitted.

    camera: None for an assumed one. placed: whether its place is known. size: of the image. keep: folder for the
    windows that are done; None keeps none. height: of everybody, metres; None is about an adult's. draws: how many
    other motions to draw of each person, where the footage is fitted in one piece.
    """

    priors: Priors
    camera: Camera | None = None
    placed: bool = False
    size: tuple[int, int] | None = None
    solver: str = "shooting"
    quick: bool = False
    keep: Path | None = None
    progress: bool | str = False
    height: float | None = None
    draws: int = 0

    @property
    def schedule(self) -> testops.Schedule | None:
        """The work of a fit; None is the official configuration."""
        return QUICK_WORK if self.quick else FULL_WORK if self.solver == "shooting" else None

    def fit(self, seen: Observation2D, camera: Camera | None, floor: str | None, **how) -> testops.Fitted:
        """Fits a batch under one camera."""
        cameras = None if camera is None else [camera] * len(seen.keypoints)
        how = {"schedule": self.schedule, "progress": self.progress, "solver": self.solver} | how
        how["mode"] = _MODES[how["solver"]]
        return testops.fit(seen, self.priors, cameras=cameras, floor=floor, size=self.size, **how)


#: The work of a fit, as near as ``Schedule.lean`` in less than half of its time (CHANGELOG); a first look.
_PLAN = Plan(8, 20, 1e-2, min_gain=0.033, stride=4, halving_after=5, damping=(0.1, 0.01))
FULL_WORK = replace(testops.Schedule.lean(), tolerance=3e-4, guesses=True, shooting=_PLAN)
_QUICK_PLAN = Plan(2, 12, trial_rounds=0, mode_jumps=0, stride=8, damping=(0.1, 0.01))
QUICK_WORK = replace(testops.Schedule.quick(), steps=(2, 4, 3), guesses=True, shooting=_QUICK_PLAN)


def fit_people(seen: Observation2D, config: SceneFitConfig) -> SceneFit:
    """Fits people (P, T, 25, 2), keypoints of BODY_25 at 30 fps, who share one static camera.

    Of each at least one frame shows ``MIN_KEYPOINTS`` of the keypoints that a fit uses. Of another ``height`` than an
    adult's they are fitted as adults in a scene that is as much larger. Ctrl-C keeps the best so far
    of footage in one window; of longer footage it keeps the windows that are done.

    Raises:
        KeyboardInterrupt: stopped between windows.
    """
    if config.height is not None:
        return _of_height(seen, config, config.height)
    enough = (seen.confidence[..., USED] > 0).sum(-1) >= MIN_KEYPOINTS
    people, frames = enough.shape
    many = frames > MAX_FRAMES
    starts, length = (_window_starts(frames), WINDOW) if many else ((0,), frames)
    camera, notes = config.camera, []
    floor = None if camera is None else "camera" if config.placed else "guess"
    if not config.placed and (people > 1 or many):
        camera, notes = _common_camera(seen, enough, config)
        floor = "camera"
    pieces: list[list[dict[str, Tensor]]] = [[] for _ in range(people)]
    stopped, draws = False, []
    where = config.keep if many else None
    for k, start in enumerate(tqdm(starts, "windows", unit="window", disable=not many or config.progress is not True)):
        if many:
            begins(f"window {k + 1} of {len(starts)}", config.progress)
        span = slice(start, start + length)
        who = enough[:, span].any(-1).nonzero()[:, 0].tolist()
        for some in (who[k : k + BATCH] for k in range(0, len(who), BATCH)):
            part = _cut(seen, some, span)
            file = where and where / f"{_key(part, camera, config)}.safetensors"
            found = file and checkpoint.kept(file)
            if found is None:
                fitted = replace(config, progress=not many and config.progress).fit(part, camera, floor)
                stopped |= fitted.stopped
                if fitted.stopped and many:
                    raise KeyboardInterrupt
                found = _told(fitted)
                if config.draws and not many and not stopped:
                    random = {"generator": torch.Generator().manual_seed(0)}
                    draws += [posterior.sample(fitted, config.draws, clip=k, **random) for k in range(len(some))]
                if floor in (None, "guess"):  # one person, one window
                    camera = fitted.cameras[0]
                if file:
                    with writing(where):
                        where.mkdir(parents=True, exist_ok=True)
                    checkpoint.keep(file, *found)
            tensors, said = found
            notes = notes + said
            for row, person in enumerate(some):
                pieces[person].append({"start": start} | {key: tensors[key][row] for key in _KEYS})
    motions = [_joined(parts, frames, seen.fps) for parts in pieces]
    latent_chi2 = torch.stack([torch.stack([part["latent_chi2"] for part in parts]).mean() for parts in pieces])
    shown = torch.nn.functional.max_pool1d(enough[:, None].float(), 2 * _SHOWN + 1, 1, _SHOWN)[:, 0] > 0
    if not config.placed:
        motions, camera, up = _on_the_floor(motions, shown, camera)
        draws = [each.changed(lambda m: replace(m, root=m.root + up)) for each in draws]
        notes += [f"the floor was moved by {100 * up[2]:+.1f} cm so that the feet stand on z = 0"]
    if config.draws and not draws:
        why = f"more than {MAX_FRAMES / 30:g} s is fitted in pieces" if many else "the fit was stopped"
        notes += [f"no other motions are drawn: {why}"]
    notes = tuple(dict.fromkeys(notes))
    return SceneFit(tuple(motions), shown, seen, camera, latent_chi2, len(starts), notes, stopped, tuple(draws))


def _of_height(seen: Observation2D, config: SceneFitConfig, height: float) -> SceneFit:
    factor, camera = height / STATURE, config.camera
    first = moved(camera, 1 / factor) if config.placed else camera
    found = fit_people(seen, replace(config, camera=first, height=None))
    if not config.placed:  # nothing but the bones says how large the scene is
        factor = height / float(np.mean([stature(motion) for motion in found.motions]))
        camera = moved(found.camera, factor)
    motions = tuple(resized(motion, factor) for motion in found.motions)
    draws = tuple(each.changed(lambda m: resized(m, factor)) for each in found.draws)
    note = f"{height:g} m tall: fitted as an adult, {1 / factor:.3g} times as large, and made smaller again"
    return replace(found, motions=motions, camera=camera, notes=(*found.notes, note), draws=draws)


def _window_starts(frames: int) -> tuple[int, ...]:
    """The first frames of the fewest windows that cover so many and share ``OVERLAP``."""
    count = -(-(frames - OVERLAP) // (WINDOW - OVERLAP))
    return tuple(round(k * (frames - WINDOW) / (count - 1)) for k in range(count))


def _cut(seen: Observation2D, people: Sequence[int], span: slice) -> Observation2D:
    return replace(seen, keypoints=seen.keypoints[people][:, span], confidence=seen.confidence[people][:, span])


def _common_camera(seen: Observation2D, enough: Tensor, config: SceneFitConfig) -> tuple[Camera, list[str]]:
    """One camera for all, from at most 4 s where most is seen: that of one person, or of a coarse fit of everybody the
    mean of their cameras, weighted by what was seen of each and by how well the fit met it."""
    length = min(seen.frames, WINDOW)
    most = seen.confidence[..., USED].sum((0, 2)).unfold(0, length, 1).sum(-1).argmax()
    span = slice(int(most), int(most) + length)
    who = enough[:, span].any(-1).nonzero()[:, 0].tolist()[:BATCH]
    part = _cut(seen, who, span)
    begins("the camera, from the seconds that show most", config.progress)
    floor = None if config.camera is None else "guess"
    work = QUICK_WORK if len(part.keypoints) > 1 else config.schedule or FULL_WORK
    fitted = config.fit(part, config.camera, floor, schedule=work, solver="shooting")
    if fitted.stopped:
        raise KeyboardInterrupt
    weight = part.confidence[..., USED].sum((1, 2)) / (1 + fitted.diagnostics.misfit.nan_to_num(1e6))
    weighed = list(zip(weight / weight.sum(), fitted.cameras, strict=True))
    turn = rotation.nearest(sum(w * c.rotation for w, c in weighed))
    centre = sum(w * c.centre for w, c in weighed)
    camera = replace(fitted.cameras[0], rotation=turn, translation=-turn @ centre)
    return camera, [note for note in fitted.notes if "camera assumed" in note]


def _told(fitted: testops.Fitted) -> tuple[dict[str, Tensor], list[str]]:
    """What is kept of a fit: tensors, and notes."""
    motion, doubts = fitted.motion, fitted.diagnostics
    latent_chi2 = motion.root.new_full((len(fitted.betas),), torch.nan) if doubts is None else doubts.latent_chi2
    values = (motion.root, motion.rot, fitted.contacts, fitted.betas.detach(), latent_chi2)
    return dict(zip(_KEYS, values, strict=True)), [note for note in fitted.notes if "doubts" not in note]


def _key(part: Observation2D, camera: Camera, config: SceneFitConfig) -> str:
    """A name for a window: what goes into its fit."""
    content = hashlib.sha256()
    tensors = (part.keypoints, part.confidence, camera.intrinsics, camera.rotation, camera.translation)
    networks, first = (config.priors.motion, config.priors.pose), config.priors.initial
    tensors += (first.weights, first.means, first.covariances)
    for tensor in (*tensors, *(weight for network in networks for weight in network.parameters())):
        content.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    content.update(repr((_KEYS, config.schedule, config.solver, config.size)).encode())
    return content.hexdigest()[:16]


def _joined(parts: Sequence[dict[str, Tensor]], frames: int, fps: float) -> Motion:
    """One motion from the windows of a person, on the mean of their bones; where there are none, interpolated."""
    betas = torch.stack([part["betas"] for part in parts]).mean(0)
    skeleton = replace(STANDARD, offsets=body_shape.offsets(betas))
    root, rot = torch.zeros(frames, 3), torch.eye(3).repeat(frames, 22, 1, 1)
    contacts, known = torch.zeros(frames, 9), torch.zeros(frames, dtype=torch.bool)
    for part in parts:
        own = replace(STANDARD, offsets=body_shape.offsets(part["betas"]))
        now = Motion(own, part["root"], part["rot"], fps)
        if len(parts) > 1:  # other bones: the lowest joint stays as high as it was
            mean = replace(now, skeleton=skeleton)
            low = (each.positions[..., 2].amin(-1) for each in (now, mean))
            now = replace(mean, root=mean.root + (next(low) - next(low))[:, None] * torch.tensor([0.0, 0.0, 1.0]))
        span = slice(part["start"], part["start"] + len(now.root))
        shared = int(known[span].sum())  # the first of them
        ramp = torch.ones(len(now.root))
        ramp[:shared] = torch.arange(1, shared + 1) / (shared + 1)
        root[span] = torch.lerp(root[span], now.root, ramp[:, None])
        contacts[span] = torch.lerp(contacts[span], part["contacts"], ramp[:, None])
        rot[span] = rotation.slerp(rot[span], now.rot, ramp[:, None].expand(-1, 22))
        known[span] = True
    motion = Motion(skeleton, root, rot, fps)
    if not known.all():
        motion = interpolate(motion, known)
    return replace(motion, contacts=(contacts > 0.5).float())


def _on_the_floor(motions: Sequence[Motion], shown: Tensor, camera: Camera) -> tuple[list[Motion], Camera, Tensor]:
    """Raises the whole scene, its camera too, so that the balls of the feet are at sole height; says (3,) by how much.

    Of each person those that the prior says are in contact, in the median; without any, the height that the lower one
    is below in 2 % of the frames. Of several people the median.
    """
    feet, low = STANDARD.indices(BALLS), []
    for motion, on in zip(motions, shown, strict=True):
        height = motion.positions[on][:, feet, 2]
        rests = motion.contacts[on][:, [motion.skeleton.contact_names.index(name) for name in BALLS]] > 0
        low.append(height[rests].median() if rests.any() else height.amin(-1).quantile(0.02))
    up = torch.tensor([0.0, 0.0, STANDARD.sole - torch.stack(low).median()])
    moved = [replace(motion, root=motion.root + up) for motion in motions]
    return moved, replace(camera, translation=camera.translation - camera.rotation @ up), up


def seen_size(seen: Observation2D, camera: Camera) -> list[float]:
    """Computes how large people (P, T, 25) are, as a share of the standard body; NaN where that cannot be told.

    Their lower foot is on the floor, z = 0. There the thighs, shins, upper arms and forearms have the length that the
    camera saw, but for what points towards it: of each the length that nine in ten frames do not exceed, of these
    the median.
    """
    heights = torch.full((len(BODY_25),), torch.nan)
    for name, height in _FEET.items():
        heights[[BODY_25.index(f"{side}_{name}") for side in ("left", "right")]] = height
    points = torch.where(seen.confidence[..., None] > 0, seen.keypoints, torch.nan).double()
    k = camera.intrinsics.double()
    plane = (points - k[:2, 2]) / k[[0, 1], [0, 1]]
    rays = torch.nn.functional.pad(plane, (0, 1), value=1.0) @ camera.rotation.double()
    depth = (heights - float(camera.centre[2])) / rays[..., 2]
    depth = torch.where((depth > 0) & (rays[..., 2] < 0), depth, torch.nan)
    lower = depth.nan_to_num(torch.inf).amin(-1)  # the foot that is on the floor is the nearer one
    level = (rays[..., :2].norm(dim=-1) / rays.norm(dim=-1)).nanmedian(-1).values.clamp(min=0.5)
    ends = [[f"{side}_{end}" for side in ("left", "right") for end in part] for part in zip(*_BONES, strict=True)]
    one, other = ([BODY_25.index(name) for name in names] for names in ends)
    length = STANDARD.offsets[STANDARD.indices(ends[1])].norm(dim=-1)
    across = (plane[..., one, :] - plane[..., other, :]).norm(dim=-1)  # (P, T, 8)
    size = (across * lower[..., None] / level[..., None] / length).mT
    told = size.isfinite() & (size.isfinite().sum(-1, keepdim=True) >= _BONE_FRAMES)
    return torch.where(told, size, torch.nan).nanquantile(0.9, dim=-1).nanmedian(-1).values.tolist()


def resized(motion: Motion, factor: float) -> Motion:
    """Returns a motion ``factor`` times as large, about the origin."""
    return replace(motion, skeleton=motion.skeleton.scaled(factor), root=motion.root * factor)


def moved(camera: Camera, factor: float) -> Camera:
    """Returns the camera that sees the same of a scene ``factor`` times as large."""
    return replace(camera, translation=camera.translation * factor)


def stature(motion: Motion) -> float:
    """Computes a fitted person's height, metres, from their bones: as the standard's, where they stand."""
    return STATURE * float(motion.skeleton.standing_height() / STANDARD.standing_height())
