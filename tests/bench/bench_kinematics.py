"""Forward kinematics of 10,000 frames against a loop over frames and against roma's rigid composition.

Ratios of medians in one run; every way must give the same positions before it is timed.
"""

import roma
import torch

from motionlab import rotation
from motionlab.profiling import timed
from motionlab.skeleton import STANDARD, fk

FRAMES, LOOPED = 10_000, 200


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


def main() -> None:
    """Check, time, print."""
    generator = torch.Generator().manual_seed(0)
    rot = rotation.random((FRAMES, 22), generator)
    root = torch.randn(FRAMES, 3, generator=generator)
    ours = fk(STANDARD, root, rot)[0]
    torch.testing.assert_close(fk_roma(root, rot), ours)
    torch.testing.assert_close(fk_loop(root[:LOOPED], rot[:LOOPED]), ours[:LOOPED])

    forward = timed(lambda: fk(STANDARD, root, rot))
    loop = timed(lambda: fk_loop(root[:LOOPED], rot[:LOOPED]), n=3).median * FRAMES / LOOPED
    rigid = timed(lambda: fk_roma(root, rot)).median
    print(f"fk of {FRAMES} frames: {forward.median * 1e3:.1f} ms (IQR {forward.iqr * 1e3:.1f}, n = {forward.n})")
    print(f"  loop over frames ({LOOPED} measured)  / fk = {loop / forward.median:.0f}")
    print(f"  roma.Rigid joint by joint            / fk = {rigid / forward.median:.2f}")

    rot.requires_grad_()

    def back(way):
        return timed(lambda: way().square().sum().backward()).median

    ours = back(lambda: fk(STANDARD, root, rot)[0])
    print(f"  roma.Rigid, forwards and backwards   / fk = {back(lambda: fk_roma(root, rot)) / ours:.2f}")


if __name__ == "__main__":
    main()
