"""Forward kinematics of 60 and of 10,000 frames against a loop over frames and against roma's rigid composition.

Ratios of medians in one run; every way must give the same positions before it is timed.
"""

import statistics

import roma
import torch

from motionlab import rotation
from motionlab.profiling import timed
from motionlab.skeleton import STANDARD, fk

LOOPED = 200  # frames that the slow way is timed on


def fk_loop(root, rot):
    """Frame by frame, joint by joint."""
    out = []
    for p0, r in zip(root, rot, strict=True):
        positions, orientations = [p0], [r[0]]
        for j, up in enumerate(STANDARD.parents[1:], start=1):
            positions.append(positions[up] + orientations[up] @ STANDARD.offsets[j])
            orientations.append(orientations[up] @ r[j])
        out.append(torch.stack(positions))
    return torch.stack(out)


def fk_roma(root, rot):
    """All frames at once, joint by joint, with roma.Rigid."""
    placed = [roma.Rigid(rot[:, 0], root)]
    for j, up in enumerate(STANDARD.parents[1:], start=1):
        local = roma.Rigid(rot[:, j], STANDARD.offsets[j].expand(len(root), 3))
        placed.append(placed[up] @ local)
    return torch.stack([p.translation for p in placed], 1)


def interleaved(ways, n=9):
    """Median seconds of each way, measured in turns so that a busy machine disturbs all alike."""
    rounds = [[timed(way, n=1, warm_up=int(k == 0)).median for way in ways] for k in range(n)]
    return [statistics.median(column) for column in zip(*rounds, strict=True)]


def compare(frames: int, generator: torch.Generator) -> None:
    """Check, time, print."""
    rot = rotation.random((frames, 22), generator)
    root = torch.randn(frames, 3, generator=generator)
    free = rot.clone().requires_grad_()
    few = min(frames, LOOPED)

    def ours(rot=rot):
        return fk(STANDARD, root, rot)[0]

    def with_roma(rot=rot):
        return fk_roma(root, rot)

    def looped():
        return fk_loop(root[:few], rot[:few])

    torch.testing.assert_close(with_roma(), ours())
    torch.testing.assert_close(looped(), ours()[:few])
    t, roma_t, loop_t = interleaved([ours, with_roma, looped])
    back = [lambda way=way: way(free).square().sum().backward() for way in (ours, with_roma)]
    t_back, roma_back = interleaved(back)
    print(f"fk of {frames} frames: {t * 1e3:.2f} ms, with its backward pass {t_back * 1e3:.2f} ms")
    print(f"  loop over frames ({few} measured) / fk = {loop_t * frames / few / t:.0f}")
    print(f"  roma.Rigid joint by joint / fk = {roma_t / t:.2f}, with the backward passes {roma_back / t_back:.2f}")


def main() -> None:
    """A clip as an optimiser sees it, and a corpus."""
    generator = torch.Generator().manual_seed(0)
    for frames in (60, 10_000):
        compare(frames, generator)


if __name__ == "__main__":
    main()
