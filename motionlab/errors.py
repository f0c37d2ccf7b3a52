"""Errors that say what was expected, what came, and what to do about it."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


class ShapeError(ValueError):
    """A tensor has the wrong number of axes or the wrong size along one."""


class DataError(ValueError):
    """A file or a recording cannot be used: names the file, the place in it, and the remedy."""

    def __init__(self, message: str, *, path: object = None, place: str = "", remedy: str = "") -> None:
        self.message, self.path, self.place, self.remedy = message, path, place, remedy
        where = ", ".join(str(part) for part in (path, place) if part)
        text = f"{where}: {message}" if where else message
        super().__init__(f"{text} (remedy: {remedy})" if remedy else text)


class MissingData(FileNotFoundError):
    """Data or software that the caller must fetch first; the message says how to get it."""

    def __init__(self, what: str, how_to_get: str = "") -> None:
        # Python makes what comes out of another process again, from its message alone
        super().__init__(f"{what} is missing. {how_to_get}" if how_to_get else what)


class NotConverged(RuntimeError):
    """A procedure stopped before its tolerance was met."""


def check_shape(x: "Tensor", pattern: str | tuple[int, ...], name: str) -> dict[str, int]:
    """Checks the trailing axes of a tensor and returns the sizes that the pattern names.

    The pattern is words separated by spaces: ``...`` (first only) for any batch axes, a number for
    a fixed size, a name for a free one. A name that occurs twice must have one size. Or it is a shape.

    Raises:
        ShapeError: naming the tensor, the expected and the actual shape.
    """
    pattern = pattern if isinstance(pattern, str) else " ".join(map(str, pattern))
    words = pattern.split()
    batched = words[:1] == ["..."]
    words, found, sizes = words[batched:], tuple(x.shape), {}
    tail = found[max(len(found) - len(words), 0) :]
    fits = len(tail) == len(words) and (batched or len(found) == len(words))
    for word, size in zip(words, tail, strict=False):
        fits &= size == (int(word) if word.isdigit() else sizes.setdefault(word, size))
    if not fits:
        raise ShapeError(f"{name}: expected shape ({pattern.replace(' ', ', ')}), got {found}")
    return sizes
