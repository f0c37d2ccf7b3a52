"""Does stage 3 earn its time? Smoothers beside the stages, and what is measured of all on the same clips.

Source: HuMoR (Rempe et al. 2021), section 5.2: global errors without alignment, of joints with 4 cm of noise and of
joints seen only above 0.9 m.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from motionlab.baselines import kalman, nearest_known, savitzky_golay
from motionlab.contact import contacts_from_positions, resting_heights
from motionlab.humor import start as starts
from motionlab.humor.evidence import Observation3D, evidence
from motionlab.metrics import gait, pose
from motionlab.motion import Motion
from motionlab.skeleton import FEET, STANDARD, fk

CM = 100.0


@dataclass(frozen=True)
class Smoother:
    """A baseline without a model of motion: the mean pose laid onto what is seen, and what differs from it smoothed.

    Where a joint was seen its offset from the mean pose is known; between, it is interpolated; a joint that never was
    seen keeps the mean pose. Then a filter over time. kind: "savitzky-golay" (a frames, degree b) or "kalman" (noise a
    in metres, acceleration b).
    """

    kind: str
    a: float
    b: float

    def __call__(self, observation: Observation3D, rest: Tensor) -> Tensor:
        """Positions (B, T, 22, 3), metres. rest (22, 3): the mean pose, root at the origin."""
        seen = evidence(observation)
        trans, turn = starts.interpolate_unseen(*starts.start_3d(seen, rest), seen.fps)
        placed = rest @ turn.mT + trans[..., None, :]
        offset = _interpolated(seen.values - placed, seen.weight > 0)
        whole = (placed + offset).flatten(-2)
        if self.kind == "kalman":
            return kalman(whole, seen.fps, self.a, self.b).unflatten(-1, (-1, 3))
        window = min(int(self.a), whole.shape[1] - 1 + whole.shape[1] % 2)
        smooth = savitzky_golay(whole, window, int(self.b)) if window > self.b else whole
        return smooth.unflatten(-1, (-1, 3))


def _interpolated(x: Tensor, known: Tensor) -> Tensor:
    """x (B, T, J, 3) where known (B, T, J), linear between, held beyond; zero for what is never known."""
    time = torch.arange(x.shape[1])[:, None]
    before, after = (at.mT for at in nearest_known(known.mT))
    share = ((time - before) / (after - before).clamp(min=1))[..., None].clamp(0, 1).to(x)
    low, high = (x.gather(1, at[..., None].expand_as(x)) for at in (before, after))
    return torch.where(~known.any(1)[:, None, :, None], 0.0, torch.lerp(low, high, share))


#: What is tried of either kind.
FILTERS = (
    [Smoother("savitzky-golay", a, b) for a, b in product((5, 7, 9, 11, 15, 21), (2, 3))],
    [Smoother("kalman", 0.04, b) for b in (0.3, 0.6, 1.0, 2.0, 4.0, 8.0)],
)


def tuned(candidates: Iterable[Smoother], observation: Observation3D, truth: Tensor, rest: Tensor) -> Smoother:
    """The smoother with the least mean error on validation clips, truth (B, T, 22, 3)."""
    return min(candidates, key=lambda s: float((s(observation, rest) - truth).norm(dim=-1).mean()))


def mean_pose(pose_prior) -> Tensor:
    """Joints (22, 3) of the pose prior's zero latent: root at the origin, orientation identity."""
    with torch.no_grad():
        body = torch.cat((torch.eye(3)[None], pose_prior.decode(torch.zeros(32))))
    return fk(STANDARD, torch.zeros(3), body)[0]


def measures(p: Tensor, truth: Motion, visible: Tensor) -> dict[str, Tensor]:
    """Errors of positions (B, T, 22, 3) by measure, each (B,): world, no alignment; NaN where nothing of a kind is
    there.

    truth (B, T) with contacts; visible (B, T, 22). Contacts follow from the heights and speeds of joints. slide: of
    feet where the true foot stands, mm per frame.
    """
    t, skeleton = truth.positions, truth.skeleton
    seen, hidden = pose.mpjpe_visible_occluded(p, t, visible.bool(), align="none")
    feet = skeleton.indices(list(FEET))
    touching = contacts_from_positions(p[..., skeleton.contact_indices, :], truth.fps, resting_heights(STANDARD))
    return {
        "all cm": CM * pose.mpjpe(p, t, align="none"),
        "visible cm": CM * seen,
        "hidden cm": CM * hidden,
        "acceleration error m/s^2": pose.acceleration_error(p, t, truth.fps),
        "contact F1": gait.contact_scores(touching, truth.contacts).f1,
        "slide mm": gait.slide_where_truth_stands_mm(p[..., feet, :], t[..., feet, :]),
    }
