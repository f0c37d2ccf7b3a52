"""Conjugate gradients for the toy of notebook 07."""

import numpy as np


def descend(hessian: np.ndarray, pull: np.ndarray, most: int = 100_000) -> tuple[np.ndarray, int]:
    """Minimises x'Hx/2 - b'x from 0 by conjugate gradients, until a millionth of the fall in energy is left or for
    ``most`` iterations; returns where that ends, and after how many."""
    x, left, least = 0 * pull, pull, pull @ np.linalg.solve(hessian, pull) / 2
    way, done = left, 0
    while least - x @ (pull + left) / 2 > 1e-6 * least and done < most:
        size = left @ left / (way @ hessian @ way)
        x, new = x + size * way, left - size * (hessian @ way)
        way, left, done = new + new @ new / (left @ left) * way, new, done + 1
    return x, done
