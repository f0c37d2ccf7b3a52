"""Footage: a video or a folder of numbered images, its rate and size; whether the camera that took it moved; and
what the numbers of its images mean."""

import math
import os
import re
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

from motionlab.io.reading import RATES, Location, reading

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
_UNEVEN = 0.75  # frames by which one may be off even times
_SMALL = 160  # pixels across a picture in which the background is compared
MOVED = 0.0125  # share of the width by which it may be off before a camera has moved: two pixels of ``_SMALL``
_CLEAR = 0.25  # share of a picture that must show background for a cut to be told
_SURE = 0.04  # height of a correlation's peak below which two backgrounds cannot be compared
_WEAK = 0.15  # and from which on they are surely one: two backgrounds have a peak, too, which is lower
_SPARSE = 0.1  # share of the numbers between the first and the last image of which fewer are no film's
_MOMENT = 10**11  # no film has so many frames: from here on a number is a moment since 1970, in ms, us or ns
_UNITS, _RATES = {"ms": 1e3, "us": 1e6, "ns": 1e9}, (4.0, 1000.0)  # of times: how many a second there are, and may be
_LEAST = 8  # step from which numbers may be times: fewer are frames
_NEAR = 0.03  # share by which a rate may be off and still be the same


@dataclass(frozen=True, eq=False)
class Video:
    """A video, or images in the order of their numbers. fps: None of images. size: width, height in pixels.

    times (frames,): seconds since the first frame, where they do not come at even times; None where they do.
    """

    path: Path
    fps: float | None
    size: tuple[int, int]
    frames: int
    images: tuple[Path, ...] = ()
    times: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    @property
    def numbers(self) -> tuple[int, ...]:
        """What the images are numbered by, where that does not begin at 0 or 1 and leave none out; else nothing."""
        flat = [number for path in self.images for number in _numbered(path)[0][-1:]]
        plain = not flat or (flat[0] <= 1 and flat[-1] - flat[0] == len(flat) - 1)
        return () if plain or len(flat) < len(self.images) or flat != sorted({*flat}) else tuple(flat)

    def pictures(self, wanted: Sequence[int]) -> Iterator[np.ndarray]:
        """Returns pictures (H, W, 3) uint8 of frames in rising order, one after the other; past the end the last one.

        Raises:
            DataError: a picture cannot be read, or has another size than the first.
        """
        with reading(self.path, "convert it to MP4 (H.264), or to PNGs") as at:
            now, picture, stream = -1, None, None if self.images else _decoded(at, self.size)
            for frame in wanted:
                if self.images:
                    picture = _image(self.images[min(frame, self.frames - 1)])
                    if picture.shape[1::-1] != self.size:
                        raise at.error(f"a picture of {picture.shape[1::-1]} among those of {self.size} pixels")
                while stream and now < frame and (following := next(stream, None)) is not None:
                    picture, now = following, now + 1
                if picture is None:
                    raise at.error("no picture in it")
                yield picture


def open_video(path: str | Path) -> Video:
    """Opens a video that FFmpeg reads, or a folder of images.

    Raises:
        DataError: neither, or nothing in it.
    """
    with reading(path, "give a video, or a folder with an image per frame") as at:
        if at.path.is_dir():
            found = [each for each in at.path.iterdir() if each.suffix.lower() in PICTURES]
            if not found:
                raise at.error(f"0 images ({', '.join(PICTURES)}) in this folder")
            images = tuple(sorted(found, key=_numbered))
            return Video(at.path, None, _image(images[0]).shape[1::-1], len(images), images)
        if not at.path.stat().st_size:
            raise at.error("the file is empty")
        times, notes = _times(at)
        stream = imageio_ffmpeg.read_frames(os.path.abspath(at.path))
        found = next(stream)
        stream.close()
        fps, lasts, count = float(found["fps"]), float(found.get("duration") or 0), len(times)
        if not 0 < fps < 1e4:
            raise at.error(f"{fps:g} frames per second")
        if notes and count / fps < 0.97 * lasts - 0.1 and times[-1] < 0.97 * lasts - 0.1:
            message = f"{times[-1]:.1f} s of a film of {lasts:.1f} s can be read: is it there to the end? ({notes[0]})"
            raise at.error(message, remedy="get the whole file; or keep what can be read: ffmpeg -i FILE new.mp4")
        rate = (count - 1) / times[-1] if count > 2 and times[-1] > 0 else fps
        uneven = count > 2 and np.abs(times * rate - np.arange(count)).max() > _UNEVEN
        if uneven:
            usual = [1 / max(x, 1e-3) for x in np.percentile(np.diff(times), (95, 5))]
            notes.append(f"the footage's rate varies, from {usual[0]:.3g} to {usual[1]:.3g} frames per second")
        elif abs(rate / fps - 1) > 0.01:
            notes.append(f"the footage says {fps:g} frames per second, its time stamps {rate:.4g}: taken at these")
        else:
            rate = fps
        return Video(at.path, rate, tuple(found["size"]), count, (), times if uneven else None, tuple(notes))


