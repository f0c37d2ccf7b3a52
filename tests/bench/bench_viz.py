"""Pictures per second of an animated scene: moved in place against built anew for every frame."""

import time

import torch

from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from motionlab.viz.scene import Scene


def glide(frames: int = 20) -> Motion:
    """A T-pose that glides over the floor."""
    rot = torch.eye(3).repeat(frames, len(STANDARD), 1, 1)
    rot[:, 0] = UPRIGHT
    root = torch.zeros(frames, 3)
    root[:, 0], root[:, 2] = torch.linspace(0, 1, frames), STANDARD.standing_height()
    return Motion(STANDARD, root, rot, 20.0)


def main() -> None:
    """Print both rates and their ratio."""
    motion, size = glide(), (480, 360)
    with Scene(size) as scene:
        scene.floor().skeleton(motion).image()
        start = time.perf_counter()
        for frame in range(motion.frames):
            scene.image(frame / motion.fps)
        moved = motion.frames / (time.perf_counter() - start)
    start = time.perf_counter()
    for frame in range(motion.frames):
        with Scene(size) as scene:
            scene.floor().skeleton(motion, frame=frame).image()
    anew = motion.frames / (time.perf_counter() - start)
    print(
        f"scene {size[0]}x{size[1]}: {moved:.1f} pictures/s in place, {anew:.1f} built anew, ratio {moved / anew:.1f}"
    )


if __name__ == "__main__":
    main()
