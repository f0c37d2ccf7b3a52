"""Small animated GIFs: one palette for all frames, and of each frame only what changed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import GifImagePlugin, Image

from motionlab.errors import ShapeError

_EXACT, _SAMPLE = 16, 12  # colours taken as they are; frames that vote for the palette
_STILL = 127  # the index that means: as in the frame before


def palette(frames: Sequence[np.ndarray], colours: int = 127) -> np.ndarray:
    """At most ``colours`` colours (N, 3) uint8 for frames (H, W, 3): the commonest exactly, the others by median cut.

    Votes count by their 0.3th power, so that a large floor does not starve a small figure.
    """
    pixels = np.concatenate([frame.reshape(-1, 3) for frame in frames[:: max(len(frames) // _SAMPLE, 1)]])
    packed, counts = np.unique(pixels @ np.array([65536, 256, 1]), return_counts=True)
    order = counts.argsort()[::-1]
    rgb = np.stack((packed >> 16, packed >> 8 & 255, packed & 255), -1).astype(np.uint8)[order]
    rest = np.repeat(rgb[_EXACT:], np.ceil(counts[order][_EXACT:] ** 0.3).astype(int), axis=0)
    if len(rgb) <= colours:
        return rgb
    cut = Image.fromarray(rest[None]).quantize(colours - _EXACT, Image.Quantize.MEDIANCUT, kmeans=1)
    return np.concatenate((rgb[:_EXACT], np.array(cut.getpalette(), np.uint8).reshape(-1, 3)))


def durations(count: int, fps: float) -> np.ndarray:
    """Milliseconds (count,) of each frame: GIF counts hundredths of a second, so some frames last one longer.

    The film as a whole keeps its length.

    >>> durations(3, 30.0).tolist()
    [30, 40, 30]
    """
    return 10 * np.diff(np.round(100 / fps * np.arange(count + 1)).astype(int))


def write(path: str | Path, frames: Sequence[np.ndarray], fps: float, colours: int = 127) -> None:
    """Write frames (H, W, 3) uint8 as a GIF that loops, in at most 127 colours.

    Raises:
        ShapeError: no frames. ValueError: more than 50 frames per second, which browsers slow down.
    """
    if len(frames) == 0:
        raise ShapeError(f"{path}: no frames to write")
    if not 0 < fps <= 50:
        raise ValueError(f"{path}: {fps} frames per second; browsers play a GIF at 50 at most")
    rgb = palette(frames, colours)
    table = np.zeros((128, 3), np.uint8)
    table[: len(rgb)] = rgb
    key = Image.new("P", (1, 1))
    key.putpalette(rgb.ravel().tolist())
    height, width = frames[0].shape[:2]
    with open(path, "wb") as file:
        file.write(b"GIF89a" + width.to_bytes(2, "little") + height.to_bytes(2, "little") + b"\xf6\0\0")
        file.write(table.tobytes() + b"\x21\xff\x0bNETSCAPE2.0\x03\x01\0\0\0")
        shown = None
        for frame, last in zip(frames, durations(len(frames), fps).tolist(), strict=True):
            index = np.asarray(Image.fromarray(frame).quantize(palette=key, dither=Image.Dither.NONE))
            top, left, bottom, right = 0, 0, height, width
            patch = index
            if shown is not None:
                changed = index != shown
                rows, columns = changed.any(1).nonzero()[0], changed.any(0).nonzero()[0]
                if len(rows) == 0:
                    rows = columns = np.zeros(1, int)
                top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
                patch = np.where(changed, index, _STILL)[top:bottom, left:right].astype(np.uint8)
            shown = index
            for block in GifImagePlugin.getdata(
                Image.fromarray(patch), (int(left), int(top)), duration=last, disposal=1, transparency=_STILL
            ):
                file.write(block)
        file.write(b";")
