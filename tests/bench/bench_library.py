"""The library against naive and independent ways, which must find the same before they are timed: ratios of one run.

Forward kinematics: a loop over frames, and roma's rigid composition, joint by joint. Skinning: joints alone, the
surface keypoints, a transform per vertex, and anny's own; its forward also computes the body's shape from the phenotype
on every call, while ours was baked once. BVH: the bvhio package, which reads a pose per joint and frame into objects.
"""

import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import anny
import numpy as np
import roma
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.body import AVERAGE_ADULT, BodyModel, lbs
from motionlab.io import bvh
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, fk
from studies.shared.profiling import interleaved

with warnings.catch_warnings():
    warnings.simplefilter("ignore", PendingDeprecationWarning)  # bvhio imports glm by its old name
    import bvhio


def timed(what: str, ways: dict[str, Callable], rounds: int) -> None:
    """Prints milliseconds of every way, and how many times the first's that is, in turns; median and quartiles."""
    first, *_ = found = list(interleaved(ways, n=rounds, warm_up=2).values())
    for name, seconds in zip(ways, found, strict=True):
        low, middle, high = (seconds / first).quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
        print(f"{what}: {name:28} {1e3 * seconds.median():9.2f} ms, {middle:8.2f} [{low:.2f}, {high:.2f}]", flush=True)


def composed(root: Tensor, rot: Tensor) -> Tensor:
    """Positions of all frames at once, joint by joint, with roma.Rigid."""
    placed = [roma.Rigid(rot[:, 0], root)]
    for j, up in enumerate(STANDARD.parents[1:], start=1):
        placed.append(placed[up] @ roma.Rigid(rot[:, j], STANDARD.offsets[j].expand(len(root), 3)))
    return torch.stack([p.translation for p in placed], 1)


def kinematics(frames: int, draw: torch.Generator) -> None:
    """A clip as an optimiser sees it, or a corpus."""
    root, rot = torch.randn(frames, 3, generator=draw), rotation.random((frames, 22), draw)

    def ours(root=root, rot=rot) -> Tensor:
        return fk(STANDARD, root, rot)[0]

    def looped() -> Tensor:
        return torch.cat([ours(root[t : t + 1], rot[t : t + 1]) for t in range(frames)])

    def slopes(way: Callable) -> Callable:
        free = rot.clone().requires_grad_()
        return lambda: torch.autograd.grad(way(root, free).square().sum(), free)[0]

    ways = {"fk": ours, "roma.Rigid": lambda: composed(root, rot), "a loop over frames": looped}
    both = {"fk, and its gradient": slopes(ours), "roma.Rigid, and its gradient": slopes(composed)}
    for some in (ways, both):
        first, *others = (way() for way in some.values())
        for other in others:
            torch.testing.assert_close(other, first, atol=1e-4, rtol=1e-4)
        timed(f"{frames} frames", some, 25 if frames < 1000 else 3)


def skinning(frames: int, draw: torch.Generator) -> None:
    """Anny poses its 53 bones and skins with its own dense linear blend skinning."""
    body = BodyModel.from_anny()
    root, rot = torch.randn(frames, 3, generator=draw), rotation.random((frames, 22), draw)
    model = anny.Anny(rig="game_engine", skinning_method="lbs").to(torch.float32)
    pose = torch.eye(4).repeat(frames, len(model.bone_labels), 1, 1)
    pose[..., :3, :3] = rotation.random((frames, len(model.bone_labels)), draw)
    posed = model(pose, phenotype_kwargs=AVERAGE_ADULT)

    def gathered() -> Tensor:
        """The usual way to write it: blend a 3 x 4 transform per vertex, then apply it."""
        positions, world = fk(body.skeleton, root, rot)
        turn = world @ body.bind_rot.mT
        shift = positions - (turn @ body.joints[..., None])[..., 0]
        blended = torch.einsum("vj,tjab->tvab", body.weights, torch.cat((turn, shift[..., None]), -1))
        return (blended[..., :3] @ body.template[..., None])[..., 0] + blended[..., 3]

    def skinned() -> Tensor:
        """The second half of anny's forward: bones posed, vertices skinned."""
        transforms, _ = model.get_bone_transforms(pose, posed["rest_bone_poses"])
        return model.get_skinned_vertices(posed["rest_vertices"].expand(frames, -1, -1), transforms)

    points = list(body.keypoint_vertices.values())
    ways = {
        "all vertices": lambda: lbs(body, body.skeleton, root, rot),
        "joints only (fk)": lambda: fk(body.skeleton, root, rot),
        f"{len(points)} vertices": lambda: lbs(body, body.skeleton, root, rot, vertices=points),
        "a transform per vertex": gathered,
        "anny, shape and skinning": lambda: model(pose, phenotype_kwargs=AVERAGE_ADULT),
        "anny, skinning alone": skinned,
    }
    torch.testing.assert_close(skinned(), posed["vertices"], atol=1e-5, rtol=0)
    torch.testing.assert_close(gathered(), ways["all vertices"](), atol=1e-4, rtol=0)
    with torch.no_grad():
        timed(f"{frames} frames", ways, 7)


def loading(frames: int, draw: torch.Generator) -> None:
    """A file that is made here; bvhio's positions come one frame at a time."""
    made = Motion(STANDARD, torch.randn(frames, 3, generator=draw), rotation.random((frames, 22), draw), 30.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.bvh"
        bvh.save(path, made, up="z")

        def theirs() -> list[np.ndarray]:
            root, found = bvhio.readAsHierarchy(str(path)), []
            for frame in range(frames):
                root.loadPose(frame, recursive=True)
                found.append(np.array([joint.PositionWorld for joint, _, _ in root.layout()]))
            return found

        ours = bvh.load(path, unit=1.0, up="z")
        order = [joint.Name for joint, _, _ in bvhio.readAsHierarchy(str(path)).layout()]
        expected = ours.positions[:, ours.skeleton.indices(order)].numpy()
        np.testing.assert_allclose(np.array(theirs()), expected, atol=1e-2)  # centimetres, both in float32
        timed(f"{frames} frames", {"load": lambda: bvh.load(path, unit=1.0, up="z").positions, "bvhio": theirs}, 3)


if __name__ == "__main__":
    torch.set_num_threads(1)
    draw = torch.Generator().manual_seed(0)
    kinematics(60, draw)
    kinematics(10_000, draw)
    skinning(64, draw)
    loading(300, draw)
