"""Where what was given meets what was made: the jump there, and every cure of it, on one scale.

A cure is a way of sampling and an end. A way is sampled without a last overwriting, so that the network has the last
word, and ended in three ways: "left" as it is (smooth; known frames are only near), "pasted" (known frames put in: the
thesis's last overwriting, exactly), "faded" (put in, and their offset faded out beside them: ``offset_decay``). Soft
masks blend in the last step, too: these are "pasted" by themselves.

Source: thesis 4.2.2 (the jump), 4.2.5 (blending), 4.4.1 (cures).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab import baselines
from motionlab.contact import with_contacts
from motionlab.diffusion import inpainting
from motionlab.diffusion.inpainting import Way
from motionlab.diffusion.model import Trained
from motionlab.errors import ShapeError
from motionlab.heading import local_to_world, stuck_root
from motionlab.metrics.gait import skating_ratio
from motionlab.metrics.pose import joint_errors, masked_mean
from motionlab.motion import Motion
from motionlab.skeleton import BALLS
from studies.shared.inbetween_measures import keyframe_error, natural_changes, percentile, step_changes

ENDS = ("left", "pasted", "faded")
EXACT = ENDS[1:]
FADE = 10  # frames
_PLAIN = Way(last=False)
#: Name -> (model: "free", "told", ..., way). The first is the thesis's.
CURES: dict[str, tuple[str, Way]] = {
    "overwrite (thesis)": ("free", _PLAIN),
    "x0 imputed (MDM)": ("free", replace(_PLAIN, put="imputed")),
    "resampled (RePaint)": ("free", replace(_PLAIN, times=5, jump=5)),
    "guided": ("free", replace(_PLAIN, put="nothing", weight=5.0)),
    "blended (thesis)": ("free", replace(_PLAIN, soft=10)),
    "told": ("told", replace(_PLAIN, put="nothing")),
    "told, overwrite": ("told", _PLAIN),
    "small, told": ("arm_told", replace(_PLAIN, put="nothing")),
    "small, told with arrival": ("arm_arrival", replace(_PLAIN, put="nothing")),
}


def gap(frames: int, length: int) -> Tensor:
    """Which frames are known, bool (T,), around a gap in the middle.

    Raises:
        ValueError: two known frames do not remain on either side.
    """
    if not 1 <= length <= frames - 4:
        raise ValueError(f"length: expected 1 to {frames - 4} frames, got {length}")
    time_ = torch.arange(frames)
    start = (frames - length) // 2
    return (time_ < start) | (time_ >= start + length)


def ended(
    model: Trained,
    motion: Motion,
    known: Tensor,
    generator: torch.Generator,
    way: Way,
    *,
    fade: int = FADE,
    batch: int = 64,
) -> dict[str, Motion]:
    """Motions (B, T), in the world, with the frames that are not known (T,) made anew: for each of ``ENDS`` one."""
    if model.layout.contacts and motion.contacts is None:
        motion = with_contacts(motion)
    stuck = model.layout.frame == "stuck"
    local, frame = stuck_root(motion) if stuck else (motion, None)
    x0, frames = model.encode(motion), known.nonzero()[:, 0].tolist()
    mask = model.layout.mask(len(known), only=frames)
    parts = [slice(at, at + batch) for at in range(0, len(x0), batch)]
    way = replace(way, last=way.soft > 0)
    x = torch.cat([inpainting.fill(model, x0[part], mask, generator, way) for part in parts])
    rows = {"pasted": torch.where(mask, x0, x)}
    if not way.soft:
        rows = {"left": x} | rows | {"faded": inpainting.offset_decay(x, x0, mask, fade)}
    found = {}
    for end, row in rows.items():
        made = model.decode(row, local.skeleton)
        made = local_to_world(frame, made) if stuck else made
        found[end] = _given(made, motion, known) if end in EXACT else made
    return found


def _given(made: Motion, motion: Motion, known: Tensor) -> Motion:
    """Known frames as they were given: to and from numbers of unit size and back costs a micrometre."""
    root = torch.where(known[:, None], motion.root, made.root)
    return replace(made, root=root, rot=torch.where(known[:, None, None, None], motion.rot, made.rot))


# ------------------------------------------------------------------------------------------------- measures
#: What :func:`measure` gives, with its unit.
UNITS = {
    "jump": "m/s",
    "jump / natural": "",
    "percentile": "%",
    "worst / natural": "",
    "known off": "m",
    "gap error": "mm",
    "skating": "% of frames",
    "acceleration": "of the truth's",
}


def measure(made: Motion, truth: Motion, known: Tensor, natural: Tensor) -> dict[str, Tensor]:
    """Of each window (B, T), as ``UNITS`` has it: name -> (B,).

    jump: change of the velocity at the seams, mean over both; jump / natural: over the 95th percentile of ``natural``
    (K,) m/s; percentile: its place there; worst / natural: the largest change anywhere in the gap and at its seams, as
    a cure may move the jump instead of curing it. known off: the farthest joint of a known frame. gap error: mean over
    joints and unknown frames. skating, acceleration: of the whole window; the latter over the mean of the truth's.
    """
    p, t, fps = made.positions, truth.positions, made.fps
    change = step_changes(p, fps)
    seams = (known[1:] != known[:-1]).expand(change.shape)
    jump, level = masked_mean(change, seams, 1), natural.quantile(0.95)
    within = seams | ~known[1:] | ~known[:-1]
    errors = joint_errors(p, t, align="none")
    bend, real = ((x.diff(n=2, dim=-3) * fps**2).norm(dim=-1).mean((-1, -2)) for x in (p, t))
    feet = made.skeleton.indices(BALLS)
    return {
        "jump": jump,
        "jump / natural": jump / level,
        "percentile": percentile(jump, natural),
        "worst / natural": torch.where(within, change, -torch.inf).amax(-1) / level,
        "known off": keyframe_error(p, t, known).worst_m,
        "gap error": 1000 * masked_mean(errors, (~known)[:, None].expand(errors.shape), 2),
        "skating": 100 * skating_ratio(p[..., feet, :], fps),
        "acceleration": bend / real.mean(),
    }


def natural(motion: Motion, most: int = 1_000_000) -> Tensor:
    """Changes of velocity (K,) in m/s at all frames of real windows (B, T), at most so many."""
    found = natural_changes(motion.positions, motion.fps)
    return found[:: -(-len(found) // most)]


@dataclass(frozen=True, eq=False)
class Line:
    """One row of the table: a cure with an end, its measures (B,) and the seconds that the sampling took."""

    cure: str
    end: str
    found: Mapping[str, Tensor]
    seconds: float

    def row(self) -> dict[str, object]:
        """Means over the windows; the worst where known frames should be exact."""
        head = {"way": self.cure, "end": self.end}
        mean = {_title(k): (v.max() if k == "known off" else v.mean()).item() for k, v in self.found.items()}
        return head | mean | {"s a window": self.seconds / len(self.found["jump"])}


def _title(name: str) -> str:
    return f"{name}, {UNITS[name]}" if UNITS[name] else name


def table(
    models: Mapping[str, Trained],
    truth: Motion,
    known: Tensor,
    generator: Callable[[str], torch.Generator],
    *,
    cures: Sequence[str] = tuple(CURES),
    steps: int = 50,
    scale: Tensor | None = None,
) -> tuple[list[Line], dict[tuple[str, str], Motion]]:
    """All cures on windows (B, T), between slerp and the truth, and what they made, by cure and end.

    generator: name of a cure -> its own. scale: natural changes (K,); those of the windows themselves by default.
    Cures of models that are not given are left out.

    Raises:
        ShapeError: the windows are not as long as known (T,).
    """
    if truth.frames != len(known):
        raise ShapeError(f"windows of {truth.frames} frames, known of {len(known)}")
    scale = natural(truth) if scale is None else scale
    start = time.perf_counter()
    made = {("slerp", "pasted"): baselines.interpolate(truth, known.expand(truth.root.shape[:-1]))}
    seconds = {"slerp": time.perf_counter() - start, "truth": 0.0}
    for cure in cures:
        name, way = CURES[cure]
        if name in models:
            start = time.perf_counter()
            found = ended(models[name], truth, known, generator(cure), replace(way, steps=steps))
            made |= {(cure, end): motion for end, motion in found.items()}
            seconds[cure] = time.perf_counter() - start
    made[("truth", "left")] = truth
    lines = [Line(cure, end, measure(m, truth, known, scale), seconds[cure]) for (cure, end), m in made.items()]
    return lines, made


def pick(lines: Sequence[Line], cure: str, end: str) -> dict[str, Tensor]:
    """The measures of one line."""
    return dict(next(line.found for line in lines if (line.cure, line.end) == (cure, end)))


def best(lines: Sequence[Line]) -> tuple[str, str]:
    """Of the cures that leave known frames exact, but slerp, the one whose worst change in the gap is least on average.

    Not that at the seams alone: a soft mask moves the jump into the gap. Small models are no cures, but compared with
    each other alone.
    """
    cures = [x for x in lines if x.end in EXACT and x.cure in CURES and not CURES[x.cure][0].startswith("arm_")]
    first = min(cures, key=lambda line: line.found["worst / natural"].mean().item())
    return first.cure, first.end


# ------------------------------------------------------------------------------------------------- blending
def linearity(made: Motion, truth: Motion, known: Tensor) -> Tensor:
    """Distance of the gap's joints from the linear interpolation, over the truth's mean distance from it: (B,).

    0 is the line, 1 as far from it as real motion is. Roots linearly, rotations by slerp between the gap's edges.
    """
    line = baselines.interpolate(truth, known.expand(truth.root.shape[:-1])).positions
    inside = (~known)[:, None].expand(line.shape[:-1])
    far, real = (masked_mean(joint_errors(m.positions, line, align="none"), inside, 2) for m in (made, truth))
    return far / real.mean()
