"""Motion: the value that travels, and what can be done to any motion."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.skeleton import Skeleton, fk

FPS = 30.0  # frames per second of what priors and models know


@dataclass(frozen=True, eq=False)
class Motion:
    """A batch of skeletal motions. Metres, seconds, z up, right-handed; local rotation matrices, column vectors.

    root (..., T, 3): position of joint 0 (the pelvis), world.
    rot (..., T, J, 3, 3): each joint relative to its parent; joint 0 relative to the world.
    fps: frames per second.
    contacts (..., T, C) or None: 1 where the joint named in skeleton.contact_names touches the floor.
    name: where it came from, for tables and messages.
    notes: what a loader had to decide or guess (unit, up axis, dropped channels), one sentence each.

    Raises:
        ShapeError: the arrays do not fit each other or the skeleton, or fps is not positive.
    """

    skeleton: Skeleton
    root: Tensor
    rot: Tensor
    fps: float
    contacts: Tensor | None = None
    name: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_shape(self.rot, f"... T {len(self.skeleton)} 3 3", "rot")
        batch = self.rot.shape[:-3]
        for name, x, size in (("root", self.root, 3), ("contacts", self.contacts, len(self.skeleton.contact_names))):
            if x is not None and x.shape != (*batch, size):
                raise ShapeError(f"{name}: expected shape {(*batch, size)} as of rot, got {tuple(x.shape)}")
        if not 0 < self.fps < math.inf:
            raise ShapeError(f"fps: expected a positive number, got {self.fps}")

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return self.root.shape[-2]

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last, plus one frame."""
        return self.frames / self.fps

    @cached_property
    def world(self) -> tuple[Tensor, Tensor]:
        """Joint positions (..., T, J, 3) and orientations (..., T, J, 3, 3), world."""
        return fk(self.skeleton, self.root, self.rot)

    @property
    def positions(self) -> Tensor:
        """Joint positions (..., T, J, 3), metres, world."""
        return self.world[0]

    def cut(self, start: int | None = None, stop: int | None = None, step: int | None = None) -> Self:
        """Frames start:stop:step; a step divides the frame rate."""
        pick, every = slice(start, stop, step), slice(None)
        return self._each(lambda x, after: x[(..., pick, *after * [every])], fps=self.fps / (step or 1))

    def clip(self, index) -> Self:
        """One entry (or a slice) of the leading batch axis, with its own skeleton where each has one."""
        offsets = self.skeleton.offsets
        if offsets.ndim == self.rot.ndim - 1:  # (N or 1, ..., 1, J, 3)
            offsets = offsets.expand(len(self.rot), *offsets.shape[1:])[index]
            offsets = offsets[0] if self.rot[index].ndim == 4 and len(offsets) == 1 else offsets
        return self._each(lambda x, _: x[index], skeleton=replace(self.skeleton, offsets=offsets))

    def to(self, *args, **kwargs) -> Self:
        """Every tensor on another device or of another dtype."""
        return self._each(lambda x, _: x.to(*args, **kwargs), skeleton=self.skeleton.to(*args, **kwargs))

    def _each(self, change: Callable[[Tensor, int], Tensor], **rest) -> Self:
        """Every tensor of frames changed, by a function that is told how many axes come after time."""
        contacts = None if self.contacts is None else change(self.contacts, 1)
        return replace(self, root=change(self.root, 1), rot=change(self.rot, 3), contacts=contacts, **rest)


def single(motion: Motion, path: object = None) -> Motion:
    """Returns the motion itself, if it is one clip of one body, of at least one frame, all of its numbers finite.

    Raises:
        ShapeError: batch axes or no frames. DataError: NaN or infinity; names ``path`` (or the motion) and the frame.
    """
    path = path or motion.name or "motion"
    if motion.root.ndim != 2 or motion.skeleton.offsets.ndim != 2:
        got = f"a batch of root {tuple(motion.root.shape)}, offsets {tuple(motion.skeleton.offsets.shape)}"
        raise ShapeError(f"{path}: expected one clip of one body, got {got}; take one with motion.clip(i)")
    if motion.frames == 0:
        raise ShapeError(f"{path}: a motion without frames")
    finite = motion.rot.isfinite().flatten(1).all(1) & motion.root.isfinite().all(1)
    if not finite.all():
        place = f"frame {int((~finite).nonzero()[0])}"
        raise DataError("numbers that are not finite", path=path, place=place, remedy="cut or fill those frames")
    return motion


def velocity(x: Tensor, fps: float, dim: int) -> Tensor:
    """Computes rates of change per second by central differences, one-sided at the ends, as in HuMoR's states; one
    frame gives zeros."""
    if x.shape[dim] < 2:
        return torch.zeros_like(x)
    return torch.gradient(x, spacing=1.0 / fps, dim=dim)[0]


def backward_velocity(x: Tensor, fps: float, dim: int) -> Tensor:
    """Computes rates of change per second by backward differences, which know the past only; the first is the second's,
    one frame gives zeros."""
    if x.shape[dim] < 2:
        return torch.zeros_like(x)
    rate = x.diff(dim=dim) * fps
    return torch.cat((rate.narrow(dim, 0, 1), rate), dim)


