"""Labelled points through time: what marker files and joint-position files hold."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.errors import ShapeError, check_shape


@dataclass(frozen=True, eq=False)
class Positions:
    """Labelled 3-D points through time; no rotations, no bones.

    names: the K points, as the file calls them. positions (T, K, 3): metres, world, z up. valid (T, K):
    False where the point was not measured; its position is then 0, never NaN. fps: frames per second.
    name: where it came from. bones: pairs of point indices that keep their distance, for drawing.

    Raises:
        ShapeError: the arrays do not fit the names or each other, or fps is not positive.
    """

    names: tuple[str, ...]
    positions: Tensor
    valid: Tensor
    fps: float
    name: str = ""
    bones: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        check_shape(self.positions, f"T {len(self.names)} 3", "positions")
        if self.valid.shape != self.positions.shape[:-1]:
            expected = tuple(self.positions.shape[:-1])
            raise ShapeError(f"valid: expected shape {expected}, got {tuple(self.valid.shape)}")
        if not self.fps > 0:
            raise ShapeError(f"fps: expected a positive number, got {self.fps}")

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return self.positions.shape[0]

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last, plus one frame."""
        return self.frames / self.fps

    def select(self, names: list[str] | tuple[str, ...]) -> Positions:
        """Some of the points, in the order asked for; KeyError lists the names."""
        for name in names:
            if name not in self.names:
                raise KeyError(f"no point {name!r}; points are {', '.join(self.names)}")
        pick = [self.names.index(name) for name in names]
        bones = tuple((pick.index(a), pick.index(b)) for a, b in self.bones if a in pick and b in pick)
        return replace(
            self, names=tuple(names), positions=self.positions[:, pick], valid=self.valid[:, pick], bones=bones
        )


def axes_to_matrix(axes: str) -> Tensor:
    """Rotation (3, 3) float64, world from file, from three letters: which file axis becomes world x, y and z.

    >>> axes_to_matrix("x-zy") @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)  # y up becomes z up
    tensor([0., 0., 1.], dtype=torch.float64)

    Raises:
        ShapeError: not three different axes, or a left-handed choice, which would mirror the body.
    """
    words = re.fullmatch(r"([+-]?[xyz])([+-]?[xyz])([+-]?[xyz])", axes)
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    for row, word in enumerate(words.groups() if words else ()):
        matrix[row, "xyz".index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    if not torch.linalg.det(matrix) > 0:
        raise ShapeError(f'axes: expected a right-handed choice such as "xyz" or "x-zy", got {axes!r}')
    return matrix
