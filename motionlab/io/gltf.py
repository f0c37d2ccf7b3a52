"""Skinned, animated GLB files (glTF 2.0, binary) that Blender and three.js open.

glTF is y up: world (x, y, z) is written as (x, z, -y), which Blender turns back into the same (x, y, z).
Blender, three.js and glTF bind a vertex with world_j inverse_bind_j; ours are [R_j | p_j] and
[bind_rot_j^T | -bind_rot_j^T joint_j], so that a viewer computes exactly :func:`motionlab.body.lbs`.

Source: the glTF 2.0 specification (Khronos), 3.7.3 Skins and 3.11 Animations; 4.4 GLB layout.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.body import BodyModel
from motionlab.errors import ShapeError
from motionlab.files import write_whole
from motionlab.io.reading import Spot, check_writable, frame_rate, numbers, read_bytes, reading
from motionlab.motion import Motion
from motionlab.rest import places_of
from motionlab.skeleton import Skeleton
from motionlab.tailoring import tailored

_COMPONENTS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_VERTICES, _INDICES = 34962, 34963  # targets of a buffer view
#: glTF from world: a quarter turn about x.
_Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_MAGIC, _JSON_CHUNK, _BIN_CHUNK = b"glTF", b"JSON", b"BIN\0"
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def save(
    path: str | Path,
    motions: Motion | Sequence[Motion],
    body: BodyModel | None = None,
    *,
    names: Sequence[str] | None = None,
    betas: Tensor | Sequence[Tensor] | None = None,
    colour: tuple[float, float, float] = (0.62, 0.66, 0.72),
) -> None:
    """Writes one person or several as an animated GLB: each an armature of joints, one key per frame, and the body as
    a skinned mesh. One animation moves all of them, since most viewers play only the first.

    The nodes rest at the first frame. The file appears whole or not at all. Contacts are not kept.

    Args:
        motions: one clip, or one per person at one frame rate; no batch axes. All begin at time 0.
        body: its mesh and weights; None writes the armatures alone, bound in the rest pose.
        names: of the people; by default those of the motions, numbered where they are not different.
        betas: (B,) shape of the body, or one for each person; else the body is tailored to the motion's bones, whose
            lengths are the motion's either way.
        colour: linear red, green, blue of the matt material.

    Raises:
        ShapeError: nobody, a motion has batch axes, frame rates differ, names or betas are not one per person, or
            the body has other joints.
        DataError: a motion holds NaN or infinity (names the frame), or the file cannot be written.
    """
    people = [motions] if isinstance(motions, Motion) else list(motions)
    for motion in people:
        check_writable(path, motion)
        if body is not None and body.skeleton.names != motion.skeleton.names:
            raise ShapeError(f"the body's joints are {body.skeleton.names}, the motion's {motion.skeleton.names}")
    if len({motion.fps for motion in people}) != 1:
        raise ShapeError(f"expected one frame rate, got {[motion.fps for motion in people]}: use motion.resample")
    shapes = list(betas) if betas is not None and (not isinstance(betas, Tensor) or betas.ndim == 2) else None
    shapes = shapes or [betas] * len(people)
    names = _different([motion.name or "motion" for motion in people]) if names is None else list(names)
    if not len(people) == len(shapes) == len(names):
        raise ShapeError(f"{len(people)} people, {len(names)} names and {len(shapes)} betas: expected one for each")
    file = _Buffer()
    for motion, name, shape in zip(people, names, shapes, strict=True):
        skeleton, first = motion.skeleton, _animate(file, motion, name)
        if body is None:
            pose = torch.eye(3).expand(len(skeleton), 3, 3) if skeleton.standing is None else skeleton.standing
            _bind(file, first, name, skeleton, places_of(skeleton, pose), pose)
        else:
            worn = body if shape is not None else tailored(body, skeleton)
            template, joints = worn.template, worn.joints
            if shape is not None:
                template = template + body.shape_directions @ shape.to(template)
                joints = joints + body.joint_directions @ shape.to(joints)
            _bind(file, first, name, skeleton, joints, body.bind_rot)
            _mesh(file, name, body, template, colour)
    animation = {"name": people[0].name or "motion", "samplers": file.samplers, "channels": file.channels}
    file.content["animations"] = [animation | {"extras": {"fps": people[0].fps}}]
    write_whole(path, file.glb())


def _different(names: list[str]) -> list[str]:
    """The names, with their place where one stands there twice."""
    return [f"{name} {k}" if names.count(name) > 1 else name for k, name in enumerate(names, start=1)]


def load(path: str | Path, *, person: int = 0) -> Motion:
    """Reads one person of the first animation of a GLB as a motion with the file's own skeleton.

    The joints are those of a skin, or of the animation where there is no skin. Every animated joint needs
    a key per frame at one steady rate, as :func:`save` and Blender's sampled export write.

    Args:
        person: which skin of several, in the file's order; that there are others is noted.
    Raises:
        DataError: not such a file, or nobody with this number.
    """
    with reading(path, "write it with motionlab.io.gltf.save, or export GLB with sampled animation") as at:
        content, blob = _chunks(at)
        return _motion(at, content, blob, person)


class _Buffer:
    """A glTF document under construction: its JSON and its one binary buffer."""

    def __init__(self) -> None:
        self.content = {"asset": {"version": "2.0", "generator": "motionlab"}, "accessors": [], "bufferViews": []}
        self.content |= {"scene": 0, "scenes": [{"nodes": []}], "nodes": [], "skins": []}
        self.samplers: list[dict] = []
        self.channels: list[dict] = []
        self.blob = bytearray()

    def add(self, array: np.ndarray | Tensor, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """Append an array (N,) or (N, ...) as one accessor on its own aligned view; its index."""
        array = np.ascontiguousarray(array, dtype=f"<{kind}").reshape(len(array), -1)
        self.blob += bytes(-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": array.nbytes}
        self.blob += array.tobytes()
        self.content["bufferViews"].append(view | ({"target": target} if target else {}))
        accessor = {
            "bufferView": len(self.content["bufferViews"]) - 1,
            "componentType": _COMPONENTS[kind],
            "count": len(array),
            "type": _TYPES[array.shape[1]],
        }
        if bounds:
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def glb(self) -> bytes:
        """The file: header, JSON chunk padded with spaces, binary chunk padded with zeros."""
        blob = bytes(self.blob) + bytes(-len(self.blob) % 4)
        self.content["buffers"] = [{"byteLength": len(blob)}]
        text = json.dumps(self.content, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = [(_JSON_CHUNK, text), (_BIN_CHUNK, blob)]
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        return struct.pack("<4sII", _MAGIC, 2, 12 + len(body)) + body


def _animate(file: _Buffer, motion: Motion, name: str) -> int:
    """Add one person's joints as nodes that rest at the first frame, below one node with their name, and what moves
    them; the index of the first joint."""
    skeleton, up, nodes = motion.skeleton, _Y_UP.double(), file.content["nodes"]
    rot = motion.rot.detach().cpu().double()
    rot = torch.cat((up @ rot[:, :1], rot[:, 1:]), dim=1)
    quaternion = rotation.unroll_quaternion(rotation.matrix_to_quaternion(rot), dim=-3)[..., [1, 2, 3, 0]]
    quaternion = torch.nn.functional.normalize(quaternion, dim=-1)
    root = motion.root.detach().cpu().double() @ up.mT
    places, first = [root[0].tolist(), *skeleton.offsets[1:].tolist()], len(nodes)
    nodes += [
        {"name": joint, "translation": place, "rotation": turn}
        for joint, place, turn in zip(skeleton.names, places, quaternion[0].tolist(), strict=True)
    ]
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        nodes[first + parent].setdefault("children", []).append(first + joint)
    file.content["scenes"][0]["nodes"].append(len(nodes))
    nodes.append({"name": name, "children": [first]})
    time = file.add(torch.arange(motion.frames, dtype=torch.float64) / motion.fps, "f4", bounds=True)
    for joint, what, keys in [
        (0, "translation", root),
        *((j, "rotation", x) for j, x in enumerate(quaternion.unbind(1))),
    ]:
        file.channels.append({"sampler": len(file.samplers), "target": {"node": first + joint, "path": what}})
        file.samplers.append({"input": time, "interpolation": "LINEAR", "output": file.add(keys, "f4")})
    return first


def _bind(file: _Buffer, first: int, name: str, skeleton: Skeleton, joints: Tensor, bind_rot: Tensor) -> None:
    """Add a skin: joints (J, 3) and how they are turned (J, 3, 3) where the mesh is bound."""
    joints, back = joints.detach().cpu().double(), bind_rot.detach().cpu().double().mT
    inverse_bind = torch.eye(4, dtype=torch.float64).repeat(len(joints), 1, 1)
    inverse_bind[:, :3, :3] = back
    inverse_bind[:, :3, 3] = -(back @ joints[..., None])[..., 0]
    file.content["skins"].append(
        {
            "name": name,
            "inverseBindMatrices": file.add(inverse_bind.mT, "f4"),  # glTF stores columns first
            "skeleton": first,
            "joints": list(range(first, first + len(joints))),
            "extras": {"contact_names": skeleton.contact_names, "sole": float(skeleton.sole)},
        }
    )


def _mesh(file: _Buffer, name: str, body: BodyModel, template: Tensor, colour: tuple) -> None:
    """Add the mesh of the last skin, in its bind pose, beside the joints.

    A vertex keeps its four largest weights, scaled to sum to 1: every viewer reads so many. anny's hang on up to six
    joints, whose weakest two have up to 3 % (millimetres at a few vertices).
    """
    template, faces, nodes = template.detach().cpu().double(), body.faces.cpu(), file.content["nodes"]
    attributes = {
        "POSITION": file.add(template, "f4", _VERTICES, bounds=True),
        "NORMAL": file.add(_normals(template, faces), "f4", _VERTICES),
    }
    joints = body.weights.shape[1]
    share, which = body.weights.detach().cpu().double().topk(min(4, joints), dim=1)
    pad = (0, 4 - share.shape[1])
    share, which = (torch.nn.functional.pad(x, pad) for x in (share, which))
    which = torch.where(share > 0, which, 0)
    share = (share / share.sum(1, keepdim=True)).numpy()
    attributes["JOINTS_0"] = file.add(which, "u1" if joints <= 256 else "u2", _VERTICES)
    attributes["WEIGHTS_0"] = file.add(share, "f4", _VERTICES)
    indices = file.add(faces.reshape(-1), "u2" if len(template) < 65535 else "u4", _INDICES)
    matt = {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7}
    file.content["materials"] = [{"name": "body", "pbrMetallicRoughness": matt}]
    meshes = file.content.setdefault("meshes", [])
    nodes[-1]["children"].append(len(nodes))
    nodes.append({"name": f"{name} body", "mesh": len(meshes), "skin": len(file.content["skins"]) - 1})
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    meshes.append({"name": f"{name} body", "primitives": [primitive]})


def _normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit vertex normals (V, 3), area weighted; y where a vertex has no face."""
    a, b, c = vertices[faces].unbind(1)
    face = torch.linalg.cross(b - a, c - a, dim=-1)
    total = torch.zeros_like(vertices).index_add_(0, faces.reshape(-1), face.repeat_interleave(3, 0))
    length = total.norm(dim=-1, keepdim=True)
    return torch.where(length > 0, total / length, torch.tensor([0.0, 1.0, 0.0]).to(total))


