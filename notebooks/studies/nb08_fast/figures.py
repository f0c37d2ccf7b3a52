"""Pictures of notebook 08: the toy, the nudge, one clip over time, and the race."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.viz.movie import Mesh, stage
from motionlab.viz.palette import LINE, colour
from studies.nb08_fast import race
from studies.nb08_fast.trials import Nudged, Run, Task
from studies.shared.plots import canvas, paints

ROLES = {
    race.SINGLE: "baseline", race.DEFAULT: "ours", race.QUICK: "6d",
    "open loop": "baseline", "closed loop": "ours",
}  # fmt: skip
_FLOOR = 0.01


def toy(spectra: Mapping[str, np.ndarray], paths: Mapping[str, np.ndarray], seen: np.ndarray) -> Figure:
    """Draws the eigenvalues of the toy's Hessian in two sets of unknowns, and what one push does to the walk.

    spectra: label -> eigenvalues (T,). paths: label -> places (T,) less those without the push. seen (T,): bool.
    """
    fig, (left, right) = canvas(1, 2, size=(10.0, 3.2))
    for (label, values), (way, path) in zip(spectra.items(), paths.items(), strict=True):
        paint, steps = colour(ROLES[way]), range(1, len(seen) + 1)
        size = 5.5 if way == "open loop" else 3.5
        left.plot(steps, np.sort(values)[::-1], "o", ms=size, color=paint, label=label)
        right.plot(steps, path, lw=2, color=paint, label=way)
    across = right.get_xaxis_transform()
    right.fill_between(steps, 0, 1, where=~seen, color=LINE, alpha=0.35, lw=0, transform=across)
    left.set(yscale="log", xlabel="number of the eigenvalue", ylabel="eigenvalue of the Hessian", title="stiffness")
    right.set(xlabel="step", ylabel="off the walk before (m)", title="one push; shaded: not seen")
    left.legend(loc="upper right")
    right.legend(loc="upper left")
    return fig


def nudge(found: Nudged, frame: int, body: BodyModel) -> Figure:
    """Draws both bodies at one frame over the grey one that was not nudged, and how far they are from it over time."""
    with stage(found.after, ROLES, body, size=(820, 460), ghost=found.before, follow=True)[0] as scene:
        picture = scene.image(frame / found.before.fps)
    fig, (left, right) = canvas(1, 2, size=(11.0, 3.2))
    left.imshow(picture)
    left.set_axis_off()
    left.set_title(f"{frame / found.before.fps:.1f} s; grey: not nudged")
    for way, off in found.apart.items():
        right.plot(np.arange(len(off)) / found.before.fps, off, lw=2, color=colour(ROLES[way]), label=way)
    right.set(xlabel="time (s)", ylabel="off the roll-out before (cm)", ylim=(0, None))
    right.legend(loc="upper left")
    return fig


def one_clip(task: Task, runs: Mapping[str, Run]) -> Figure:
    """Draws a clip's energy above the best that anybody found, and its error, over processor seconds."""
    fig, (left, right) = canvas(1, 2, size=(10.0, 3.2))
    low, paint = race.best(runs), paints(list(runs), ROLES)
    for name, run in runs.items():
        gap = ((run.energies - low) / task.nat).clamp(min=_FLOOR)
        left.step(run.seconds, gap, where="post", lw=1.8, color=paint[name], label=name)
        some = sorted({round(x) for x in np.linspace(0, len(run.kept) - 1, min(60, len(run.kept)))})  # enough to draw
        off = [race.errors(task, task.motion(run.kept[k][1]))["all"] for k in some]
        right.step([run.kept[k][0] for k in some], off, where="post", lw=1.8, color=paint[name], label=name)
        right.plot(run.kept[-1][0], off[-1], "o", ms=5, color=paint[name])
    for ax in (left, right):
        ax.set(xscale="log", yscale="log", xlabel="processor time of stage 3 (s)")
        ax.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
        ax.minorticks_off()
    left.set_ylabel("energy above the best (nats a frame)")
    right.set_ylabel("error of all joints (cm)")
    right.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    left.legend(loc="lower left")
    return fig


def profiles(
    found: Mapping[str, Mapping[str, Tensor]], times: Sequence[float], sources: Mapping[str, Sequence[int]]
) -> Figure:
    """Draws by source (rows) and measure (columns) the median over clips at so many seconds, and the middle half.

    found: measure -> contender -> (B, N). sources: source -> its clips.
    """
    labels = {"energy": "above the best (nats a frame)", "seen": "joints in view (cm)", "hidden": "hidden joints (cm)"}
    fig, axes = canvas(len(sources), len(found), size=(11.0, 2.8 * len(sources)), sharex=True, sharey="col")
    for ax, (source, measure) in zip(axes, ((s, m) for s in sources for m in found), strict=True):
        paint = paints(list(found[measure]), ROLES)
        for name, rows in found[measure].items():
            values = np.clip(rows[list(sources[source])].numpy(), _FLOOR, None)
            low, middle, high = np.nanpercentile(values, (25, 50, 75), axis=0)
            ax.fill_between(times, low, high, color=paint[name], alpha=0.12, lw=0)
            ax.plot(times, middle, "o-", ms=4, lw=1.8, color=paint[name], label=name)
        ax.set(xscale="log", yscale="log", ylabel=labels[measure], title=f"{source}, n = {len(sources[source])}")
        ax.set_xticks(times, [f"{t:g}" for t in times])
        ax.minorticks_off()
        if measure != "energy":
            ax.set_yticks((2, 3, 5, 10, 20, 50, 100), ["2", "3", "5", "10", "20", "50", "100"])
    for ax in axes[-len(found) :]:
        ax.set_xlabel("processor time of stage 3 (s)")
    axes[0].legend(loc="lower left")
    return fig


def picture(shown: Mapping[str, Motion], body: BodyModel, seconds: float, things: Sequence[Mesh]) -> np.ndarray:
    """Draws bodies side by side at one time, the truth in grey behind all others."""
    with stage(shown, ROLES, body, (1080, 400), things=things, ghost=next(iter(shown.values())))[0] as scene:
        return scene.image(seconds)
