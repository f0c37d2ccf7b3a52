"""GLB: what a viewer computes from the file is what we compute; the rules of glTF; the way back."""

import base64
import json
import struct
from dataclasses import replace

import numpy as np
import pygltflib
import pytest
import seeds
import torch
import trimesh
from scipy.spatial.transform import Rotation

from data_synth.body import capsule_body
from motionlab import io, rotation
from motionlab.animate import rewriting
from motionlab.body import lbs, tailored
from motionlab.errors import DataError
from motionlab.io import gltf, recordings
from motionlab.motion import Motion
from motionlab.rest import reframed
from motionlab.skeleton import STANDARD, UPRIGHT, fk

FRAMES, FPS = 21, 30.0
WORLD_FROM_GLTF = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
DTYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def spin(frames=FRAMES, size=0.5):
    """A body that turns about itself more than once while every joint swings: signs of quaternions must not jump."""
    g = torch.Generator().manual_seed(5)
    phase = torch.linspace(0, 2 * torch.pi, frames)
    swing = size * torch.randn(22, 3, generator=g) * torch.sin(phase[:, None, None] + torch.randn(22, 1, generator=g))
    rot = rotation.axis_angle_to_matrix(swing)
    rot[:, 0] = rotation.rotation_about("z", 1.7 * phase) @ UPRIGHT @ rot[:, 0]
    root = torch.stack((phase / 5, phase.sin(), 0.9 + 0.1 * phase.cos()), -1)
    return Motion(STANDARD, root, rot, FPS, name="spin")


@pytest.fixture(scope="module")
def body():
    """A body that is bound in another pose than the T-pose, as anny is."""
    rest = capsule_body(0.045)
    bend = rotation.axis_angle_to_matrix(0.4 * torch.randn(22, 3, generator=torch.Generator().manual_seed(1)))
    bend[0] = torch.eye(3)
    template = lbs(rest, STANDARD, torch.zeros(1, 3), bend[None])[0]
    joints, turn = fk(STANDARD, torch.zeros(3), bend)
    return replace(rest, template=template, joints=joints, bind_rot=turn)


@pytest.fixture(scope="module")
def written(tmp_path_factory, body):
    path = tmp_path_factory.mktemp("glb") / "spin.glb"
    gltf.save(path, spin(), body)
    return path


