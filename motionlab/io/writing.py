"""Writing files whole, and only what can be read again: the old file or the new one is there, never a part."""

from __future__ import annotations

import os
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


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write text (UTF-8) or bytes to a temporary file beside ``path``, then rename it into place.

    Raises:
        DataError: the folder is not there or may not be written, or ``path`` is a folder.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.replace(path)
    except OSError as error:
        message = f"cannot be written: {error.strerror or error}"
        raise DataError(message, path=path, place="whole file", remedy="name a file in a folder that exists") from error
    finally:
        part.unlink(missing_ok=True)
