"""Medians as tables say them."""

from __future__ import annotations

from torch import Tensor


# ------------------------------------------------------------------------------------------------ who was how fast
def middle(x: Tensor) -> Tensor:
    """The median of (B,) as the findings take it, the mean of the two in the middle; infinite where one of them is."""
    ordered = x.flatten().sort().values
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
