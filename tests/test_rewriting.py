"""What is written back: another format means the same, joint by joint, and a file keeps its own way of writing."""

from dataclasses import replace

import pytest

from motionlab import io
from motionlab.io import bvh, gltf
from motionlab.io.rewriting import write_back
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from tests.test_animate import walk


def right_first(motion: Motion) -> Motion:
    """The same motion with right limbs before left ones."""
    depth = [0]
    for parent in STANDARD.parents[1:]:
        depth.append(depth[parent] + 1)
    order = sorted(range(len(STANDARD)), key=lambda j: (depth[j], -j))
    parents = tuple(-1 if STANDARD.parents[j] < 0 else order.index(STANDARD.parents[j]) for j in order)
    names = tuple(STANDARD.names[j] for j in order)
    skeleton = replace(STANDARD, names=names, parents=parents, offsets=STANDARD.offsets[order], contact_names=())
    return replace(motion, skeleton=skeleton, rot=motion.rot[:, order], contacts=None)


@pytest.mark.parametrize("suffix", [".bvh", ".glb"])
def test_an_npz_of_another_format_has_every_joint_where_it_was(suffix, tmp_path):
    """AMASS has its joints in SMPL's order, other files in theirs."""
    source, out = tmp_path / f"in{suffix}", tmp_path / "out.npz"
    {".bvh": bvh, ".glb": gltf}[suffix].save(source, right_first(walk(20)))
    loaded = io.load(source)
    said = write_back(source, out, loaded, loaded)
    before, after = (m.positions - m.root[:, None] for m in (loaded, io.load(out)))
    off = after - before[:, loaded.skeleton.indices(STANDARD.names)]
    assert off.norm(dim=-1).max() < 0.01 and "on the standard body" in said