def _chunks(at: Spot) -> tuple[dict, bytes]:
    """The JSON and the binary chunk."""
    data = read_bytes(at)
    if len(data) < 20 or data[:4] != _MAGIC:
        raise at.error("not a GLB file", place="header")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length != len(data):
        raise at.error(f"version {version}, {length} bytes promised, {len(data)} present", place="header")
    found, start = {}, 12
    while start + 8 <= len(data):
        size, kind = struct.unpack_from("<I4s", data, start)
        if start + 8 + size > len(data):
            raise at.error(f"chunk {kind!r} promises {size} bytes, past the end", place=f"byte {start}")
        found.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    if _JSON_CHUNK not in found:
        raise at.error("no JSON chunk", place="header")
    content = json.loads(found[_JSON_CHUNK].decode())
    return content, found.get(_BIN_CHUNK, b"")


def _array(at: Spot, content: dict, blob: bytes, index: int, width: int, place: str) -> np.ndarray:
    """The numbers of a float accessor, (N, width)."""
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    count, stride = accessor["count"], view.get("byteStride", 4 * width)
    if (accessor["type"], accessor["componentType"]) != (_TYPES[width], 5126) or "sparse" in accessor:
        raise at.error(f"expected float {_TYPES[width]}, got {accessor['type']}", place=place)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if min(start, count - 1, stride - 4 * width) < 0 or start + (count - 1) * stride + 4 * width > len(blob):
        raise at.error(
            f"{count} values of {stride} bytes from byte {start} do not lie in {len(blob)} bytes", place=place
        )
    rows = np.ndarray((count, width), "<f4", blob, start, (stride, 4))
    return numbers(at, rows, f"T {width}", place)


