"""Training losses of the denoiser: on its numbers, its joints, their changes, and feet that should stand.

Source: thesis Eqs. 4.8 and 4.9.
Differs: ``simple`` and ``velocity`` are means over the numbers of a frame, of normalised numbers (MDM), where the
thesis sums: 1 is a network that knows nothing. Positions are metres, not normalised values (EDGE)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.diffusion.features import Layout, Normaliser
from motionlab.errors import check_shape


def denoising_losses(
    estimate: Tensor,
    truth: Tensor,
    layout: Layout,
    normaliser: Normaliser,
    offsets: Tensor,
    *,
    parts: Collection[str] = ("simple", "fk", "velocity", "contact"),
    seen: Tensor | None = None,
) -> dict[str, Tensor]:
    """Computes the training losses by name, each a mean over windows and frames.

    simple: mean square of normalised numbers. velocity: of their change between frames, root and rotations only.
    fk: squared distance of the joints from the truth's, summed over joints, m^2. contact: squared way between frames of
    joints that touch the floor, times how surely they do, summed over joints, m^2.

    Args:
        estimate, truth: x_0 (B, T, D), normalised. offsets: (B or 1, J, 3) metres, the bodies'. seen: (B, D), False for
            numbers that were not recorded: the truth stands in for them, so that no part learns from them.
    Raises:
        ShapeError: the rows are not the layout's.
    """
    check_shape(estimate, f"B T {layout.size}", "estimate")
    check_shape(truth, f"B T {layout.size}", "truth")
    if seen is not None:
        estimate = torch.where(seen[:, None], estimate, truth)
    error, found = estimate - truth, {}
    if "simple" in parts:
        found["simple"] = error.square().mean()
    if "velocity" in parts:
        found["velocity"] = error[..., : layout.slices["pose"].stop].diff(dim=1).square().mean()
    if not {"fk", "contact"} & set(parts):
        return found
    skeleton, rows = replace(layout.skeleton, offsets=offsets[:, None]), normaliser.undo(estimate)
    joints = layout.decode(rows, 1.0, skeleton).positions
    if "fk" in parts:
        true = layout.decode(normaliser.undo(truth), 1.0, skeleton).positions
        found["fk"] = (joints - true).square().sum((-1, -2)).mean()
    if "contact" in parts:
        sure = rows[:, :-1, layout.slices["contacts"], None].clamp(0, 1)
        way = joints[..., skeleton.contact_indices, :].diff(dim=1)
        found["contact"] = (way * sure).square().sum((-1, -2)).mean()
    return found
