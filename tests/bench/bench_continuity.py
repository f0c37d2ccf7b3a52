"""Is the corpus's acceleration continuous? Its peak at 240 frames per second over that at 120; a jump doubles it."""

import torch

from data_synth import corpus
from data_synth.audit import acceleration


def main() -> None:
    """Print one line per sequence."""
    for index in range(corpus.Recipe().sequences):
        peak = {}
        for fps in (120.0, 240.0):
            take = corpus.perform_sequence(corpus.Recipe(fps=fps), index)
            largest = acceleration(take.motion.to(torch.float64)).amax(-1)
            peak[fps] = (float(largest.max()), take.labels[int(largest.argmax())])
        (slow, _), (fast, action) = peak.values()
        print(f"sequence {index:2d}: {slow:4.0f} -> {fast:4.0f} m/s^2 ({action}), ratio {fast / slow:.2f}")


if __name__ == "__main__":
    main()
