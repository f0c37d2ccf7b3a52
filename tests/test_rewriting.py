"""What is written back: another format means the same, joint by joint, and a file keeps its own way of writing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from motionlab import io, rotation
from motionlab.animate import filling
from motionlab.animate.rewriting import WRITERS, write_back
from motionlab.errors import DataError
from motionlab.io import bvh, gltf
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


@pytest.mark.parametrize("kept", ["0-20,60-last", "20-60", "last"])
def test_no_channel_jumps_where_a_middle_angle_is_beyond_a_quarter_turn(kept, tmp_path):
    """Somebody who walks to 130 degrees, about the middle axis of ZYX."""
    source, out = tmp_path / "in.bvh", tmp_path / "out.bvh"
    motion, turn = walk(90), rotation.rotation_about("z", torch.tensor(np.deg2rad(130.0))).float()
    rot = torch.cat((turn @ motion.rot[:, :1], motion.rot[:, 1:]), 1)
    bvh.save(source, replace(motion, rot=rot, root=motion.root @ turn.T), order="ZYX")
    lines = source.read_text().splitlines()
    for n in range(len(lines) - 90, len(lines)):
        words = lines[n].split()
        z, y, x = (float(word) for word in words[3:6])
        words[3:6] = (f"{angle:.6f}" for angle in ((z + 360) % 360 - 180, 180 - y, (x + 360) % 360 - 180))
        lines[n] = " ".join(words)
    source.write_text("\n".join([*lines, ""]))
    loaded = io.load(source)
    keep = filling.key_mask(loaded, filling.frames_named(kept, 90))
    made = filling.inbetween(loaded, keep, method="curves", plant=False).motion
    write_back(source, out, loaded, made)
    old, new = (np.loadtxt(path.read_text().splitlines()[-90:]) for path in (source, out))
    assert 100 < old[:, 4].min() and np.abs(np.diff(old[:, 3:], axis=0)).max() < 8
    assert np.abs(np.diff(new[:, 3:], axis=0)).max() < 8 and (new != old).any()
    assert (io.load(out).positions - made.positions).abs().max() < 1e-4


@pytest.mark.parametrize("ends", [b"\r\n", b"\n", b"\r"])
@pytest.mark.parametrize("more", [0, 3])
def test_a_bvh_keeps_its_line_ends(ends, more, tmp_path):
    source, out = tmp_path / "in.bvh", tmp_path / "out.bvh"
    bvh.save(source, walk(20))
    content = source.read_bytes().replace(b"\n", ends).removesuffix(ends if more else b"")
    source.write_bytes(content)
    loaded = io.load(source)
    index = torch.arange(20 + more).clamp(max=19)
    rot = loaded.rot[index].clone()
    rot[10] = rot[12]
    write_back(source, out, loaded, replace(loaded, rot=rot, root=loaded.root[index]))
    found = out.read_bytes()
    assert found.count(ends) == content.count(ends) + more + bool(more)
    assert not {b"\r", b"\n"} & set(found.replace(ends, b" ").split(b" ")) and io.load(out).frames == 20 + more
    assert found.replace(ends, b"").count(b"\n") + found.replace(ends, b"").count(b"\r") == 0


def test_a_bvh_may_have_fewer_frames_and_another_rate_the_rest_stays_byte_for_byte(tmp_path):
    source, out = tmp_path / "in.bvh", tmp_path / "out.bvh"
    bvh.save(source, walk(20))
    loaded, lines = io.load(source), source.read_text().splitlines()
    at = lines.index("MOTION")
    assert write_back(source, out, loaded, loaded.cut(0, 7)).startswith("7 of 7 frames")
    assert out.read_text().splitlines() == [*lines[: at + 1], "Frames: 7", *lines[at + 2 : at + 10]]
    write_back(source, out, loaded, replace(loaded, fps=48.0))
    assert out.read_text().splitlines() == [*lines[: at + 2], f"Frame Time: {1 / 48:.10f}", *lines[at + 3 :]]
    for suffix, said in ((".npz", "written anew"), (".glb", "a new animation")):
        WRITERS[suffix](tmp_path / f"in{suffix}", walk(20))
        loaded = io.load(tmp_path / f"in{suffix}")
        made = replace(loaded.cut(0, 7), fps=48.0)
        assert said in write_back(tmp_path / f"in{suffix}", tmp_path / f"out{suffix}", loaded, made)
        found = io.load(tmp_path / f"out{suffix}")
        assert (found.frames, found.fps) == (7, 48.0)


@pytest.mark.parametrize("person", [0, 1])
def test_of_several_people_the_one_who_was_read_changes(tmp_path, person):
    people = [walk(20), replace(walk(20), root=walk(20).root + torch.tensor([0.0, 2.0, 0.0]))]
    people[1].rot[:, 5] = rotation.rotation_about("x", torch.linspace(0, 1, 20))
    source, target = tmp_path / "two.glb", tmp_path / "b.glb"
    gltf.save(source, people)
    loaded = io.load(source, person=person)
    made = replace(loaded, rot=loaded.rot.clone())
    made.rot[3:9, 4] = rotation.rotation_about("x", torch.tensor(0.5))
    write_back(source, target, loaded, made)
    torch.testing.assert_close(io.load(target, person=person).rot, made.rot, atol=2e-6, rtol=0)
    other = 1 - person
    torch.testing.assert_close(io.load(target, person=other).rot, io.load(source, person=other).rot, atol=0, rtol=0)
    longer = loaded.clip(torch.arange(25) % 20)
    assert "new animation" in write_back(source, target, loaded, longer)
    assert (io.load(target, person=person).frames, io.load(target, person=other).frames) == (25, 20)
    assert "the other people of the file that was read are lost" in write_back(source, tmp_path / "c.bvh", loaded, made)


def stretching(path, motion: Motion, joint: int, shift: torch.Tensor) -> None:
    """The motion written with one bone longer by shift (T, 3), metres, in its joint's own axes."""
    if path.suffix == ".bvh":
        bvh.save(path, motion)
        head, table = path.read_text().split("MOTION\n")
        parts = head.split("CHANNELS ")
        order = [part.split("JOINT ")[-1].split()[0] for part in [parts[0].replace("ROOT", "JOINT"), *parts[1:-1]]]
        at = order.index(motion.skeleton.names[joint])
        parts[at + 1] = parts[at + 1].replace("3 ", "6 Xposition Yposition Zposition ", 1)
        lines = table.splitlines()
        for n, place in enumerate((100 * (motion.skeleton.offsets[joint] + shift)).tolist(), start=2):
            words = lines[n].split()
            words[3 * at + 3 : 3 * at + 3] = [f"{x:.6f}" for x in place]
            lines[n] = " ".join(words)
        path.write_text("CHANNELS ".join(parts) + "\n".join(["MOTION", *lines, ""]))
        return
    file = gltf._Buffer()
    first = gltf._animate(file, motion, "walk")
    gltf._bind(file, first, "walk", motion.skeleton, motion.skeleton.rest_positions(), torch.eye(3).expand(22, 3, 3))
    file.move(first + joint, "translation", file.samplers[0]["input"], motion.skeleton.offsets[joint] + shift)
    file.content["animations"] = [file.animation(motion)]
    path.write_bytes(file.glb())


