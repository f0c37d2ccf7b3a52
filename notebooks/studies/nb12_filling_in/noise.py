"""Noise on every joint: filters, a Gaussian, the thesis's model gone back from the step that is as noisy, and R, here
the network that learnt what to add behind a smoother; it is told how large the noise is, which the others are tuned to.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.bench import cases, rivals
from motionlab.bench.person_windows import by_person
from motionlab.bench.rivals import RIDGES
from motionlab.contact import with_contacts
from motionlab.diffusion import completer
from motionlab.diffusion.denoising import Noise, smoothed
from motionlab.diffusion.state import UNITS
from motionlab.motion import Motion
from studies.nb12_filling_in.going_back import ReverseProcess, denoise
from studies.shared.fill_bench import ERROR, SCORE, Result
from studies.shared.fill_contenders import Models, P, R
from studies.shared.fill_people import Cast

FILTER, GAUSSIAN = "filter", "Gaussian"
#: Degrees about each axis of every joint, centimetres of the root, correlation of one frame with the next: 0.935 is
#: forgotten in half a second.
NOISES: Mapping[str, tuple[float, ...]] = {
    "noise of 5 deg, 2 cm": (5.0, 2.0), "noise of 10 deg, 4 cm": (10.0, 4.0), "lasting noise, 5 deg": (5.0, 2.0, 0.935),
}  # fmt: skip
#: How P may go back: which is best is found on the people who choose.
STARTS = (
    *(ReverseProcess(level=level, looks=4) for level in (0.7, 1.0, 1.4)),
    *(ReverseProcess(level=level, topped=False) for level in (0.7, 1.0, 1.4)),
    *(ReverseProcess(level=level, looks=4, filtered=True) for level in (0.2, 0.5)),
)


def contest(title: str, m: Models, cast: Cast, starts: Sequence[ReverseProcess]) -> dict[str, Result]:
    """Everybody on one of ``NOISES``: errors of all joints, their settings chosen on the people who choose."""
    noise = Noise.of(*NOISES[title])
    noisy = [noise.on(w.motion, torch.Generator().manual_seed(k)) for k, w in enumerate((cast.practice, cast.report))]
    tuned = {n: rivals.tune(n, noisy[0], cast.practice.motion) for n in rivals.FILTERS}
    best = cases.chosen(list(tuned), lambda n: rivals.filtered(noisy[0], n, **tuned[n]), cast.practice.motion)
    rough = [rivals.filtered(x, best, **tuned[best]) for x in noisy]

    ways: dict[str, tuple[Callable[[int, object], Motion], Sequence]] = {
        FILTER: (lambda k, _: rough[k], (f"{best} {tuned[best]}",)),
        GAUSSIAN: (lambda k, w: replace(m.rivals, ridge=w).wiener(noisy[k], rough[k], noise.turn, noise.shift), RIDGES),
        R: (lambda k, _: _corrected(noisy[k], noise), ("completer_rough",)),
        P: (lambda k, s: denoise(m.p, noisy[k], rough[k], noise, torch.Generator().manual_seed(k), s), starts),
    }
    found = {}
    for name, (make, options) in ways.items():
        aims = [float(by_person(_off(make(0, o), cast.practice.motion), cast.practice.whose).mean()) for o in options]
        setting = options[aims.index(min(aims))]
        error = _off(make(1, setting), cast.report.motion)
        found[name] = Result({ERROR: error, SCORE: error}, setting, name in (FILTER, GAUSSIAN))
    return found


def _corrected(noisy: Motion, noise: Noise) -> Motion:
    smooth = with_contacts(smoothed(noisy, noise))
    nothing = torch.zeros(*smooth.root.shape[:2], UNITS, dtype=torch.bool)
    return completer.load("completer_rough").complete(smooth, nothing, tremble=noise.turn)


def _off(made: Motion, truth: Motion) -> Tensor:
    nothing = torch.zeros(*truth.root.shape[:2], UNITS, dtype=torch.bool)
    return cases.error_cm(made, truth, nothing)
