"""One clip somewhere else, and what each layout makes of it.

Source: thesis 4.1.2: the state in the world, or relative to the first frame ("stuck root").
"""

from itertools import product

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.heading import Frame, local_to_world, stuck_root, world_to_local
from motionlab.motion import Motion

LAYOUTS = [Layout(f, velocities=v, contacts=c) for f, v, c in product(("stuck", "world"), (False, True), (False, True))]


def moved(motion: Motion, degrees: float, metres: float) -> Motion:
    """The same motion (..., T), turned about the vertical through the origin, then shifted along x."""
    turn = rotation.rotation_about("z", torch.tensor(degrees, dtype=torch.float64).deg2rad()).to(motion.root)
    return world_to_local(Frame(turn, turn.mT @ torch.tensor([metres, 0.0, 0.0]).to(motion.root)), motion)


def lost(motion: Motion) -> tuple[Tensor, Tensor]:
    """Writes windows (N, T) as normalised rows in all layouts and reads them back: the largest difference of a root, m,
    or of a rotation, rad, by layout and window; and the same where nobody puts the first frame back."""
    found = []
    for layout in LAYOUTS:
        rows = layout.encode(motion)
        norm = Normaliser.measure(rows, layout)
        read = layout.decode(norm.undo(norm.apply(rows)), motion.fps)
        back = local_to_world(stuck_root(motion)[1], read) if layout.frame == "stuck" else read
        found.append((_differs(back, motion), _differs(read, motion)))
    there, loose = zip(*found, strict=True)
    return torch.cat(there), torch.cat(loose)


def changes(motion: Motion, degrees: float, metres: float) -> dict[str, Tensor]:
    """By frame of reference, the largest change (N,) of a normalised number of windows (N, T) when they are moved."""
    motion, found = motion.to(torch.float64), {}
    for frame in ("stuck", "world"):
        layout = Layout(frame)
        rows = layout.encode(motion)
        norm = Normaliser.measure(rows, layout)
        change = norm.apply(layout.encode(moved(motion, degrees, metres))) - norm.apply(rows)
        found[frame] = change.abs().amax((-1, -2))
    return found


def _differs(a: Motion, b: Motion) -> Tensor:
    place = torch.linalg.vector_norm(a.root - b.root, dim=-1).amax(-1)
    return torch.maximum(place, rotation.geodesic(a.rot, b.rot).amax((-1, -2)))
