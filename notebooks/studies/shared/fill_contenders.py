"""Who fills in: rivals without a network, our two networks, and the thesis's model.

Most recordings are of a figure without toes and with a stiff back. Nobody is asked for a joint that a figure does not
have. Rivals are told of it, whatever it holds; networks, which learnt never to be, are not.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from motionlab.baselines import interpolate
from motionlab.bench import RIDGES, Rivals
from motionlab.diffusion import completer, features
from motionlab.diffusion.completer import Completer, guess
from motionlab.diffusion.features import units
from motionlab.diffusion.model import MotionDiffusion, motion_model
from motionlab.diffusion.sampling import Inpainting
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import Motion
from motionlab.training.training_loop import fast_halves
from studies.shared.fill_people import Cast

R, T, P, GUIDED = "R", "T", "P, Eq. 4.10", "P, guided"
GAUSSIAN, NEAREST = "Gaussian, six draws", "nearest six"
STEPS = 10  # of T's sampler
_FEW = 6  # windows of a person that P is judged on where one answer is right
FADES = (0, 5, 10)  # frames over which a rival's jump at the edge of what is known may fade
EDGE = 10  # frames over which edges are mixed or blended
#: How P, which is told nothing, is made to keep what is known.
PLAIN = Inpainting(steps=50)  # Eq. 4.10; 250 steps left no less
LEFT = Inpainting(steps=50, replace_last=False)  # not written back after the last step
MIXED = Inpainting(steps=50, replace_last=False, blend_frames=EDGE)  # and then mixed with what is known
BLENDED = Inpainting(steps=50, mask_ramp=EDGE)  # 4.2.5
_GUIDED = Inpainting(guidance_weight=1.0, steps=25)
_GUIDED_IN_TIME = replace(_GUIDED, replace_last=False, blend_frames=EDGE)
#: Guided, by whether a case has edges in time, and whether every window has a mask of its own: chosen on validation
#: people, of weights 1 to 20, 25 and 50 steps, with and without the last writing back.
GUIDANCE = {
    (False, False): _GUIDED, (False, True): _GUIDED, (True, True): _GUIDED_IN_TIME,
    (True, False): replace(_GUIDED_IN_TIME, guidance_weight=5.0),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Contender:
    """fill: (motion, known, setting, seed) -> motion. settings: to choose from, by edges in time and by masks of which
    every window has its own. draws: how many, where there is more than one answer. told: of joints that a figure lacks.
    rival: has no network. few: windows of a person that it is judged on where one answer is right; 0: all.
    """

    fill: Callable[[Motion, Tensor, object, int], Motion]
    settings: Callable[[bool, bool], Sequence] = lambda edges, scattered: (None,)
    draws: int = 1
    told: bool = True
    rival: bool = True
    few: int = 0


@dataclass(frozen=True, eq=False)
class Models:
    """r, t: told what is known, without noise and with it. p: the thesis's, told nothing. rivals: fitted. most: steps
    of P's sampler."""

    r: Completer
    t: Completer
    p: MotionDiffusion
    rivals: Rivals
    most: int = 1000

    def drawn(self, motion: Motion, known: Tensor, seed: int, steps: int = STEPS) -> Motion:
        """One draw of T, in so many steps of its sampler."""
        return self.t.complete(motion, known, torch.Generator().manual_seed(seed), steps=steps)

    def plain(self, motion: Motion, known: Tensor, way: Inpainting, seed: int) -> Motion:
        """One draw of P."""
        way = replace(way, steps=min(way.steps, self.most))
        return self.p.inpaint(motion, known[..., units(self.p.layout)], torch.Generator().manual_seed(seed), way)

    def curves(self, motion: Motion, known: Tensor) -> Motion:
        """What R adds to: smooth curves through what is known."""
        local, frame = stuck_root(motion)
        if local.contacts is None:
            local = replace(local, contacts=motion.root.new_zeros(*motion.root.shape[:-1], 9))
        made = features.motion_of(guess(local, known, *self.r.sizes), local)
        return local_to_world(frame, replace(made, contacts=None))

    def ridge(self, motion: Motion, known: Tensor, how: tuple[float, int], seed: int | None) -> Motion:
        """The Gaussian's mean, or a draw of it. how: its ridge, and frames over which a jump fades."""
        draw = None if seed is None else torch.Generator().manual_seed(seed)
        return replace(self.rivals, ridge=how[0]).regression(motion, known, how[1], draw)