def _ffmpeg(at: Location, *words: str) -> list[str]:
    """A command that reads every frame of a video once, each as it comes; the path is whole, or FFmpeg might take
    what is before a colon for a protocol."""
    path = os.path.abspath(at.path)
    return [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-map", "0:v:0", "-fps_mode", "passthrough",
            *words, "-"]  # fmt: skip


def _times(at: Location) -> tuple[np.ndarray, list[str]]:
    """Seconds (N,) of all frames since the first, none before another; and what FFmpeg complained of."""
    words = _ffmpeg(at, "-enc_time_base", "demux", "-f", "framecrc")
    done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    text, said = (stream.decode(errors="replace").splitlines() for stream in (done.stdout, done.stderr))
    base = next((line.split(":")[1].split("/") for line in text if line.startswith("#tb 0:")), None)
    stamps = [int(line.split(",")[2]) for line in text if line[:1].isdecimal()]
    if base is None or not stamps:
        raise at.error("no video that FFmpeg can read" + (f": {said[0][:200]}" if said else ""))
    times = np.maximum.accumulate(np.array(stamps, float) - stamps[0]) * int(base[0]) / int(base[1])
    return times, [f"FFmpeg says: {re.sub(' @ 0x[0-9a-f]+', '', said[0])[:200]}"] if said else []


