"""Random numbers that are the same in every run."""

import torch


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def draw(seed: int, *shape: int) -> torch.Tensor:
    """Normal numbers, float64."""
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)