@pytest.mark.parametrize("suffix", [".bvh", ".glb"])
@pytest.mark.parametrize("more", [0, 5])
def test_a_bone_that_was_read_at_its_mean_length_is_written_so(tmp_path, suffix, more):
    """What was made stands on rigid bones: so does the copy of the file, whose other numbers stay."""
    knee, source, out = STANDARD.index("left_knee"), tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    shift = torch.zeros(20, 3)
    shift[:, 1] = 0.06 * torch.sin(torch.arange(20) / 3) - 0.02
    stretching(source, walk(20), knee, shift)
    with pytest.raises(DataError, match=r"left_knee moves .*--translations mean"):
        io.load(source)
    loaded = io.load(source, translations="mean")
    its = loaded.skeleton.index("left_knee")
    rot = loaded.rot.clone()
    rot[4:9, its] = rotation.rotation_about("x", torch.tensor(0.5)) @ rot[4:9, its]
    made = replace(loaded, rot=torch.cat((rot, rot[:more])), root=torch.cat((loaded.root, loaded.root[:more])))
    said = write_back(source, out, loaded, made)
    assert "new animation" in said if more and suffix == ".glb" else "21 of 22 joints in all frames" in said or more
    back = io.load(out)  # strictly
    torch.testing.assert_close(back.positions, made.positions, atol=2e-5, rtol=0)
    write_back(source, out, loaded, loaded)
    torch.testing.assert_close(io.load(out).positions, loaded.positions, atol=2e-5, rtol=0)
    if suffix == ".bvh":
        pairs = zip(source.read_text().splitlines(), out.read_text().splitlines(), strict=True)
        changed = [sum(a != b for a, b in zip(x.split(), y.split(), strict=True)) for x, y in pairs]
        assert max(changed) <= 3 and sum(changed) >= 15
