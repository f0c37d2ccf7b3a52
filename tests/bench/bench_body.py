"""Joints only and the 11 surface keypoints against full skinning and against anny's own: ratios in one run.

anny poses its 53 bones and skins with its own dense linear blend skinning, to the same vertices within 1e-5 m. Its
forward also computes the body's shape from the phenotype, on every call; skinning alone, with the shape computed
beforehand as ours is, has a row of its own.
"""

import torch

from motionlab import rotation
from motionlab.body import AVERAGE_ADULT, BodyModel, lbs
from motionlab.skeleton import fk
from studies.shared.profiling import interleaved

FRAMES, REPEATS = 64, 7


def seconds(function) -> float:
    """Median wall-clock time of a call after one to warm up."""
    return interleaved({"it": function}, n=REPEATS)["it"].median().item()


def gathered(body: BodyModel, root: torch.Tensor, rot: torch.Tensor) -> torch.Tensor:
    """The usual way to write it: blend a 3 x 4 transform per vertex, then apply it."""
    positions, world = fk(body.skeleton, root, rot)
    turn = world @ body.bind_rot.mT
    shift = positions - (turn @ body.joints[..., None])[..., 0]
    blended = torch.einsum("vj,tjab->tvab", body.weights, torch.cat((turn, shift[..., None]), -1))
    return (blended[..., :3] @ body.template[..., None])[..., 0] + blended[..., 3]


def main() -> None:
    import anny

    body = BodyModel.from_anny()
    keypoints = list(body.keypoint_vertices.values())
    generator = torch.Generator().manual_seed(0)
    root, rot = torch.randn(FRAMES, 3, generator=generator), rotation.random((FRAMES, 22), generator)
    model = anny.Anny(rig="game_engine", skinning_method="lbs").to(torch.float32)
    bones = rotation.random((FRAMES, len(model.bone_labels)), generator)
    pose = torch.eye(4).repeat(FRAMES, len(model.bone_labels), 1, 1)
    pose[..., :3, :3] = bones

    posed = model(pose, phenotype_kwargs=AVERAGE_ADULT)

    def skinned() -> torch.Tensor:
        """The second half of anny's forward: bones posed, vertices skinned."""
        transforms, _ = model.get_bone_transforms(pose, posed["rest_bone_poses"])
        return model.get_skinned_vertices(posed["rest_vertices"].expand(FRAMES, -1, -1), transforms)

    apart = (skinned() - posed["vertices"]).abs().max()
    if apart > 1e-5:
        raise SystemExit(f"anny's skinning of its own shape is {apart} m from its forward")
    apart = (gathered(body, root, rot) - lbs(body, body.skeleton, root, rot)).abs().max()
    if apart > 1e-4:
        raise SystemExit(f"two ways of skinning are {apart} m apart")
    with torch.no_grad():
        times = {
            "joints only (fk)": seconds(lambda: fk(body.skeleton, root, rot)),
            f"{len(keypoints)} vertices": seconds(lambda: lbs(body, body.skeleton, root, rot, vertices=keypoints)),
            f"all {len(body.template)} vertices": seconds(lambda: lbs(body, body.skeleton, root, rot)),
            "a transform per vertex": seconds(lambda: gathered(body, root, rot)),
            "anny, shape and skinning": seconds(lambda: model(pose, phenotype_kwargs=AVERAGE_ADULT)),
            "anny, skinning alone": seconds(skinned),
        }
    full = times[f"all {len(body.template)} vertices"]
    for name, value in times.items():
        print(f"{name:25} {1e3 * value / FRAMES:9.4f} ms/frame  full skinning takes {full / value:8.2f} times as long")
    print("anny's shape and skinning: its forward computes the phenotype's shape on every call, ours was baked once")


if __name__ == "__main__":
    main()