def runs(on: Tensor) -> list[tuple[int, int]]:
    """Returns begin and end of every run of True (T,)."""
    edges = torch.nn.functional.pad(on.int(), (1, 1)).diff()
    return list(zip((edges == 1).nonzero()[:, 0].tolist(), (edges == -1).nonzero()[:, 0].tolist(), strict=True))


def resample(motion: Motion, fps: float, how: str = "linear", times: Sequence[float] | None = None) -> Motion:
    """Computes a motion at another frame rate; contacts by the nearest frame.

    The first frame stays; the last sample is the last that lies inside the recording.

    Args:
        how: "linear": positions linearly, rotations by slerp. "spline": cubic splines through positions and through
            unit quaternions of one sign, normed again; its accelerations are nearer to the truth (docs/experiments.md).
        times: seconds (T,) of its frames, rising from 0, where they do not come at even times.

    Raises:
        ShapeError: fps is not a positive number.
        ValueError: no such way.
    """
    if not 0 < fps < math.inf:
        raise ShapeError(f"fps: expected a positive number, got {fps}")
    if how not in ("linear", "spline"):
        raise ValueError(f"how: expected 'linear' or 'spline', got {how!r}")
    if fps == motion.fps and times is None:
        return motion
    last = (motion.frames - 1) / motion.fps if times is None else times[-1]
    at = torch.arange(int(last * fps + (1e-6 if times is None else 1e-3)) + 1, dtype=torch.float64)
    at = at * (motion.fps / fps) if times is None else torch.from_numpy(np.interp(at / fps, times, range(len(times))))
    low = at.floor().long().clamp(max=max(motion.frames - 2, 0))
    high = (low + 1).clamp(max=motion.frames - 1)
    weight = (at - low).to(motion.root)
    near = at.round().long().clamp(max=motion.frames - 1)
    if how == "spline" and motion.frames > 3:
        signed = rotation.unroll_quaternion(rotation.matrix_to_quaternion(motion.rot), dim=-3)
        root, rot = _spline(motion.root, at, -2), rotation.quaternion_to_matrix(_spline(signed, at, -3))
    else:
        root = torch.lerp(motion.root[..., low, :], motion.root[..., high, :], weight[:, None])
        rot = rotation.slerp(motion.rot[..., low, :, :, :], motion.rot[..., high, :, :, :], weight[:, None])
    contacts = None if motion.contacts is None else motion.contacts[..., near, :]
    return replace(motion, fps=float(fps), root=root, rot=rot, contacts=contacts)


def _spline(x: Tensor, at: Tensor, dim: int) -> Tensor:
    """A cubic spline through x at times ``at``, in frames, along its axis ``dim``."""
    from scipy.interpolate import CubicSpline

    return torch.from_numpy(CubicSpline(range(x.shape[dim]), x.double().numpy(), axis=dim)(at.numpy())).to(x)


def windows(motion: Motion, length: int, stride: int) -> Motion:
    """Cuts a motion into all windows of ``length`` frames, ``stride`` apart, on a new leading axis (N, ..., length).

    Raises:
        ShapeError: the motion is shorter than one window, or length or stride is below 1.
    """
    if min(length, stride) < 1:
        raise ShapeError(f"windows: expected a length and a stride of at least 1, got {length} and {stride}")
    if motion.frames < length:
        raise ShapeError(f"{motion.name or 'motion'}: {motion.frames} frames are fewer than one window of {length}")

    def unfold(x: Tensor, rest: int) -> Tensor:  # (..., T, rest) -> (N, ..., length, rest)
        dim = x.ndim - 1 - rest
        return x.unfold(dim, length, stride).movedim(-1, dim + 1).movedim(dim, 0)

    return motion._each(unfold)


def mirror(motion: Motion) -> Motion:
    """Mirrors a motion in the world's plane x = 0: left becomes right.

    R'_j = M R_partner(j) M, M = diag(-1, 1, 1); root, contacts and bones likewise.

    Raises:
        ShapeError: no two joints are named left_... and right_..., so that nothing says what changes places.
    """
    flip = motion.root.new_tensor([-1.0, 1.0, 1.0])
    partner = motion.skeleton.mirror_indices
    if partner == list(range(len(partner))):
        raise ShapeError(f"no left_ and right_ joints among {', '.join(motion.skeleton.names[:6])}: retarget first")
    names = motion.skeleton.contact_names
    swapped = [names.index(motion.skeleton.names[partner[j]]) for j in motion.skeleton.contact_indices]
    offsets = motion.skeleton.offsets[..., partner, :] * flip.to(motion.skeleton.offsets)
    return replace(
        motion,
        skeleton=replace(motion.skeleton, offsets=offsets),
        root=motion.root * flip,
        rot=flip[:, None] * motion.rot[..., partner, :, :] * flip,
        contacts=None if motion.contacts is None else motion.contacts[..., swapped],
    )


def fix_root_horizontally(motion: Motion) -> Motion:
    """Holds the root above (0, 0) at every frame, height and orientation as they were; contacts are dropped.

    Source: thesis 4.1.2, the first version of its data.
    """
    return replace(motion, root=motion.root * torch.tensor([0.0, 0.0, 1.0]).to(motion.root), contacts=None)
