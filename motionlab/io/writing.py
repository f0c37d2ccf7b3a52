"""Writing only what can be read again."""

from __future__ import annotations

from pathlib import Path

from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion


def check_writable(path: str | Path, motion: Motion) -> None:
    """A file holds one clip of at least one frame, all of its numbers finite.

    Raises:
        ShapeError: the motion has batch axes or no frames.
        DataError: it holds NaN or infinity; names the first such frame.
    """
    if motion.root.ndim != 2 or motion.skeleton.offsets.ndim != 2:
        raise ShapeError(f"one clip expected, got root {tuple(motion.root.shape)}: choose one with motion.clip(i)")
    if motion.frames == 0:
        raise ShapeError("a motion without frames cannot be written")
    finite = motion.rot.isfinite().flatten(1).all(1) & motion.root.isfinite().all(1)
    if not finite.all():
        place = f"frame {int((~finite).nonzero()[0])}"
        raise DataError("numbers that are not finite", path=path, place=place, remedy="cut or fill those frames")
