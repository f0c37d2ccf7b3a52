"""Loading a BVH against the bvhio package, to the same world positions: ratios in one run.

bvhio reads a pose per joint and frame into objects; its positions come one frame at a time. The file is made
here: 22 joints, 1 minute at 30 frames per second.
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np
import torch

from motionlab import rotation
from motionlab.io import bvh
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.shared.profiling import interleaved

with warnings.catch_warnings():
    warnings.simplefilter("ignore", PendingDeprecationWarning)  # bvhio imports glm by its old name
    import bvhio

FRAMES, REPEATS, CHECKED = 1800, 5, (0, 1234, 1799)


def seconds(function, repeats: int) -> float:
    """Median wall-clock time of a call after one to warm up."""
    return interleaved({"it": function}, n=repeats)["it"].median().item()


def bvhio_positions(root, frame: int) -> dict[str, np.ndarray]:
    """World positions of every joint at one frame."""
    root.loadPose(frame, recursive=True)
    return {joint.Name: np.array(joint.PositionWorld) for joint, _, _ in root.layout()}


def main() -> None:
    generator = torch.Generator().manual_seed(0)
    motion = Motion(
        STANDARD, torch.randn(FRAMES, 3, generator=generator), rotation.random((FRAMES, 22), generator), 30.0
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.bvh"
        bvh.save(path, motion, up="z")
        ours = bvh.load(path, unit=1.0, up="z")
        theirs = bvhio.readAsHierarchy(str(path))
        for frame in CHECKED:
            for name, place in bvhio_positions(theirs, frame).items():
                error = np.abs(ours.positions[frame, ours.skeleton.index(name)].numpy() - place).max()
                if error > 1e-2:  # file units are cm, both sides in float32
                    raise SystemExit(f"frame {frame}, {name}: {error} cm apart")
        load = seconds(lambda: bvh.load(path, unit=1.0, up="z"), REPEATS)
        load_fk = seconds(lambda: bvh.load(path, unit=1.0, up="z").positions, REPEATS)
        text = seconds(lambda: bvhio.readAsBvh(str(path)), 3)
        tree = seconds(lambda: bvhio.readAsHierarchy(str(path)), 3)
        pose = seconds(lambda: [bvhio_positions(theirs, frame) for frame in range(50)], 3) / 50 * FRAMES
    print(f"{FRAMES} frames, {len(STANDARD)} joints; medians, seconds")
    print(f"ours:  load {load:.3f}, load and all positions {load_fk:.3f}")
    print(f"bvhio: text only {text:.3f}, hierarchy {tree:.3f}, all positions {tree + pose:.3f} (50 frames scaled up)")
    ratios = f"text only {text / load:.1f}, hierarchy {tree / load:.1f}, positions {(tree + pose) / load_fk:.1f}"
    print(f"ratio bvhio / ours: {ratios}")


if __name__ == "__main__":
    main()