def _motion(at: Spot, content: dict, blob: bytes, person: int) -> Motion:
    nodes, skins = content["nodes"], content.get("skins") or []
    if not content.get("animations"):
        raise at.error("holds no animation", place="animations")
    if not 0 <= person < max(len(skins), 1):
        raise at.error(f"no person {person}: {len(skins)} skins", remedy="count them from 0")
    animation, skin = content["animations"][0], skins[person] if skins else {}
    channels = [
        (channel["target"]["node"], channel["target"]["path"], animation["samplers"][channel["sampler"]])
        for channel in animation["channels"]
        if channel["target"]["path"] in ("translation", "rotation", "scale") and "node" in channel["target"]
    ]
    parent: dict[int, int] = {}
    for i, node in enumerate(nodes):
        for child in node.get("children", ()):
            if parent.setdefault(child, i) != i:
                raise at.error("a node with two parents", place=f"node {child}")
    joints = skin.get("joints") or sorted({node for node, _, _ in channels})
    chains = {joint: _chain(at, parent, joint, len(nodes)) for joint in joints}
    joints = sorted(joints, key=lambda joint: len(chains[joint]))
    index = {joint: i for i, joint in enumerate(joints)}
    if any(parent.get(joint) not in index for joint in joints[1:]):
        raise at.error("the joints are not one tree", place="skin")

    tracks, times = {}, None
    for node, what, sampler in channels:
        if node not in index and node not in chains[joints[0]]:
            continue
        place = f"node {node} {what}"
        if sampler.get("interpolation", "LINEAR") == "CUBICSPLINE":
            raise at.error("cubic spline keys are not sampled frames", place=place)
        tracks[node, what] = _array(at, content, blob, sampler["output"], 4 if what == "rotation" else 3, place)
        keys = _array(at, content, blob, sampler["input"], 1, f"{place} times")[:, 0]
        times = keys if times is None else times
        if len(tracks[node, what]) != len(keys) or keys.shape != times.shape or abs(keys - times).max() > 1e-4:
            raise at.error("its keys are not at the times of the other channels", place=place)
    if times is None:
        raise at.error("animates no joint", place="animations")
    extras = skin.get("extras", {}) | animation.get("extras", {})
    steady = (len(times) - 1) / (times[-1] - times[0]) if times[-1] > times[0] else None
    fps = frame_rate(at, extras.get("fps", steady))
    if abs(times - times[0] - np.arange(len(times)) / fps).max() > 0.05 / fps:
        raise at.error(f"its keys are not one per frame at {fps:g} frames per second", place="times")

    def place(node: int, what: str) -> Tensor:  # (T, 3) or (T, 4)
        rest = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}[what]
        still = numbers(at, nodes[node].get(what, rest), str(len(rest)), f"node {node} {what}")
        return torch.as_tensor(tracks.get((node, what), np.tile(still, (len(times), 1))))

    def turn(node: int) -> Tensor:  # (T, 3, 3)
        quaternion = place(node, "rotation")
        if ((quaternion.norm(dim=-1) - 1).abs() > 0.01).any():
            raise at.error("not a unit quaternion", place=f"node {node} rotation")
        return rotation.quaternion_to_matrix(quaternion[:, [3, 0, 1, 2]])

    offsets = [place(joint, "translation") for joint in joints]
    for joint, offset in zip(joints, offsets, strict=True):
        if "matrix" in nodes[joint] or (place(joint, "scale") - 1).abs().max() > 1e-3:
            raise at.error("a joint that is scaled or given as a matrix", place=f"node {joint}")
        if joint != joints[0] and (offset - offset[0]).abs().max() > 1e-3:
            raise at.error("a bone that changes its length", place=f"node {joint} translation")
    rot, root = torch.stack([turn(joint) for joint in joints], dim=1), offsets[0]
    for node in chains[joints[0]][1:]:
        if "matrix" in nodes[node] or (place(node, "scale") - 1).abs().max() > 1e-3:
            raise at.error("a node above the joints that is scaled or given as a matrix", place=f"node {node}")
        rot[:, 0] = turn(node) @ rot[:, 0]
        root = (turn(node) @ root[..., None])[..., 0] + place(node, "translation")
    rot[:, 0] = _Y_UP.double().mT @ rot[:, 0]
    skeleton = Skeleton(
        names=tuple(str(nodes[joint].get("name", f"joint{joint}")) for joint in joints),
        parents=(-1, *(index[parent[joint]] for joint in joints[1:])),
        offsets=torch.stack([offset[0] for offset in offsets]).float()
        * torch.tensor([0.0] + [1.0] * (len(joints) - 1))[:, None],
        contact_names=tuple(extras.get("contact_names", ())),
        sole=float(extras.get("sole", 0.0)),
        standing=_standing(at, content, blob, skin, joints, chains),
    )
    name = str((skin if len(skins) > 1 else animation).get("name", ""))
    notes = (f"person {person} of {len(skins)} in the file",) if len(skins) > 1 else ()
    return Motion(skeleton, (root @ _Y_UP.double()).float(), rot.float(), fps, name=name, notes=notes)