class Halved(nn.Module):
    """A denoiser that computes in bfloat16: where that is fast, twice as fast, and off by about a millimetre. exact:
    so many steps at the end are not; there it shakes. lot: what it computes at a time."""

    def __init__(self, inner: nn.Module, exact: int = 0, lot: int = 1_000_000) -> None:
        super().__init__()
        self.inner, self.exact, self.lot = inner, exact, lot

    def forward(self, x: Tensor, stamps: Tensor) -> Tensor:
        """Computes as ``inner`` does."""
        with torch.autocast("cpu", torch.bfloat16, enabled=int(stamps[0]) >= self.exact):
            lots = zip(x.split(self.lot), stamps.split(self.lot), strict=True)
            return torch.cat([self.inner(*some).float() for some in lots])


def everybody_of(
    folder: Path | str | None, *, each: int = 24, practice: int = 3, library: int = 15_000, parts: int = 256,
    most: int = 1000, draws: int = 6, halves: bool = True,
) -> tuple[Cast, Models, Mapping[str, Contender]]:  # fmt: skip
    """Windows, models, and contenders by name. each, practice: windows of each test person, and of validation people.
    library, parts: windows that rivals learn from, and parts of the Gaussian. most: steps of P's sampler. halves:
    compute in bfloat16 where that is fast."""
    cast = Cast.of(folder, each, practice, library, torch.Generator().manual_seed(0))
    fitted = Rivals.fit(cast.learnt, torch.Generator().manual_seed(1), parts=parts)
    r, t, p = completer.load("completer"), completer.load("completer_draws"), motion_model("diffusion_plain")
    if halves and fast_halves():
        t.halves, p = True, replace(p, denoiser=Halved(p.denoiser))
    models = Models(r, t, p, fitted, most)
    return cast, models, _contenders(models, cast.clips, draws)


def _contenders(m: Models, clips: Tensor, draws: int) -> Mapping[str, Contender]:
    def fades(edges: bool, scattered: bool) -> Sequence[int]:
        return FADES if edges and not scattered else (0,)

    def ridges(edges: bool, scattered: bool) -> Sequence[tuple[float, int]]:
        some = RIDGES[:: 1 + scattered]  # a mask for every window takes its time
        return [(w, fade) for w in some for fade in fades(edges, scattered)]

    def in_time(edges: bool, scattered: bool) -> Sequence[None]:
        return (None,) if edges else ()

    def near(motion: Motion, known: Tensor, fade: int, seed: int) -> Motion:
        return m.rivals.nearest(motion, known, fade, rank=seed, clips=clips)

    ours = {"told": False, "rival": False}
    slow = ours | {"draws": 2, "few": _FEW}
    return {
        "slerp": Contender(lambda x, k, *_: interpolate(x, k[..., :-2]), in_time),
        "curves": Contender(lambda x, k, *_: m.curves(x, k), in_time),
        "nearest": Contender(lambda x, k, how, _: m.rivals.nearest(x, k, how), fades),
        "Gaussian": Contender(lambda x, k, how, _: m.ridge(x, k, how, None), ridges),
        NEAREST: Contender(near, fades, draws),
        GAUSSIAN: Contender(m.ridge, ridges, draws),
        R: Contender(lambda x, k, *_: m.r.complete(x, k), **ours),
        T: Contender(lambda x, k, _, seed: m.drawn(x, k, seed), draws=draws, **ours),
        P: Contender(m.plain, lambda edges, scattered: (PLAIN,), **slow),
        GUIDED: Contender(m.plain, lambda edges, scattered: (GUIDANCE[edges, scattered],), **slow),
    }
