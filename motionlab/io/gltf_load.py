"""Reading the animation of a GLB file back; see :mod:`motionlab.io.gltf` for the conventions."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.io.reading import Spot, frame_rate, numbers, read_bytes, reading
from motionlab.motion import Motion
from motionlab.skeleton import Skeleton

#: glTF from world: a quarter turn about x.
Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
MAGIC, JSON_CHUNK, BIN_CHUNK = b"glTF", b"JSON", b"BIN\0"
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def load(path: str | Path) -> Motion:
    """Read the first animation of a GLB as a motion with the file's own skeleton.

    The joints are those of the first skin, or of the animation where there is no skin. Every animated
    joint needs a key per frame at one steady rate, as :func:`save` and Blender's sampled export write.

    Raises:
        DataError: not such a file.
    """
    with reading(path, "write it with motionlab.io.gltf.save, or export GLB with sampled animation") as at:
        content, blob = _chunks(at)
        return _motion(at, content, blob)


def _chunks(at: Spot) -> tuple[dict, bytes]:
    """The JSON and the binary chunk."""
    data = read_bytes(at)
    if len(data) < 20 or data[:4] != MAGIC:
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
    if JSON_CHUNK not in found:
        raise at.error("no JSON chunk", place="header")
    content = json.loads(found[JSON_CHUNK].decode())
    return content, found.get(BIN_CHUNK, b"")


def _array(at: Spot, content: dict, blob: bytes, index: int, width: int, place: str) -> np.ndarray:
    """The numbers of a float accessor, (N, width)."""
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    count, stride = accessor["count"], view.get("byteStride", 4 * width)
    if (accessor["type"], accessor["componentType"]) != (TYPES[width], 5126) or "sparse" in accessor:
        raise at.error(f"expected float {TYPES[width]}, got {accessor['type']}", place=place)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if min(start, count - 1, stride - 4 * width) < 0 or start + (count - 1) * stride + 4 * width > len(blob):
        raise at.error(
            f"{count} values of {stride} bytes from byte {start} do not lie in {len(blob)} bytes", place=place
        )
    rows = np.ndarray((count, width), "<f4", blob, start, (stride, 4))
    return numbers(at, rows, f"T {width}", place)


def _motion(at: Spot, content: dict, blob: bytes) -> Motion:
    nodes = content["nodes"]
    if not content.get("animations"):
        raise at.error("holds no animation", place="animations")
    animation = content["animations"][0]
    tracks, times = {}, None
    for channel in animation["channels"]:
        node, what = channel["target"].get("node"), channel["target"]["path"]
        sampler, place = animation["samplers"][channel["sampler"]], f"node {node} {what}"
        if what not in ("translation", "rotation", "scale") or node is None:
            continue
        if sampler.get("interpolation", "LINEAR") == "CUBICSPLINE":
            raise at.error("cubic spline keys are not sampled frames", place=place)
        tracks[node, what] = _array(at, content, blob, sampler["output"], 4 if what == "rotation" else 3, place)
        keys = _array(at, content, blob, sampler["input"], 1, f"{place} times")[:, 0]
        times = keys if times is None else times
        if len(tracks[node, what]) != len(keys) or keys.shape != times.shape or abs(keys - times).max() > 1e-4:
            raise at.error("its keys are not at the times of the other channels", place=place)
    if times is None:
        raise at.error("animates no node", place="animations")
    extras = animation.get("extras", {})
    steady = (len(times) - 1) / (times[-1] - times[0]) if times[-1] > times[0] else None
    fps = frame_rate(at, extras.get("fps", steady))
    if abs(times - times[0] - np.arange(len(times)) / fps).max() > 0.05 / fps:
        raise at.error(f"its keys are not one per frame at {fps:g} frames per second", place="times")

    parent = {child: i for i, node in enumerate(nodes) for child in node.get("children", ())}
    joints = content["skins"][0]["joints"] if content.get("skins") else sorted({node for node, _ in tracks})
    chains = {joint: _chain(at, parent, joint, len(nodes)) for joint in joints}
    joints = sorted(joints, key=lambda joint: len(chains[joint]))
    index = {joint: i for i, joint in enumerate(joints)}
    if any(parent.get(joint) not in index for joint in joints[1:]):
        raise at.error("the joints are not one tree", place="skin")

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
    rot[:, 0] = Y_UP.double().mT @ rot[:, 0]
    skeleton = Skeleton(
        names=tuple(str(nodes[joint].get("name", f"joint{joint}")) for joint in joints),
        parents=(-1, *(index[parent[joint]] for joint in joints[1:])),
        offsets=torch.stack([offset[0] for offset in offsets]).float()
        * torch.tensor([0.0] + [1.0] * (len(joints) - 1))[:, None],
        contact_names=tuple(extras.get("contact_names", ())),
        sole=float(extras.get("sole", 0.0)),
    )
    return Motion(skeleton, (root @ Y_UP.double()).float(), rot.float(), fps, name=str(animation.get("name", "")))


def _chain(at: Spot, parent: dict[int, int], node: int, count: int) -> list[int]:
    """The node and everything above it, to the top."""
    chain = [node]
    while chain[-1] in parent:
        chain.append(parent[chain[-1]])
        if len(chain) > count:
            raise at.error("the nodes form a circle", place=f"node {node}")
    return chain
