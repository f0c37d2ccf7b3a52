"""Forward kinematics of 60 and of 10,000 frames against a loop over frames and against roma's rigid composition.

Medians of ratios in one run; every way must give the same positions and gradients before it is timed.
"""

import roma
import torch

from motionlab import rotation
from motionlab.skeleton import STANDARD, fk
from studies.shared.profiling import interleaved

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


def in_turns(*ways):
    """Seconds (rounds,) of each way, in turns so that a busy machine disturbs all ways of a round alike."""
    return list(interleaved(dict(enumerate(ways)), n=25, warm_up=3).values())


def ratio(slow, ours):
    """Median and quartiles of the ratios taken round by round."""
    low, middle, high = (slow / ours).quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def compare(clips: int, frames: int, generator: torch.Generator) -> None:
    """Check, time, print."""
    rot = rotation.random((clips, frames, 22), generator)
    root = torch.randn(clips, frames, 3, generator=generator)
    free = rot.clone().requires_grad_()
    few = min(frames, LOOPED)

    def ours(rot=rot):
        return fk(STANDARD, root, rot)[0]

    def with_roma(rot=rot):
        return fk_roma(root.flatten(0, 1), rot.flatten(0, 1)).unflatten(0, (clips, frames))

    def looped():
        return fk_loop(root[0, :few], rot[0, :few])

    def gradient(way):
        return torch.autograd.grad(way(free).square().sum(), free)[0]

    torch.testing.assert_close(with_roma(), ours())
    torch.testing.assert_close(looped(), ours()[0, :few])
    torch.testing.assert_close(gradient(with_roma), gradient(ours), atol=1e-4, rtol=1e-4)
    forward = in_turns(ours, with_roma)
    both = in_turns(*(lambda way=way: gradient(way) for way in (ours, with_roma)))
    loop = interleaved({"it": looped}, n=3)["it"].median().item() * clips * frames / few
    t, t_both = forward[0].median().item(), both[0].median().item()
    print(f"fk of {clips} x {frames} frames: {t * 1e3:.2f} ms, with its backward pass {t_both * 1e3:.2f} ms")
    print(f"  loop over frames ({few} measured) / fk = {loop / t:.0f}")
    forwards, with_backward = ratio(*reversed(forward)), ratio(*reversed(both))
    print(f"  roma.Rigid joint by joint / fk = {forwards}, with the backward passes {with_backward}")


def main() -> None:
    """A clip as an optimiser sees it, a few clips, and a corpus."""
    before = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        generator = torch.Generator().manual_seed(0)
        print(f"{threads} thread{'s' * (threads > 1)}; ratio: median [quartiles] of 25 interleaved rounds")
        for clips, frames in ((1, 60), (4, 60), (1, 10_000)):
            compare(clips, frames, generator)
    torch.set_num_threads(before)


if __name__ == "__main__":
    main()