def _decoded(at: Location, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """All pictures of a video; FFmpeg ends with the generator."""
    words = _ffmpeg(at, "-f", "rawvideo", "-pix_fmt", "rgb24")
    shape = (size[1], size[0], 3)
    quiet = {"stdin": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(words, stdout=subprocess.PIPE, **quiet) as process:
        try:
            while len(data := process.stdout.read(math.prod(shape))) == math.prod(shape):
                yield np.frombuffer(data, np.uint8).reshape(shape)
        finally:
            process.kill()


def _numbered(path: Path) -> tuple[list[int], str]:
    return [int(number) for number in re.findall(r"\d+", path.stem)], path.name


def _image(path: Path) -> np.ndarray:
    with reading(path, "extract the video's frames again") as at, Image.open(at.path) as picture:
        return np.asarray(picture.convert("RGB"))


def background_drift(pictures: Iterable[np.ndarray], boxes: Sequence[Sequence[Sequence[float]]]) -> np.ndarray:
    """Computes how far the background moved since the first picture (N,), shares of the width; NaN where untold.

    By phase correlation of neighbouring pictures, people left out. A camera that turns or travels shows; one that
    only zooms does not. Infinite where the film is cut: there the background is another, though it can be told before
    and after.

    pictures: N of (H, W, 3) uint8, a fraction of a second apart. boxes: of the people in each: left, top, right, bottom
    in pixels.

    Source: Kuglin and Hines 1975.
    """
    small, masks, steps, peaks, clear = [], [], [], [], []
    for picture, people in zip(pictures, boxes, strict=False):
        high = max(8, round(_SMALL * picture.shape[0] / picture.shape[1]))
        grey = Image.fromarray(picture).convert("L").resize((_SMALL, high), Image.Resampling.BOX)
        small.append(np.asarray(grey, float) - gaussian_filter(np.asarray(grey, float), 4.0))
        masks.append(_background(people, picture.shape, small[-1].shape))
    for k in range(1, len(small)):
        mask = masks[k - 1] * masks[k]
        step, peak = _shift(small[k - 1], small[k], gaussian_filter(mask, 2.0) * mask)
        steps.append(step), peaks.append(peak), clear.append(mask.mean() > _CLEAR)
    peaks = np.array(peaks)
    around = np.pad(peaks, 1, constant_values=np.inf)
    beside = np.minimum(around[:-2], around[2:])  # the lower neighbour
    cut = np.array(clear, bool) & (peaks < _WEAK) & (beside > np.maximum(_WEAK, 3 * peaks)) & np.isfinite(beside)
    told = (peaks >= _SURE) & ~cut
    away = np.cumsum(np.where(told[:, None], np.reshape(steps, (-1, 2)), 0.0), 0)
    off = np.where(told, np.linalg.norm(away, axis=-1) / _SMALL, np.nan)
    return np.append(0.0, np.where(cut, np.inf, off))


def _background(boxes: Sequence[Sequence[float]], shape: tuple[int, ...], small: tuple[int, int]) -> np.ndarray:
    """A mask of a picture's smaller copy: 0 in boxes that are a fifth larger on each side."""
    mask, boxes = np.ones(small), np.reshape(boxes, (-1, 4)).astype(float)
    more, scale = 0.2 * (boxes[:, 2:] - boxes[:, :2]), (small[1] / shape[1], small[0] / shape[0])
    grown = np.hstack(((boxes[:, :2] - more) * scale, (boxes[:, 2:] + more) * scale + 1))
    for left, top, right, bottom in grown.clip(0).astype(int):
        mask[top:bottom, left:right] = 0
    return mask


def _shift(before: np.ndarray, after: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, float]:
    """Pixels (2,) by which the pattern moved, and the height of the peak that says so."""
    window = mask * np.outer(*(np.hanning(n) for n in mask.shape))
    one, other = (np.fft.rfft2(each * window) for each in (before, after))
    cross = other * one.conj()
    found = np.fft.irfft2(cross / (np.abs(cross) + 1e-6 * np.abs(cross).max() + 1e-12), mask.shape)
    peak = np.array(np.unravel_index(found.argmax(), found.shape))
    return np.where(peak > np.array(found.shape) / 2, peak - found.shape, peak).astype(float), float(found.max())


def frames_of(
    numbers: Sequence[int], *, fps: float | None = None, film: int | Sequence[int] | None = None, loose: bool = False
) -> tuple[list[int], float | None, list[str]]:
    """Returns the frame of every number (distinct, rising), frames per second where the numbers are times, and notes.

    Numbers are frames, unless they are times, or too far apart to be a film's.

    fps: frames per second that somebody said. film: frames of the film, where known, or its images' numbers. loose:
    the numbers may be those of any pictures.
    """
    first, last, steps = numbers[0], numbers[-1], np.diff(np.array(numbers, np.int64))
    if not isinstance(film, int | None):
        if {*film} >= {*numbers}:
            return np.searchsorted(film, numbers).tolist(), None, []
        film = len(film)
    if len(steps) == 0 or (film is not None and last <= film):
        return [*numbers], None, []
    step = float(np.median(steps))
    counts = np.maximum(np.round(steps / step), 1)
    exact = (last - first) / counts.sum()
    rates = ((name, a_second / exact) for name, a_second in _UNITS.items())
    unit, rate = next((pair for pair in rates if _RATES[0] <= pair[1] <= _RATES[1]), ("", 0.0))
    if unit and len(steps) > 1 and _are_times(first, steps, step, counts, rate, fps):
        if unit == "ms" and (steps == steps[0]).all():  # cut to whole ones
            rate = next((float(each) for each in RATES if 1e3 / (step + 1) < each <= rate), rate)
        told = "" if fps is None or abs(fps / rate - 1) < _NEAR else f", though {fps:g} a second were asked for"
        note = f"numbers from {first} to {last} in steps of {exact:.4g} are times in {unit}: {rate:.4g} a second{told}"
        return [0, *counts.cumsum().astype(int).tolist()], rate, [note]
    if loose and len(numbers) < _SPARSE * (last - first + 1):
        note = f"{len(numbers)} images numbered from {first} to {last}: taken as pictures in a row, not as a film"
        return [*range(len(numbers))], None, [note]
    n = math.gcd(*steps.tolist())
    note = f"one frame in {n} from {first} to {last} is there: those between them show nobody"
    return [*numbers], None, [note] if n > 1 and len(steps) > 1 else []


def _are_times(first: int, steps: np.ndarray, step: float, counts: np.ndarray, rate: float, fps: float | None) -> bool:
    if first >= _MOMENT or step < _LEAST:
        return first >= _MOMENT
    if (steps % steps[0] == 0).all():  # every n-th frame has such steps, too
        return fps is not None and abs(rate / fps - 1) < _NEAR
    near = np.abs(steps - counts * step) <= (1 if step < 20 else max(1.5, 0.06 * step))
    return bool(near.mean() >= 0.9)