def _standing(
    at: Spot, content: dict, blob: bytes, skin: dict, joints: list[int], chains: dict[int, list[int]]
) -> Tensor:
    """How the joints are turned (J, 3, 3) where the skin is bound, or else where the nodes rest."""
    if "inverseBindMatrices" in skin:
        columns = _array(at, content, blob, skin["inverseBindMatrices"], 16, "inverse bind matrices")
        bound = torch.as_tensor(columns).reshape(-1, 4, 4)[:, :3, :3]  # columns first: transposed, which turns back
        return rotation.nearest(bound[[skin["joints"].index(joint) for joint in joints]])
    pose = []
    for joint in joints:
        turn = torch.eye(3, dtype=torch.float64)
        for node in chains[joint]:
            still = numbers(at, content["nodes"][node].get("rotation", (0, 0, 0, 1)), "4", f"node {node} rotation")
            turn = rotation.quaternion_to_matrix(torch.as_tensor(still)[[3, 0, 1, 2]]) @ turn
        pose.append(turn)
    return torch.stack(pose)


def _chain(at: Spot, parent: dict[int, int], node: int, count: int) -> list[int]:
    """The node and everything above it, to the top."""
    chain = [node]
    while chain[-1] in parent:
        chain.append(parent[chain[-1]])
        if len(chain) > count:
            raise at.error("the nodes form a circle", place=f"node {node}")
    return chain
