"""Noise on every joint: filters, a Gaussian, the thesis's model gone back from the step that is as noisy, and R, here
the network that learnt what to add behind a smoother; it is told how large the noise is, which the others are tuned to.

A motion y = x_0 + noise of known size is, but for a factor, what the noising process makes of x_0 at the step t* with
sqrt((1 - alpha_bar) / alpha_bar) = size. From there the thesis's model goes back in one step.

Source: thesis 4.2.1; SDEdit (Meng et al. 2022), which adds all of the noise itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import torch
from torch import Tensor

from motionlab import baselines, bench
from motionlab.baselines import Noise, denoised
from motionlab.bench import RIDGES, Rivals, by_person
from motionlab.contact import with_contacts
from motionlab.diffusion import completer, sampling
from motionlab.diffusion.features import UNITS, Layout, Normaliser
from motionlab.diffusion.model import MotionDiffusion
from motionlab.heading import local_to_world, stuck_root, world_to_local
from motionlab.motion import Motion
from studies.shared.fill_bench import ERROR, SCORE, Result
from studies.shared.fill_contenders import Models, P, R
from studies.shared.fill_people import Cast


@dataclass(frozen=True)
class ReverseProcess:
    """How the reverse process begins and goes on.

    level: noise at its first step, over that of the motion. topped: numbers less noisy than that get more. looks: with
    other noise, averaged. filtered: the rough motion is what begins, not the noisy one.
    """

    level: float = 1.0
    topped: bool = True
    looks: int = 1
    filtered: bool = False


def noise_size(layout: Layout, normaliser: Normaliser, turn: float, shift: float) -> Tensor:
    """Computes the deviation (D,) of each normalised number from noise of ``turn`` radians about each axis of a joint
    and ``shift`` metres: a turned column of length 1 moves by sqrt(2 / 3) turn in each coordinate."""
    size = torch.zeros(layout.size)
    for name, part in layout.slices.items():
        size[part] = {"root": shift, "orient": (2 / 3) ** 0.5 * turn, "pose": (2 / 3) ** 0.5 * turn}.get(name, 0.0)
    return size / normaliser.scale


@torch.no_grad()
def denoise(
    model: MotionDiffusion, noisy: Motion, rough: Motion, noise: Noise, generator: torch.Generator,
    start: ReverseProcess,
) -> Motion:  # fmt: skip
    """Computes denoised motions (B, T), where they were in the world, by the reverse process.

    It begins at the step with the same noise. model: with the stuck root and contacts. rough: about the same motions,
    as a filter leaves them: the frame of reference is that of its first frame, contacts are measured on it.
    """
    size = noise_size(model.layout, model.normaliser, noise.turn, noise.shift)
    whole = size[size > 0].square().mean().sqrt().item() * start.level
    frame = stuck_root(rough)[1]
    local = world_to_local(frame, rough if start.filtered else noisy)
    local = replace(local, contacts=with_contacts(rough).contacts)
    y = model.normaliser.apply(replace(model.layout, frame="world").encode(local))
    ratio = ((1 - model.schedule.alpha_bar) / model.schedule.alpha_bar).log()
    t = int((ratio - 2 * torch.tensor(whole, dtype=ratio.dtype).log()).abs().argmin())
    signal, stamps = model.schedule.alpha_bar[t].sqrt().to(y), model.schedule.stamps[t].expand(len(y))
    more = (whole**2 - size**2).clamp(min=0).sqrt() if start.topped else torch.zeros_like(size)
    total = torch.zeros_like(y)
    for _ in range(start.looks):
        total = total + model.denoiser(signal * (y + more * sampling.noise_like(y, generator)), stamps)
    return local_to_world(frame, model.decode(total / start.looks, noisy.skeleton))


def wiener(rivals: Rivals, motion: Motion, rough: Motion, noise: Noise) -> Motion:
    """The Gaussian's best guess of a motion (B, T) with this noise. rough: about the same motion, less noisy at its
    first frame, which the frame of reference is taken from."""
    frame = stuck_root(rough)[1]
    weight = rivals.ridge + noise_size(rivals.layout, rivals.normaliser, noise.turn, noise.shift).square()
    z = rivals.explained(rivals.encode_in(frame, motion) - rivals.mean_row, (1 / weight).repeat(motion.frames))
    return rivals.decode_in(frame, rivals.mean_row + z @ rivals.factor.mT, motion)


def one_euro(x: Tensor, fps: float, min_cutoff: float, beta: float) -> Tensor:
    """Smooths x (..., T, D) by the one-euro filter (Casiez et al. 2012): a causal low-pass that opens with speed.

    min_cutoff: Hz, at rest. beta: Hz per (unit of x / s).
    """
    frames, alpha = x.unbind(-2), lambda cutoff: 1 / (1 + fps / (2 * torch.pi * cutoff))
    speed, out = torch.zeros_like(frames[0]), [frames[0]]
    for before, now in pairwise(frames):
        speed = torch.lerp(speed, (now - before) * fps, alpha(1.0))
        out.append(torch.lerp(out[-1], now, alpha(min_cutoff + beta * speed.abs())))
    return torch.stack(out, -2)


def filtered(motion: Motion, name: str, **settings: float) -> Motion:
    """A motion through one of ``FILTERS``: rotations in radians about their mean, the root in metres.

    The Kalman smoother's strength of acceleration is per unit of noise.
    """
    apply, _ = FILTERS[name]
    return baselines.smooth(motion, lambda x: apply(x, motion.fps, **settings))


FILTER, GAUSSIAN = "filter", "Gaussian"
FILTERS: Mapping[str, tuple[Callable, Mapping[str, Sequence]]] = {
    "Savitzky-Golay": (
        lambda x, fps, **settings: baselines.savitzky_golay(x, **settings),
        {"window": (5, 7, 9, 13, 17, 21), "degree": (2, 3)},
    ),
    "one euro": (one_euro, {"min_cutoff": (0.5, 1.0, 2.0, 4.0, 8.0), "beta": (0.0, 1.0, 4.0)}),
    "Kalman smoother": (  # only their ratio matters
        baselines.kalman, {"noise": (1.0,), "acceleration": (3.0, 10.0, 30.0, 100.0, 300.0)}
    ),
}  # fmt: skip
#: Degrees about each axis of every joint, centimetres of the root, correlation of one frame with the next: 0.935 is
#: forgotten in half a second.
NOISES: Mapping[str, tuple[float, ...]] = {
    "noise of 5 deg, 2 cm": (5.0, 2.0), "noise of 10 deg, 4 cm": (10.0, 4.0), "lasting noise, 5 deg": (5.0, 2.0, 0.935),
}  # fmt: skip
#: How P may go back: which is best is found on the validation people.
STARTS = (
    *(ReverseProcess(level=level, looks=4) for level in (0.7, 1.0, 1.4)),
    *(ReverseProcess(level=level, topped=False) for level in (0.7, 1.0, 1.4)),
    *(ReverseProcess(level=level, looks=4, filtered=True) for level in (0.2, 0.5)),
)


def contest(title: str, m: Models, cast: Cast, starts: Sequence[ReverseProcess]) -> dict[str, Result]:
    """Everybody on one of ``NOISES``: errors of all joints, their settings chosen on the validation people."""
    noise = Noise.of(*NOISES[title])
    noisy = [noise.on(w.motion, torch.Generator().manual_seed(k)) for k, w in enumerate((cast.val, cast.test))]
    settings = [(n, dict(zip(by, x, strict=True))) for n, (_, by) in FILTERS.items() for x in product(*by.values())]
    best, tuned = min(settings, key=lambda s: float(_off(filtered(noisy[0], s[0], **s[1]), cast.val.motion).mean()))
    rough = [filtered(x, best, **tuned) for x in noisy]

    ways: dict[str, tuple[Callable[[int, object], Motion], Sequence]] = {
        FILTER: (lambda k, _: rough[k], (f"{best} {tuned}",)),
        GAUSSIAN: (lambda k, w: wiener(replace(m.rivals, ridge=w), noisy[k], rough[k], noise), RIDGES),
        R: (lambda k, _: _corrected(noisy[k], noise), ("completer_rough",)),
        P: (lambda k, s: denoise(m.p, noisy[k], rough[k], noise, torch.Generator().manual_seed(k), s), starts),
    }
    found = {}
    for name, (make, options) in ways.items():
        aims = [float(by_person(_off(make(0, o), cast.val.motion), cast.val.whose).mean()) for o in options]
        setting = options[aims.index(min(aims))]
        error = _off(make(1, setting), cast.test.motion)
        found[name] = Result({ERROR: error, SCORE: error}, setting, name in (FILTER, GAUSSIAN))
    return found


def _corrected(noisy: Motion, noise: Noise) -> Motion:
    smooth = with_contacts(denoised(noisy, noise))
    nothing = torch.zeros(*smooth.root.shape[:2], UNITS, dtype=torch.bool)
    return completer.load("completer_rough").complete(smooth, nothing, tremble=noise.turn)


def _off(made: Motion, truth: Motion) -> Tensor:
    nothing = torch.zeros(*truth.root.shape[:2], UNITS, dtype=torch.bool)
    return bench.error_cm(made, truth, nothing)
