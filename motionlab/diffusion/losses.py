"""Training losses of the denoiser: on its numbers, its joints, their changes, and feet that should stand.

Source: thesis Eqs. 4.8 and 4.9; MDM (Tevet et al. 2022), the contacts of the truth; EDGE (Tseng et al. 2023), contacts
that no gradient goes through; CondMDI (Cohan et al. 2024) and thesis 4.4.1, the known area; thesis 4.2.4, handles.
Differs: ``simple`` and ``velocity`` are means over the numbers of a frame, of normalised numbers (MDM), where the
thesis sums: 1 is a network that knows nothing. Positions are metres, not normalised values (EDGE)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.sampling import NoiseSchedule
from motionlab.errors import check_shape

_GATES = ("predicted", "held", "truth")
_PARTS = ("simple", "fk", "velocity", "contact", "known", "handles")
_LATE = ("fk", "contact", "handles")
_FLOOR, _NEAR = 0.01, 0.01  # added to what a guess leaves: normalised numbers, squared; metres


@dataclass(frozen=True)
class LossWeights:
    """How much each part counts; 0 switches it off, and it is not computed.

    fk: per square metre. contact: per square metre moved in a frame. known: only for a model that is told; one that
    starts from what it is told (``spectral``) cannot miss it. handles: per square metre. late: share of the steps
    before ``fk``, ``contact`` and ``handles`` count: the kinematics of a guess that is no pose yet have huge gradients.
    gate: contacts that "predicted" (Eq. 4.9), "held" (the same, no gradient through them) or "truth" (MDM) says.
    by_signal: fk and contact of a window count by alpha_bar of its step, as a guess from pure noise is an average of
    poses, not a pose, or by the share of it that is known, if that is more; not in Eq. 4.9. even: in ``simple`` every
    group of numbers counts alike, so that the root's place is a quarter of it and not 3 numbers of 144; not in Eq. 4.8.
    snr: windows count 1 + min(snr, signal / noise), so that the small errors at little noise, which jitter and sliding
    are made of, count too; 0: all count alike. Hang et al. 2023 have no 1: then nothing is learned where there is
    hardly any signal, and samples begin with a mistake. relative: errors of each window count as shares of
    what the analytic guess leaves (``denoising_losses``), so that short gaps count as hidden legs do; spectral models.
    """

    simple: float = 1.0
    fk: float = 0.05
    velocity: float = 1.0
    contact: float = 5.0
    known: float = 1.0
    handles: float = 0.0
    late: float = 0.2
    gate: str = "predicted"
    by_signal: bool = False
    even: bool = False
    snr: float = 0.0
    relative: bool = False

    def __post_init__(self) -> None:
        if self.gate not in _GATES:
            raise ValueError(f"gate: expected one of {', '.join(_GATES)}, got {self.gate!r}")
        if not all(getattr(self, name) >= 0 for name in (*_PARTS, "late", "snr")):
            raise ValueError("weights: expected numbers of 0 or more")

    def at(self, share: float, layout: Layout, told: bool = False) -> dict[str, float]:
        """Returns the parts that count after a share (0 to 1) of the steps, with their weights."""
        off = set() if share >= self.late else set(_LATE)
        off |= (set() if layout.contacts else {"contact"}) | (set() if told else {"known"})
        return {name: w for name in _PARTS if (w := getattr(self, name)) > 0 and name not in off}

    def counts(self, schedule: NoiseSchedule) -> Tensor:
        """Computes the weight of a window at each noising step (T,); 1 on average."""
        a = schedule.alpha_bar
        count = 1 + (a / (1 - a)).clamp(max=self.snr)
        return count / count.mean()


def denoising_losses(
    estimate: Tensor,
    truth: Tensor,
    layout: Layout,
    normaliser: Normaliser,
    offsets: Tensor,
    *,
    parts: Collection[str] = _PARTS[:4],
    gate: str = "predicted",
    even: bool = False,
    known: Tensor | None = None,
    handles: Tensor | None = None,
    trust: Tensor | None = None,
    count: Tensor | None = None,
    seen: Tensor | None = None,
    guess: Tensor | None = None,
) -> dict[str, Tensor]:
    """Computes the training losses by name, each a mean over windows and frames.

    simple: mean square of normalised numbers. velocity: of their change between frames, root and rotations only.
    fk: squared distance of the joints from the truth's, summed over joints, m^2. contact: squared way between frames of
    joints that touch the floor, times how surely they do, summed over joints, m^2. known: ``simple`` where known.
    handles: squared distance of handles from where they should be, summed over handles, m^2.

    Args:
        estimate, truth: x_0 (B, T, D), normalised. offsets: (B or 1, J, 3) metres, the bodies'. gate, even: see
            ``Weights``. known: (B, T, D) or (T, D), 1 where known. handles: (B, T, J, 4), as ``Denoiser`` takes.
        trust: (B,) what fk, contact and handles of each window count; default 1. count: (B,) what each window counts in
            all parts, 1 on average. seen: (B, D), False for numbers that were not recorded: the truth stands in for
            them, so that no part learns from them. guess: (B, T, D) to correct; simple and velocity of each window and
            group are then divided by the guess's mean square error there plus ``_FLOOR``, fk by the guess's own, mean
            over the window, plus (``_NEAR``)^2 for each joint.
    Raises:
        ShapeError: the rows are not the layout's.
    """
    check_shape(estimate, f"B T {layout.size}", "estimate")
    check_shape(truth, f"B T {layout.size}", "truth")
    if seen is not None:
        estimate, guess = (x if x is None else torch.where(seen[:, None], x, truth) for x in (estimate, guess))
    error, found = estimate - truth, {}
    groups = list(layout.slices.values()) if even else [slice(None)]
    if guess is not None:
        left = (guess - truth).square()
        for part in groups:
            left[..., part] = left[..., part].mean((1, 2), keepdim=True)
        error = error / (left + _FLOOR).sqrt()
    count = torch.ones_like(error[:, 0, 0]) if count is None else count.to(error)
    trust = count if trust is None else trust.to(error) * count
    squared = error.square() * count[:, None, None]
    still = error.new_zeros(()) if error.shape[1] < 2 else None  # one frame does not move
    if "simple" in parts:
        found["simple"] = sum(squared[..., part].mean() for part in groups) / len(groups)
    if "velocity" in parts:
        moving = error[..., : layout.slices["pose"].stop]
        changed = moving.diff(dim=1).square() * count[:, None, None]
        found["velocity"] = still if still is not None else changed.mean()
    if "known" in parts and known is not None:
        known = known.to(error).expand_as(error)
        found["known"] = (known * squared).sum() / known.sum().clamp(min=1.0)
    if not set(parts) & set(_LATE):
        return found
    skeleton, rows = replace(layout.skeleton, offsets=offsets[:, None]), normaliser.undo(estimate)
    joints = layout.decode(rows, 1.0, skeleton).positions
    if "fk" in parts:
        true = layout.decode(normaliser.undo(truth), 1.0, skeleton).positions
        far = (joints - true).square().sum((-1, -2))
        if guess is not None:
            there = layout.decode(normaliser.undo(guess), 1.0, skeleton).positions
            far = far / ((there - true).square().sum((-1, -2)).mean(1, keepdim=True) + len(skeleton) * _NEAR**2)
        found["fk"] = (trust[:, None] * far).mean()
    if "handles" in parts and handles is not None:
        far = (joints - handles[..., :3]).square().sum(-1) * handles[..., 3]
        found["handles"] = (trust[:, None] * far.sum(-1)).mean()
    if "contact" in parts:
        sure = (normaliser.undo(truth) if gate == "truth" else rows)[..., layout.slices["contacts"]]
        sure = sure.detach() if gate == "held" else sure
        way = joints[..., skeleton.contact_indices, :].diff(dim=1)
        slide = (way * sure[:, :-1, :, None].clamp(0, 1)).square().sum((-1, -2))
        found["contact"] = still if still is not None else (trust[:, None] * slide).mean()
    return found