def parse(path):
    """JSON and a function from accessor index to array: nothing but struct, json and numpy."""
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON" and size % 4 == 0
    content = json.loads(data[20 : 20 + size])
    length, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
    blob = data[28 + size :]
    assert kind == b"BIN\0" and length == len(blob) == content["buffers"][0]["byteLength"]

    def array(index):
        accessor = content["accessors"][index]
        view = content["bufferViews"][accessor["bufferView"]]
        raw = blob[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        width = WIDTHS[accessor["type"]]
        return np.frombuffer(raw, DTYPES[accessor["componentType"]]).reshape(accessor["count"], width)

    return content, array


def viewer_joints(content, array, frame):
    """World matrices (nodes, 4, 4) in glTF's axes at one key, as a viewer multiplies them."""
    nodes = [dict(node) for node in content["nodes"]]
    animation = content["animations"][0]
    for channel in animation["channels"]:
        target = channel["target"]
        nodes[target["node"]][target["path"]] = array(animation["samplers"][channel["sampler"]]["output"])[frame]
    world = {}

    def visit(index, above):
        node, local = nodes[index], np.eye(4)
        local[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
        local[:3, 3] = node.get("translation", (0, 0, 0))
        world[index] = above @ local
        for child in node.get("children", ()):
            visit(child, world[index])

    for top in content["scenes"][0]["nodes"]:
        visit(top, np.eye(4))
    return np.stack([world[i] for i in range(len(nodes))])


def viewer_vertices(content, array, frame):
    """Skinned vertices in glTF's axes: sum of weight x joint world x inverse bind x vertex (spec 3.7.3)."""
    skin, attributes = content["skins"][0], content["meshes"][0]["primitives"][0]["attributes"]
    inverse_bind = array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    move = viewer_joints(content, array, frame)[skin["joints"]] @ inverse_bind
    point = np.c_[array(attributes["POSITION"]), np.ones(len(array(attributes["POSITION"])))]
    total = 0
    for k in range(len(attributes) // 2 - 1):
        which, share = array(attributes[f"JOINTS_{k}"]), array(attributes[f"WEIGHTS_{k}"])
        total = total + np.einsum("vk,vkab,vb->va", share, move[which], point)
    return total[:, :3]


@pytest.mark.parametrize("frame", [0, 7, FRAMES - 1])
def test_joints_and_vertices_of_a_viewer_are_ours(written, body, frame):
    content, array = parse(written)
    motion = spin()
    joints = viewer_joints(content, array, frame)[:22, :3, 3] @ WORLD_FROM_GLTF.T
    assert np.abs(joints - motion.positions[frame].numpy()).max() < 1e-5
    vertices = viewer_vertices(content, array, frame) @ WORLD_FROM_GLTF.T
    ours = lbs(body, STANDARD, motion.root, motion.rot)[frame].numpy()
    assert np.abs(vertices - ours).max() < 1e-3


def test_on_other_bones_a_viewer_shows_the_tailored_body_on_the_motion_s_own_joints(tmp_path, body):
    """A neck lower by 20 cm: the file's joints stay the motion's, the skin is the tailored one."""
    offsets = STANDARD.offsets.clone()
    offsets[STANDARD.index("neck"), 1] -= 0.2
    low = replace(spin(), skeleton=replace(STANDARD, offsets=offsets))
    gltf.save(tmp_path / "low.glb", low, body)
    content, array = parse(tmp_path / "low.glb")
    joints = viewer_joints(content, array, 7)[:22, :3, 3] @ WORLD_FROM_GLTF.T
    assert np.abs(joints - low.positions[7].numpy()).max() < 1e-5
    vertices = viewer_vertices(content, array, 7) @ WORLD_FROM_GLTF.T

    def away(worn):
        return np.abs(vertices - lbs(worn, low.skeleton, low.root, low.rot)[7].numpy()).max()

    assert away(tailored(body, low.skeleton)) < 1e-3 and away(body) > 0.02


def test_a_bind_pose_taken_for_the_t_pose_would_show(tmp_path, body):
    """Negative control: inverse binds without bind_rot move vertices by centimetres."""
    gltf.save(tmp_path / "wrong.glb", spin(), replace(body, bind_rot=torch.eye(3).repeat(22, 1, 1)))
    content, array = parse(tmp_path / "wrong.glb")
    ours = lbs(body, STANDARD, spin().root, spin().rot)[7].numpy()
    assert np.abs(viewer_vertices(content, array, 7) @ WORLD_FROM_GLTF.T - ours).max() > 0.05


def test_rules_of_gltf(written):
    content, array = parse(written)
    for view in content["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    for index in (attributes["POSITION"], content["animations"][0]["samplers"][0]["input"]):
        accessor = content["accessors"][index]
        assert np.allclose(array(index).min(0), accessor["min"], atol=0)
        assert np.allclose(array(index).max(0), accessor["max"], atol=0)
    for index, accessor in enumerate(content["accessors"]):
        assert accessor["componentType"] in DTYPES
        assert np.isfinite(array(index)).all()
    assert np.allclose(np.linalg.norm(array(attributes["NORMAL"]), axis=1), 1, atol=1e-6)
    assert np.allclose(array(attributes["WEIGHTS_0"]).sum(1), 1, atol=1e-6)
    assert (array(attributes["JOINTS_0"])[array(attributes["WEIGHTS_0"]) == 0] == 0).all()
    assert array(attributes["JOINTS_0"]).max() < len(content["skins"][0]["joints"]) == 22
    for sampler in content["animations"][0]["samplers"]:
        times = array(sampler["input"])[:, 0]
        assert (np.diff(times) > 0).all() and times[0] == 0 and len(times) == FRAMES
    for channel in content["animations"][0]["channels"][1:]:
        q = array(content["animations"][0]["samplers"][channel["sampler"]]["output"])
        assert np.allclose(np.linalg.norm(q, axis=1), 1, atol=1e-6)
        assert ((q[1:] * q[:-1]).sum(1) > 0).all(), "a sign flip makes LINEAR turn the long way round"


def test_without_unrolling_a_sign_would_flip():
    """Negative control of the last line above: the motion does need it."""
    q = rotation.matrix_to_quaternion(spin().rot)
    assert ((q[1:] * q[:-1]).sum(-1) < 0).any()


def test_pygltflib_and_trimesh_open_it(written, body):
    file = pygltflib.GLTF2().load(str(written))
    assert [file.nodes[j].name for j in file.skins[0].joints] == list(STANDARD.names)
    scene = trimesh.load(written)
    (mesh,) = scene.geometry.values()
    assert len(mesh.faces) == len(body.faces) and np.allclose(mesh.bounds[0], body.template.min(0).values, atol=1e-6)
    first = np.stack([scene.graph.get(name)[0][:3, 3] for name in STANDARD.names]) @ WORLD_FROM_GLTF.T
    assert np.abs(first - spin().positions[0].numpy()).max() < 1e-5


def test_several_people_stand_in_one_file_each_as_they_are(tmp_path, body):
    """Of different length, bone lengths and shape; what another's skin says must not leak."""
    tall = replace(spin(13, 0.3), skeleton=replace(body.skeleton.scaled(1.1), contact_names=("head",)), name="spin")
    path = tmp_path / "two.glb"
    gltf.save(path, [spin(), tall], body, names=["spin 0", "spin 1"])
    content, _ = parse(path)
    for key in ("skins", "meshes"):
        assert len(content[key]) == 2
    tops = [content["nodes"][k] for k in content["scenes"][0]["nodes"]]
    assert [node["name"] for node in tops] == ["spin 0", "spin 1"] and len(content["animations"]) == 1
    assert all(content["nodes"][node["children"][0]]["name"] == "pelvis" for node in tops)
    for k, motion in enumerate((spin(), tall)):
        back = gltf.load(path, person=k)
        assert back.name == f"spin {k}" and back.frames == motion.frames and "of 2" in back.notes[0]
        assert back.skeleton.contact_names == motion.skeleton.contact_names
        assert (back.positions - motion.positions).abs().max() < 1e-5
    with pytest.raises(DataError, match="no person 2"):
        gltf.load(path, person=2)


def test_people_without_a_body_are_skins_too(tmp_path):
    """What makes Blender build one armature with one action instead of an empty per joint; bound in the rest pose."""
    gltf.save(tmp_path / "bare.glb", [spin(), spin(9)], names=["Anna", "Bert"])
    content, array = parse(tmp_path / "bare.glb")
    assert [skin["name"] for skin in content["skins"]] == ["Anna", "Bert"] and "meshes" not in content
    assert [[content["nodes"][j]["name"] for j in skin["joints"]] for skin in content["skins"]] == [
        [*STANDARD.names]
    ] * 2
    bound = np.linalg.inv(array(content["skins"][1]["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1))
    assert np.abs(bound[:, :3, 3] - STANDARD.rest_positions().numpy()).max() < 1e-6


def test_people_who_do_not_fit_together_are_refused(tmp_path, body):
    for motions, more in (
        ([], {}),
        ([spin(), replace(spin(), fps=25.0)], {}),
        ([spin()] * 2, {"names": ["one"]}),
    ):
        with pytest.raises(ValueError):
            gltf.save(tmp_path / "a.glb", motions, body, **more)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("with_body", [True, False])
def test_round_trip(tmp_path, body, with_body):
    gltf.save(tmp_path / "a.glb", spin(), body if with_body else None)
    back = gltf.load(tmp_path / "a.glb")
    assert back.skeleton.names == STANDARD.names and back.skeleton.parents == STANDARD.parents
    assert back.skeleton.contact_names == STANDARD.contact_names and back.fps == FPS and back.name == "spin"
    assert (back.positions - spin().positions).abs().max() < 1e-5
    assert rotation.geodesic(back.rot, spin().rot).max() < 1e-3
    gltf.save(tmp_path / "b.glb", back, body if with_body else None)
    assert (gltf.load(tmp_path / "b.glb").positions - back.positions).abs().max() < 1e-6


def test_a_gltf_with_its_numbers_inside_or_beside_is_the_same_motion(tmp_path, written):
    path, text = tmp_path / "a.gltf", seeds.gltf_text(written.read_bytes())
    path.write_bytes(b"\n" + text)
    one, other = io.load(written), io.load(path)
    assert torch.equal(one.rot, other.rot) and torch.equal(one.root, other.root) and one.notes == other.notes
    assert "the body of the file that was read is lost" in rewriting.write_back(path, tmp_path / "b.glb", other, other)
    outside = json.loads(text)
    numbers = base64.b64decode(outside["buffers"][0]["uri"].partition(",")[2])
    outside["buffers"][0]["uri"] = "more/a%20b.bin"
    path.write_text(json.dumps(outside))
    with pytest.raises(DataError, match=r"a\.gltf, buffers: its numbers lie in another file, more/a%20b\.bin .*beside"):
        io.load(path)
    (tmp_path / "more").mkdir()
    (tmp_path / "more/a b.bin").write_bytes(numbers)
    assert torch.equal(io.load(path).rot, one.rot)
    where = [view["byteOffset"] for view in outside["bufferViews"]]  # a buffer for each view, every second one inside
    outside["buffers"], parts = [], zip(where, [*where[1:], len(numbers)], strict=True)
    for k, (start, stop) in enumerate(parts):
        inside = "data:application/gltf-buffer;base64," + base64.b64encode(numbers[start:stop]).decode()
        (tmp_path / f"{k}.bin").write_bytes(numbers[start:stop])
        outside["buffers"].append({"uri": inside if k % 2 else f"{k}.bin", "byteLength": stop - start})
        outside["bufferViews"][k] |= {"byteOffset": 0, "buffer": k}
    path.write_text(json.dumps(outside))
    assert torch.equal(io.load(path).rot, one.rot) and torch.equal(io.load(path).root, one.root)
    (tmp_path / "0.bin").write_bytes((tmp_path / "0.bin").read_bytes()[:-40])  # else the next one's stand for the rest
    with pytest.raises(DataError, match=r"a\.gltf, buffers: fewer bytes"):
        io.load(path)
    told = recordings.passed_over(tmp_path)
    assert len(told) == 2 and all("numbers of a .gltf" in line for line in told)


@pytest.mark.parametrize(
    "uri", ["../a.bin", "/etc/passwd", "https://example.org/a.bin", "a.bin", "link.bin", "data:text/plain,1", 7]
)
def test_numbers_from_elsewhere_are_not_fetched(tmp_path, written, uri):
    content = json.loads(seeds.gltf_text(written.read_bytes()))
    content["buffers"][0]["uri"] = uri
    (tmp_path / "a.bin").write_bytes(b"")
    (tmp_path / "below").mkdir()
    (tmp_path / "below/a.gltf").write_text(json.dumps(content))
    (tmp_path / "below/link.bin").symlink_to(tmp_path / "a.bin")
    with pytest.raises(DataError, match="its numbers lie (elsewhere|in another file)" if uri != 7 else "Error"):
        io.load(tmp_path / "below/a.gltf")


def test_packed_numbers_are_refused_with_a_way_out(tmp_path, written):
    packed = {"extensionsRequired": ["EXT_meshopt_compression"]}
    (tmp_path / "a.glb").write_bytes(rewrite(written, lambda c: c.update(packed)))
    with pytest.raises(DataError, match=r"packed, by EXT_meshopt_compression .*gltf-transform"):
        io.load(tmp_path / "a.glb")


def rewrite(path, change):
    """The file with its JSON changed by a function."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    content = json.loads(data[20 : 20 + size])
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    rest = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + size :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(rest)) + rest


DAMAGE = {
    "no animation, no skin": lambda c: (c.pop("animations"), c.pop("skins")),
    "no nodes": lambda c: c.pop("nodes"),
    "joint not there": lambda c: c["skins"][0].update(joints=[0, 99]),
    "circle": lambda c: (c["nodes"][21].update(children=[0]), c["nodes"][22].pop("children")),
    "two parents": lambda c: c["nodes"][21].update(children=[0]),
    "two trees": lambda c: c["skins"][0].update(joints=[4, 5, 7, 8]),
    "view past the end": lambda c: c["bufferViews"][0].update(byteOffset=10**9),
    "negative offset": lambda c: c["bufferViews"][0].update(byteOffset=-4),
    "no view": lambda c: c["accessors"][0].pop("bufferView"),
    "huge count": lambda c: c["accessors"][1].update(count=10**12),
    "no count": lambda c: c["accessors"][1].update(count=0),
    "wrong type": lambda c: c["accessors"][1].update(type="SCALAR"),
    "cubic": lambda c: c["animations"][0]["samplers"][0].update(interpolation="CUBICSPLINE"),
    "negative fps": lambda c: c["animations"][0]["extras"].update(fps=-30),
    "unknown contact": lambda c: c["animations"][0]["extras"].update(contact_names=["tail"]),
    "mirrored": lambda c: c["nodes"][3].update(scale=[-2, 2, 2]),
    "flat": lambda c: c["nodes"][3].update(matrix=np.diag([1.0, 0, 1, 1]).ravel().tolist()),
    "list for nodes": lambda c: c.update(nodes=[[]]),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_json_is_named(tmp_path, written, damage):
    path = tmp_path / "bad.glb"
    path.write_bytes(rewrite(written, DAMAGE[damage]))
    with pytest.raises(DataError) as error:
        gltf.load(path)
    assert "bad.glb" in str(error.value) and error.value.remedy


FORWARD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])  # glTF from world


class Foreign:
    """A GLB as others write them: bones with axes of their own, a scaled and turned armature, keys where they like."""

    def __init__(self, motion, unit=0.01, bound=True, names=True):
        draw, tree = torch.Generator().manual_seed(3), motion.skeleton.parents
        self.file, self.frames = gltf._Buffer(), rotation.random((len(tree),), draw, dtype=torch.float64)
        self.file.content["asset"]["generator"] = "somebody else"
        armature = rotation.random((1,), draw, dtype=torch.float64)[0]
        above = torch.cat((torch.eye(3).double()[None], self.frames[list(tree[1:])]))
        rot = motion.rot.double().clone()
        rot[:, 0] = armature.T @ torch.from_numpy(FORWARD) @ rot[:, 0]
        self.turns = rotation.matrix_to_quaternion(above.mT @ rot @ self.frames)[..., [1, 2, 3, 0]].numpy()
        self.root = (motion.root.double().numpy() @ FORWARD.T @ armature.numpy()) / unit
        places = (above.mT @ motion.skeleton.offsets.double()[..., None])[..., 0] / unit
        places[0] = 0
        rest = rotation.matrix_to_quaternion(above.mT @ self.frames)[:, [1, 2, 3, 0]].tolist()
        nodes = self.file.content["nodes"]
        for k, name in enumerate(motion.skeleton.names):
            children = [j for j, parent in enumerate(tree) if parent == k]
            nodes.append({"translation": places[k].tolist(), "rotation": rest[k], "children": children})
            nodes[-1] |= {"name": name} if names else {}
        turn = rotation.matrix_to_quaternion(armature)[[1, 2, 3, 0]].tolist()
        nodes.append({"name": "Armature", "children": [0], "rotation": turn, "scale": [unit] * 3})
        self.file.content["scenes"][0]["nodes"] = [len(nodes) - 1]
        skin = {"joints": list(range(len(tree)))}
        if bound:
            bind = torch.eye(4, dtype=torch.float64).repeat(len(tree), 1, 1)
            bind[:, :3, :3], bind[:, :3, 3] = self.frames, motion.skeleton.rest_positions().double()
            skin["inverseBindMatrices"] = self.file.add(torch.linalg.inv(bind).mT, "f4")
        self.file.content["skins"] = [skin]
        self.file.content["animations"] = []

    def key(self, node, path, times, values, how="LINEAR"):
        times, values = (self.file.add(np.asarray(x, dtype=float), "f4") for x in (times, values))
        self.file.channels.append({"sampler": len(self.file.samplers), "target": {"node": node, "path": path}})
        self.file.samplers.append({"input": times, "output": values, "interpolation": how})

    def write(self, path, name="walk"):
        animation = {"name": name, "samplers": self.file.samplers, "channels": self.file.channels}
        self.file.content["animations"].append(animation)
        self.file.samplers, self.file.channels = [], []
        path.write_bytes(self.file.glb())
        return path

    def sampled(self, path, start=1 / 30):
        times = start + np.arange(len(self.root)) / 30
        self.key(0, "translation", times, self.root)
        for k in range(self.turns.shape[1]):
            self.key(k, "rotation", times, self.turns[:, k])
            self.key(k, "scale", times[[0, -1]], np.ones((2, 3)), "STEP")
            if k:
                still = np.array(self.file.content["nodes"][k]["translation"])
                self.key(k, "translation", times[[0, -1]], [still, still], "STEP")
        return self.write(path)


@pytest.mark.parametrize("bound", [True, False])
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_a_file_of_others_is_the_same_motion_on_its_bound_pose(tmp_path, unit, bound):
    """Constant channels with two keys, an armature that is scaled and turned, axes of bones that point anywhere."""
    loaded = gltf.load(Foreign(spin(), unit, bound).sampled(tmp_path / "a.glb"))
    order = loaded.skeleton.indices(STANDARD.names)
    assert loaded.fps == FPS and (loaded.positions[:, order] - spin().positions).abs().max() < 1e-5
    rest = loaded.skeleton.rest_positions()[order]
    if bound:
        assert (rest - STANDARD.rest_positions()).abs().max() < 1e-5
        assert rotation.geodesic(loaded.rot[:, order], spin().rot).max() < 1e-3
    else:  # the zero pose is that of the nodes: the T-pose below the armature
        apart = torch.cdist(rest[None], rest[None]) - torch.cdist(*[STANDARD.rest_positions()[None]] * 2)
        assert apart.abs().max() < 1e-4


@pytest.mark.parametrize("names", [True, False])
def test_a_file_of_others_is_written_back(tmp_path, names):
    path = Foreign(spin(), names=names).sampled(tmp_path / "a.glb")
    loaded = gltf.load(path)
    rot, root = loaded.rot.clone(), loaded.root.clone()
    rot[4, 3] = rotation.rotation_about("x", torch.tensor(0.4)) @ rot[4, 3]
    rot[9, 0], root[6] = UPRIGHT, root[6] + 0.25
    made = replace(loaded, rot=rot, root=root)
    said = rewriting.write_back(path, tmp_path / "b.glb", loaded, made)
    again = gltf.load(tmp_path / "b.glb")
    assert said.startswith(f"{FRAMES - 3} of {FRAMES} frames")
    assert (again.positions - made.positions).abs().max() < 1e-5
    same = [t for t in range(FRAMES) if t not in (4, 6, 9)]
    assert torch.equal(again.rot[same], loaded.rot[same]) and torch.equal(again.root[same], loaded.root[same])


@pytest.mark.parametrize("frames", [7, 31])
def test_a_file_of_others_gets_another_motion_as_a_new_animation_and_keeps_the_rest(tmp_path, frames):
    path = Foreign(spin()).sampled(tmp_path / "a.glb")
    loaded = gltf.load(path)
    index = (5 * torch.arange(frames)) % FRAMES
    made = replace(loaded, rot=loaded.rot[index], root=loaded.root[index] + 0.5, fps=25.0, name="new")
    said = rewriting.write_back(path, tmp_path / "b.glb", loaded, made)
    again, old = gltf.load(tmp_path / "b.glb"), gltf.load(tmp_path / "b.glb", animation="walk")
    assert "new animation" in said and (again.name, again.fps, again.frames) == ("new", 25.0, frames)
    assert (again.positions - made.positions).abs().max() < 1e-5
    assert torch.equal(old.rot, loaded.rot) and torch.equal(old.root, loaded.root)
    before, after = parse(path)[0], parse(tmp_path / "b.glb")[0]
    assert all(after[key] == before[key] for key in ("nodes", "skins", "scenes"))


def test_a_skin_without_animation_is_one_pose_and_can_be_given_a_motion(tmp_path):
    whole, bare = Foreign(spin()).sampled(tmp_path / "a.glb"), tmp_path / "bare.glb"
    bare.write_bytes(rewrite(whole, lambda c: c.pop("animations")))
    loaded, moving = gltf.load(bare), gltf.load(whole)
    assert loaded.frames == 1 and any("no animation" in note for note in loaded.notes)
    assert loaded.skeleton.names == moving.skeleton.names
    torch.testing.assert_close(loaded.skeleton.offsets, moving.skeleton.offsets)
    made = replace(moving, name="new")
    assert "new animation" in rewriting.write_back(bare, tmp_path / "b.glb", loaded, made)
    again = gltf.load(tmp_path / "b.glb")
    assert again.name == "new" and (again.positions - moving.positions).abs().max() < 1e-5


def test_keys_at_odd_times_are_read_evenly(tmp_path):
    """A cubic and a straight root, a turn that is slerped, one that steps: each by its own keys, against formulas."""
    file = Foreign(spin(), unit=1.0)
    knee, elbow = STANDARD.index("left_knee"), STANDARD.index("left_elbow")
    times, place = np.array([0.0, 0.5, 2.0]), np.array([1.0, 2.0, 3.0])
    cubic = [[3 * t**2 * place, t**3 * place, 3 * t**2 * place] for t in times]
    file.key(0, "translation", times, np.reshape(cubic, (9, 3)), "CUBICSPLINE")
    file.key(knee, "rotation", [0.0, 1.0], Rotation.from_euler("x", [[0], [90]], degrees=True).as_quat())
    file.key(elbow, "rotation", [0.0, 1.0], Rotation.from_euler("z", [[10], [70]], degrees=True).as_quat(), "STEP")
    loaded = gltf.load(file.write(tmp_path / "a.glb"), fps=30)
    seconds = np.arange(61) / 30
    assert loaded.frames == 61 and loaded.fps == 30
    armature = Rotation.from_quat(file.file.content["nodes"][-1]["rotation"]).as_matrix()
    expected = (seconds[:, None] ** 3 * place) @ armature.T @ FORWARD
    np.testing.assert_allclose(loaded.root.numpy(), expected, atol=1e-4)
    undone = reframed(loaded.skeleton.to(torch.float64), loaded.rot.double(), torch.linalg.inv(file.frames))[1]
    turn = Rotation.from_matrix(undone[:, loaded.skeleton.index("left_knee")].numpy()).as_rotvec(degrees=True)
    np.testing.assert_allclose(turn, np.minimum(seconds, 1)[:, None] * [90, 0, 0], atol=1e-2)
    turn = Rotation.from_matrix(undone[:, loaded.skeleton.index("left_elbow")].numpy()).as_rotvec(degrees=True)
    np.testing.assert_allclose(turn[:, 2], np.where(seconds < 0.999, 10, 70), atol=1e-2)
    assert any("not one per frame" in note for note in gltf.load(tmp_path / "a.glb").notes)


def test_one_of_several_animations_is_chosen_and_all_are_listed(tmp_path):
    file = Foreign(spin())
    for name, shift in (("Walk", 0.0), ("Run", 50.0)):
        file.key(0, "translation", [0.0, 1 / 30], [[0, 0, shift], [0, 0, shift]])
        file.write(tmp_path / "a.glb", name)
    first, run = gltf.load(tmp_path / "a.glb"), gltf.load(tmp_path / "a.glb", animation="Run")
    assert first.name == "Walk" and any("Walk, Run" in note and "--animation" in note for note in first.notes)
    assert run.name == "Run" and torch.equal(gltf.load(tmp_path / "a.glb", animation="1").root, run.root)
    assert float((run.root - first.root).norm(dim=-1)[0]) == pytest.approx(0.5, abs=1e-5)
    with pytest.raises(DataError, match="no animation 'Jump': it holds Walk, Run"):
        gltf.load(tmp_path / "a.glb", animation="Jump")


def test_joints_below_others_that_are_none_and_beside_the_figure(tmp_path):
    """A node between two joints, and a handle beside the root: the first is composed, the second left out aloud."""
    file = Foreign(spin(), unit=1.0)
    nodes, skin = file.file.content["nodes"], file.file.content["skins"][0]
    neck, head = STANDARD.index("neck"), STANDARD.index("head")
    nodes += [{"name": "between", "children": [head], "translation": [0, 0.1, 0]}, {"name": "handle"}]
    nodes[neck]["children"].remove(head)
    nodes[neck]["children"].append(len(nodes) - 2)
    nodes[22]["children"].append(len(nodes) - 1)
    skin["joints"].append(len(nodes) - 1)
    del skin["inverseBindMatrices"]
    loaded = gltf.load(file.sampled(tmp_path / "a.glb"))
    assert len(loaded.skeleton) == 22 and any("left out: handle" in note for note in loaded.notes)
    longer = (loaded.skeleton.offsets[loaded.skeleton.index("head")]).norm()
    frame = file.frames[neck].T @ STANDARD.offsets[head].double()
    assert float(longer) == pytest.approx(float((frame + torch.tensor([0, 0.1, 0])).norm()), abs=1e-5)


def test_what_has_no_key_in_every_frame_is_given_one(tmp_path):
    """A bone that stood still has two keys at most."""
    file = Foreign(spin())
    file.turns[:] = file.turns[:1]
    file.key(0, "translation", np.arange(FRAMES) / 30, file.root)
    for k in range(22):
        file.key(k, "rotation", [0, (FRAMES - 1) / 30], file.turns[[0, -1], k], "STEP")
    loaded = gltf.load(file.write(tmp_path / "a.glb"))
    rot = loaded.rot.clone()
    rot[4, 3] = rotation.rotation_about("x", torch.tensor(0.4)) @ rot[4, 3]
    said = rewriting.write_back(tmp_path / "a.glb", tmp_path / "b.glb", loaded, replace(loaded, rot=rot))
    assert said.startswith(f"{FRAMES - 1} of {FRAMES} frames")
    assert (gltf.load(tmp_path / "b.glb").positions - replace(loaded, rot=rot).positions).abs().max() < 1e-5
