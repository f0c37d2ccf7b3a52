"""An energy that a person stops with Ctrl-C."""

from collections.abc import Callable

from torch import Tensor


def interrupted(energy: Callable[..., Tensor], at: int) -> Callable[..., Tensor]:
    """The energy, but its evaluation number ``at`` (from 1), and none before or after, ends in a KeyboardInterrupt."""
    count = []

    def tired(*arguments: object, **how: object) -> Tensor:
        count.append(1)
        if len(count) == at:
            raise KeyboardInterrupt
        return energy(*arguments, **how)

    return tired
