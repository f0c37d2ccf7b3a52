"""Two flaws of P that the thesis names: a jump where what was given meets what was made, and legs that walk the other
way.

The jump is what Eq. 4.10 leaves, beside what cures it (thesis 4.2.2, 4.4.1) and blended edges (4.2.5). For the walks
the thesis blames its root, which is held over one spot, so that nothing says where a walk goes. No plain model of such
a root is trained. What such a root takes away is the path: so it is hidden.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from motionlab import baselines, bench
from motionlab.bench import PersonWindows
from motionlab.metrics import joint_errors, masked_mean
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.shared.fill_contenders import BLENDED, LEFT, MIXED, PLAIN, Models, P, R, T
from studies.shared.fill_people import FRAMES, only, some

OPEN, FADED, SOFT = "P, not written back", "P, mixed afterwards", "P, blended (4.2.5)"
JUMP, LARGE, OFF, LEAVES = "jump, m/s", "over a large natural one", "known off, cm", "error in the gap, cm"
_PACE = 0.3  # m/s: slower than that nobody walks


def step_changes(positions: Tensor, fps: float) -> Tensor:
    """The change of velocity into or out of each step between frames, the larger one: (..., T - 1) in m/s, mean over
    the joints of positions (..., T, J, 3). The first and the last step have one neighbour, the others two."""
    change = torch.linalg.vector_norm(positions.diff(n=2, dim=-3), dim=-1).mean(-1) * fps  # (..., T - 2)
    padded = torch.nn.functional.pad(change, (1, 1), value=-torch.inf)
    return torch.maximum(padded[..., 1:], padded[..., :-1])


def cures(m: Models, windows: PersonWindows, known: Tensor, seed: int = 0) -> dict[str, Motion]:
    """Windows (B, T) with a gap, ``known`` (B, T, U): what P makes of it, ended in four ways, beside smooth fills."""
    truth, _, lacks = windows
    given = known & ~lacks
    left, mixed, blended = (m.plain(truth, given, way, seed) for way in (LEFT, MIXED, BLENDED))
    made = {P: left, FADED: mixed, SOFT: blended, "curves": m.curves(truth, known)}
    made |= {R: m.r.complete(truth, given), T: m.drawn(truth, given, seed)}
    exact = {name: bench.restore_known(motion, truth, known | lacks) for name, motion in made.items()}
    return {"truth": truth, OPEN: bench.restore_known(left, truth, lacks.expand_as(known))} | exact


def seams(made: Mapping[str, Motion], known: Tensor) -> dict[str, dict[str, Tensor]]:
    """By name, of each window (B,): the change of velocity at the seams in m/s, and over the 95th percentile of all
    such changes in the truth; how far known joints are off, at most, in cm; the error in the gap in cm."""
    truth, frames = made["truth"], known[..., 0]
    level = step_changes(truth.positions, truth.fps)[..., 1:-1].quantile(0.95)
    found = {}
    for name, motion in made.items():
        change = step_changes(motion.positions, truth.fps)
        jump = masked_mean(change, frames[:, 1:] != frames[:, :-1], 1)
        moved = joint_errors(motion.positions, truth.positions, align="none").where(frames[..., None], 0.0)
        off = 100 * moved.amax((-1, -2))
        found[name] = {JUMP: jump, LARGE: jump / level, OFF: off, LEAVES: bench.error_cm(motion, truth, known)}
    return found


def off_the_line(made: Motion, truth: Motion, known: Tensor) -> Tensor:
    """Metres (B,) of the gap's joints from straight lines and slerp between its edges."""
    line = baselines.interpolate(truth, known[..., : bench.JOINTS]).positions
    inside = (~known[..., :1]).expand(line.shape[:-1])
    return masked_mean(joint_errors(made.positions, line, align="none"), inside, 2)


def stance_speed(motion: Motion) -> Tensor:
    """m/s (B,): how fast the lower foot moves along the pelvis's heading relative to the pelvis, mean over the window.

    Who walks forwards pushes it back: negative. It reads a fixed root as it does a free one.
    """
    p = motion.positions
    feet = p[..., STANDARD.indices(("left_foot", "right_foot")), :]
    left = p[..., STANDARD.index("left_hip"), :2] - p[..., STANDARD.index("right_hip"), :2]
    ahead = torch.nn.functional.normalize(torch.stack((left[..., 1], -left[..., 0]), -1), dim=-1)
    steps = (feet - p[..., :1, :])[..., :2].diff(dim=-3) * motion.fps
    along = (steps * ahead[..., :-1, None, :]).sum(-1)  # (B, T - 1, 2)
    lower = (feet[..., :-1, :, 2] + feet[..., 1:, :, 2]).argmin(-1, keepdim=True)
    return along.gather(-1, lower)[..., 0].mean(-1)


def walkers(windows: PersonWindows, each: int) -> PersonWindows:
    """At most ``each`` windows of every person in which somebody walks."""
    walks = only(windows, (stance_speed(windows.motion).abs() >= _PACE).nonzero()[:, 0])
    few = only(walks, some(walks, each))
    return few._replace(whose=few.whose.unique(return_inverse=True)[1])


def reversals(m: Models, walks: PersonWindows) -> dict[tuple[str, bool], Tensor]:
    """By model and whether the path is given: 1 (B,) where the lower foot goes the other way than the true one, 0 where
    not, NaN where that one goes slower than ``_PACE``: nobody walks."""
    motion, _, lacks = walks
    true = stance_speed(motion)
    given = bench.legs(len(motion.root), FRAMES)
    hidden = given.clone()
    hidden[..., bench.JOINTS] = False
    found = {}
    for path, known in ((True, given & ~lacks), (False, hidden & ~lacks)):
        made = {P: m.plain(motion, known, PLAIN, 0), R: m.r.complete(motion, known), T: m.drawn(motion, known, 0)}
        other_way = {name: (stance_speed(x) * true < 0).to(true) for name, x in made.items()}
        found |= {(n, path): torch.where(true.abs() >= _PACE, x, torch.nan) for n, x in other_way.items()}
    return found
