"""Generators that anybody could write down, of training windows: what the model must beat."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.animate.foot_locking import lock_feet
from motionlab.bench import Rivals
from motionlab.contact import with_contacts
from motionlab.diffusion import completer
from motionlab.heading import Frame, heading_frame, local_to_world, world_to_local, world_to_local_positions
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb11_new_motion.cast import FRAMES, Cast
from studies.shared.generated import Judged, frechet

PARTS = (8, 32, 128, 384)  # of the Gaussian: how many principal parts it keeps
CUTS = tuple(range(15, 46, 3))  # frames at which two windows may meet
SIMPLE = ("Gaussian, planted", "spliced windows", "a pose held")  # of ``everybody``: those without a network
_FADE = 4  # frames on either side of a cut over which one window turns into the other


def nothing(count: int) -> tuple[Motion, Tensor]:
    """Windows (count, T) of which nothing is known, and that mask (count, T, U)."""
    still = torch.eye(3).expand(count, FRAMES, len(STANDARD), 3, 3)
    motion = Motion(STANDARD, torch.zeros(count, FRAMES, 3), still, 30.0)
    return motion, torch.zeros(count, FRAMES, len(STANDARD) + 2, dtype=torch.bool)


def gaussian(cast: Cast, windows: int, count: int, generator: torch.Generator) -> tuple[Motion, int]:
    """Draws of a Gaussian over whole windows, feet planted where they stand, and how many principal parts it keeps: as
    many as bring it nearest to the validation people (Frechet)."""
    val, blank = Judged.of(cast.val), nothing(count)
    fitted = Rivals.fit(cast.training(windows, generator), generator, parts=max(PARTS))

    def draw(parts: int) -> Motion:
        fewer = replace(fitted, factor=fitted.factor[:, -parts:])
        return lock_feet(with_contacts(fewer.regression(*blank, generator=generator)))

    best = min(PARTS, key=lambda parts: frechet(Judged.of(draw(parts)), val))
    return draw(best), best


def held(cast: Cast, count: int, generator: torch.Generator) -> Motion:
    """Training windows whose first pose is held."""
    motion = cast.training(count, generator)
    return replace(motion, root=motion.root[:, :1].expand_as(motion.root), rot=motion.rot[:, :1].expand_as(motion.rot))


def spliced(cast: Cast, windows: int, count: int, generator: torch.Generator) -> Motion:
    """Training windows that go on as another one, of another recording, from the cut where the two are most alike in
    pose and velocity (a motion graph's best edge, Kovar et al. 2002), blended over eight frames."""
    drawn, clip = cast.learnt.drawn(windows, generator)
    motion = Motion(STANDARD, drawn.root, drawn.rot, drawn.fps)
    points, same = motion.positions, clip[:count, None] == clip
    apart = []
    for cut in CUTS:
        frame = heading_frame(motion.root[:, cut], motion.rot[:, cut, 0])
        near = [world_to_local_positions(frame, points[:, at]).flatten(1) for at in (cut - 1, cut, cut + 1)]
        apart.append(torch.cdist(torch.cat(near, 1)[:count], torch.cat(near, 1)).masked_fill(same, torch.inf))
    best = torch.stack(apart, 1).flatten(1).argmin(1)
    cut, other = torch.tensor(CUTS)[best // windows], best % windows
    return joined(motion.clip(torch.arange(count)), motion.clip(other), cut)


def joined(first: Motion, second: Motion, cut: Tensor) -> Motion:
    """Windows (N, T) that turn into others (N, T) about a frame (N,), the second moved to where the first is."""
    rows = torch.arange(len(cut))
    there, here = (heading_frame(m.root[rows, cut], m.rot[rows, cut, 0]) for m in (second, first))
    wide = [Frame(f.turn[:, None], f.shift[:, None]) for f in (here, there)]
    second = local_to_world(wide[0], world_to_local(wide[1], second))
    weight = ((torch.arange(first.frames) - cut[:, None] + _FADE) / (2 * _FADE)).clamp(0, 1)
    root = torch.lerp(first.root, second.root, weight[..., None])
    return replace(first, root=root, rot=rotation.slerp(first.rot, second.rot, weight[..., None]), contacts=None)


def everybody(
    cast: Cast, windows: int, count: int, generator: Callable[[str], torch.Generator]
) -> tuple[dict[str, Motion], int]:
    """All that stands beside the model: name -> windows (count, T); and how many parts the Gaussian keeps."""
    normal, parts = gaussian(cast, windows, count, generator("Gaussian"))
    return {
        "training people": cast.training(count, generator("people who train")),  # the record's seed
        "Gaussian, planted": normal,
        "spliced windows": spliced(cast, windows, count, generator("spliced")),
        "a pose held": held(cast, count, generator("held")),
        "T, ours": completer.load("completer_draws").complete(*nothing(count), generator("T"), steps=10),
    }, parts
