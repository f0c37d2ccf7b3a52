"""Animated GLB files (glTF 2.0, binary), and .gltf with its numbers inside or beside, as motions: ours, Blender's, and
all others.

Source: the glTF 2.0 specification (Khronos), 3.11 Animations, appendix C on interpolation, 4.4 GLB layout.
"""

from __future__ import annotations

import base64
import json
import struct
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.io import judging
from motionlab.io.judging import rerooted
from motionlab.io.reading import RATES, Location, checked_array, frame_rate, read_bytes, reading
from motionlab.motion import Motion
from motionlab.rest import reframed
from motionlab.skeleton import Skeleton

MAGIC, JSON_CHUNK, BIN_CHUNK = b"glTF", b"JSON", b"BIN\0"
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
GENERATOR = "motionlab"
_REST = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
#: Component types that are read, and what one is where they are normalised.
_NUMBERS = {5126: ("<f4", 0), 5120: ("<i1", 127), 5121: ("<u1", 255), 5122: ("<i2", 32767), 5123: ("<u2", 65535)}
_MOST_FRAMES = 1e6  # more are too many
_UNPACK = "unpack it (gltf-transform copy), or export it again uncompressed"


def load(
    path: str | Path,
    *,
    person: int = 0,
    animation: str | int | None = None,
    unit: str | float | None = None,
    up: str | None = None,
    axes: str | None = None,
    fps: float | None = None,
    translations: str = "strict",
) -> Motion:
    """Reads one person of an animation of a GLB or .gltf as a motion with the file's own skeleton.

    The joints are those of a skin, or of the animation where there is no skin. Their zero pose is the one in which the
    skin is bound, else the one in which the nodes rest; of our own files that of the motion. Channels with keys at
    other times than the rest are read at the times of all, or evenly where these are not steady.

    Args:
        person: which skin of several, in the file's order; that there are others is noted.
        animation: its name, or number from 0; None: the first, and others are noted.
        unit, up, axes: instead of metres and y up, which are doubted only where the figure speaks against them.
        fps: how often it is read; None: once per key. translations: see :func:`motionlab.io.judging.rerooted`.

    Raises:
        DataError: not such a file, or nobody with this number.
    """
    judging.check_given(unit, up, axes)
    with reading(path, "write it with motionlab.io.gltf.save, or export GLB with sampled animation") as at:
        content, blob = _chunks(at)
        found = _figure(at, content, blob, person, animation, fps)
        where = [f"node {joint} translation" for joint in found.joints]
        kept, skeleton, root, rot = rerooted(at, found.skeleton, found.place.numpy(), found.rot, translations, where)
        skeleton, rot = reframed(skeleton, rot, found.frames[kept])
        skeleton = replace(skeleton, contact_names=found.skeleton.contact_names, sole=found.skeleton.sole)
        motion = Motion(skeleton, root, rot, found.fps, name=found.name, notes=tuple(at.notes))
        ours = content.get("asset", {}).get("generator") == GENERATOR
        how = {"says_unit": 1.0, "says_up": "y", "trust": 9.0 if ours else 1.0, "table": judging.AXES | {"y": "x-zy"}}
        return judging.to_world(at, motion, unit=1.0 if ours and unit is None else unit, up=up, axes=axes, **how)


def _chunks(at: Location) -> tuple[dict, bytes]:
    """The JSON, and the numbers of all its buffers, one behind the other, as its views are made to count them."""
    data = read_bytes(at)
    text, chunk = (data, b"") if data.lstrip()[:1] == b"{" else _of_glb(at, data)
    content, blob, starts = json.loads(text.decode()), b"", []
    if packed := [name for name in content.get("extensionsRequired", ()) if name.endswith("meshopt_compression")]:
        raise at.error(f"its numbers are packed, by {packed[0]}", place="extensionsRequired", remedy=_UNPACK)
    for buffer in content.get("buffers", ()):
        starts.append(len(blob))
        part = _named(at, buffer["uri"]) if "uri" in buffer else chunk
        if len(part) < buffer["byteLength"]:
            raise at.error(f"{len(part)} bytes of numbers, {buffer['byteLength']} promised", place="buffers")
        blob += part
    for view in content.get("bufferViews", ()):
        view |= {"byteOffset": view.get("byteOffset", 0) + starts[view.get("buffer", 0)], "buffer": 0}
    return content, blob


def _of_glb(at: Location, data: bytes) -> tuple[bytes, bytes]:
    if len(data) < 20 or data[:4] != MAGIC:
        raise at.error("not a GLB file", place="header")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length != len(data):
        raise at.error(f"version {version}, {length} bytes promised, {len(data)} present", place="header")
    found, start = {}, 12
    while start + 8 <= len(data):
        size, kind = struct.unpack_from("<I4s", data, start)
        found.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    if start > len(data) or JSON_CHUNK not in found:
        raise at.error(f"its chunks {[*found]} end at byte {start} of {len(data)}", place="header")
    return found[JSON_CHUNK], found.get(BIN_CHUNK, b"")


def _named(at: Location, uri: str) -> bytes:
    """The numbers of a buffer: written out in its address, or those of a file beside or below."""
    head, _, numbers = uri.partition(",")
    if head.startswith("data:") and head.endswith(";base64"):
        return base64.b64decode(numbers)
    folder = at.path.parent.resolve()
    path = (folder / unquote(uri)).resolve()
    if not path.is_relative_to(folder) or not path.is_file():
        remedy = "put that file beside it or below, or export it as one binary file, .glb"
        raise at.error(f"its numbers lie in another file, {uri[:40]}", place="buffers", remedy=remedy)
    return read_bytes(replace(at, path=path))


def _array(at: Location, content: dict, blob: bytes, index: int, width: int, place: str) -> np.ndarray:
    """The numbers of an accessor, (N, width): floats, or integers that stand for shares of one."""
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    kind, largest = _NUMBERS.get(accessor["componentType"], ("", 0))
    normal = accessor.get("normalized", False) is True
    if accessor["type"] != TYPES[width] or not kind or normal != (largest > 0) or "sparse" in accessor:
        raise at.error(f"expected float {TYPES[width]}, got {accessor['type']}", place=place)
    size = np.dtype(kind).itemsize
    count, stride = accessor["count"], view.get("byteStride", size * width)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if min(start, count - 1, stride - size * width) < 0 or start + (count - 1) * stride + size * width > len(blob):
        what = f"{count} values of {stride} bytes from byte {start}"
        raise at.error(f"{what} do not lie in {len(blob)} bytes", place=place)
    rows = checked_array(at, np.ndarray((count, width), kind, blob, start, (stride, size)), f"T {width}", place)
    return np.maximum(rows / largest, -1) if normal else rows


@dataclass
class _Figure:
    """One person of a file: the nodes that are joints, and how each stands (T, J, 3) and is turned (T, J, 3, 3) against
    the one above, float64.

    sizes (J,): by which what is above scales a joint's translation. frames (J, 3, 3): how a joint is turned in the zero
    pose, against the world. tracks: (node, what) -> its sampler, keys and values.
    """

    joints: list[int]
    skeleton: Skeleton
    place: Tensor
    rot: Tensor
    sizes: Tensor
    frames: Tensor
    tracks: dict[tuple[int, str], tuple[dict, np.ndarray, np.ndarray]]
    times: np.ndarray
    fps: float
    name: str


def _names(nodes: list[dict], joints: list[int]) -> dict[int, str]:
    """A name for each joint: its node's, with its number where there is none or two share it."""
    names = {joint: str(nodes[joint].get("name") or "joint") for joint in joints}
    seen = Counter(names.values())
    return {k: x if seen[x] == 1 and nodes[k].get("name") else f"{x}{k}" for k, x in names.items()}


def _figure(
    at: Location, content: dict, blob: bytes, person: int, animation: str | int | None, fps: float | None
) -> _Figure:
    nodes, skins = content["nodes"], content.get("skins") or []
    if not 0 <= person < max(len(skins), 1):
        raise at.error(f"no person {person}: {len(skins)} skins", remedy="count them from 0")
    chosen, skin = _animation(at, content, animation), skins[person] if skins else {}
    parent: dict[int, int] = {}
    for i, node in enumerate(nodes):
        for child in node.get("children", ()):
            if parent.setdefault(child, i) != i:
                raise at.error("a node with two parents", place=f"node {child}")
    channels = [(c["target"]["node"], c["target"]["path"], chosen["samplers"][c["sampler"]])
                for c in chosen["channels"] if c["target"]["path"] in _REST and "node" in c["target"]]  # fmt: skip
    joints, chains = _tree(at, parent, skin.get("joints") or sorted({node for node, _, _ in channels}), nodes)
    names = _names(nodes, joints)
    used = {node for joint in joints for node in chains[joint]}
    tracks = {
        (node, what): (sampler, *_keys(at, content, blob, sampler, what, f"node {node} {what}"))
        for node, what, sampler in channels
        if node in used
    }
    if not tracks and chosen["channels"]:
        raise at.error("animates no joint", place="animations")
    extras = skin.get("extras", {}) | chosen.get("extras", {})
    times, rate = _grid(at, [keys for _, keys, _ in tracks.values()] or [np.zeros(1)], extras.get("fps"), fps)
    local = {node: _local(at, nodes[node], node, tracks, times) for node in used}
    uneven = [str(nodes[node].get("name", node)) for node, (_, _, size, even) in local.items() if not even]
    if uneven:
        at.notes.append(f"{', '.join(uneven[:5])}: scaled unevenly, or through time: the mean size is kept")
    index = {joint: i for i, joint in enumerate(joints)}

    # where the first of a chain stands and how it is turned, what scales it, and whose child it is
    def below(chain: list[int]) -> tuple[Tensor, Tensor, Tensor, int]:
        top = next((k for k, node in enumerate(chain[1:], 1) if node in index), len(chain))
        size = torch.ones(3, dtype=torch.float64)
        for node in chain[top:]:
            size = size * local[node][2]
        place, rot = torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
        for node in chain[:top][::-1]:
            place = place + (rot @ (size * local[node][0])[..., None])[..., 0]
            rot, above, size = rot @ local[node][1], size, size * local[node][2]
        return place, rot, above.mean(), index[chain[top]] if top < len(chain) else -1

    places, turns, sizes, parents = zip(*(below(chains[joint]) for joint in joints), strict=True)
    place, rot, sizes = torch.stack(places, dim=1), torch.stack(turns, dim=1), torch.stack(sizes)
    skeleton = Skeleton(
        names=tuple(names[joint] for joint in joints),
        parents=parents,
        offsets=place[0] * torch.tensor([0.0] + [1.0] * (len(joints) - 1))[:, None],
        contact_names=tuple(extras.get("contact_names", ())),
        sole=float(extras.get("sole", 0.0)),
    )
    if len(skins) > 1:
        at.notes.append(f"person {person} of {len(skins)} in the file")
    frames = torch.eye(3, dtype=torch.float64).repeat(len(joints), 1, 1)
    if content.get("asset", {}).get("generator") != GENERATOR:
        frames = _bound(at, content, blob, skin, joints, chains)
    name = str((skin if len(skins) > 1 else chosen).get("name", ""))
    return _Figure(joints, skeleton, place, rot, sizes, frames, tracks, times, rate, name)


def _animation(at: Location, content: dict, wanted: str | int | None) -> dict:
    """The animation of that name or number, counted from 0, of a skin without one its pose; others are noted."""
    every = content.get("animations") or []
    if not every and content.get("skins") and wanted is None:
        at.notes.append("holds no animation: read as the one pose in which its nodes rest")
        return {"samplers": [], "channels": []}
    if not every:
        raise at.error("holds no animation", place="animations")
    names = [str(one.get("name", k)) for k, one in enumerate(every)]
    word = "0" if wanted is None else str(wanted)
    number = names.index(word) if word in names else int(word) if word.isdecimal() else -1
    if not 0 <= number < len(every):
        raise at.error(f"no animation {word!r}: {', '.join(names)}", place="animations")
    if len(every) > 1 and wanted is None:
        others = f"animation {names[0]!r}, the first of {len(every)}: {', '.join(names)}"
        at.notes.append(f"{others}; choose with animation=, or --animation")
    return every[number]


def _tree(at: Location, parent: dict[int, int], joints: list[int], nodes: list[dict]) -> tuple[list[int], dict]:
    """The joints of the largest tree, what is above first, and the way from each to the top; others are noted."""
    chains = {joint: [joint] for joint in joints}
    for joint, chain in chains.items():
        while chain[-1] in parent:
            chain.append(parent[chain[-1]])
            if len(chain) > len(nodes):
                raise at.error("the nodes form a circle", place=f"node {joint}")
    joints = sorted(joints, key=lambda joint: len(chains[joint]))
    roots = {joint: [node for node in chains[joint] if node in chains][-1] for joint in joints}
    sizes = Counter(roots.values())
    root, size = max(sizes.items(), key=lambda item: item[1])
    if size < 0.6 * len(joints):
        raise at.error("the joints are not one tree", place="skin")
    lost = [str(nodes[joint].get("name", joint)) for joint in joints if roots[joint] != root]
    if lost:
        at.notes.append(f"joints beside the figure are left out: {', '.join(lost)}")
    return [joint for joint in joints if roots[joint] == root], chains


def _keys(
    at: Location, content: dict, blob: bytes, sampler: dict, what: str, place: str
) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) and values (N, W) of a channel, or (N, 3, W) of a cubic spline with its tangents."""
    keys = _array(at, content, blob, sampler["input"], 1, f"{place} times")[:, 0]
    values = _array(at, content, blob, sampler["output"], len(_REST[what]), place)
    if sampler.get("interpolation") == "CUBICSPLINE":
        values = values.reshape(-1, 3, values.shape[1])
    if len(values) != len(keys) or (np.diff(keys) < 0).any():
        raise at.error(f"{len(values)} values for {len(keys)} times that should ascend", place=place)
    return keys, values


def _grid(at: Location, keys: list[np.ndarray], says: object, fps: float | None) -> tuple[np.ndarray, float]:
    """The times at which all channels are read, and frames per second: where the keys are, if that is steady."""
    times = np.unique(np.concatenate(keys))
    times = times[np.concatenate(([True], np.diff(times) > 1e-4))]
    steady = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None
    if says is None and fps is None and steady is None:
        at.notes.append("one pose, at 30 frames per second as any")
    if steady is not None and abs(steady / max(round(steady), 1) - 1) < 2e-4:  # times in single precision
        steady = float(round(steady))
    rate = frame_rate(at, next((x for x in (fps, says, steady) if x is not None), 30.0))
    if abs(times - times[0] - np.arange(len(times)) / rate).max() <= 0.05 / rate:
        return times, rate
    if says is not None and fps is None:
        raise at.error(f"its keys are not one per frame at {rate:g} frames per second", place="times")
    if fps is None:
        ticks = {rate: (times - times[0]) * rate for rate in RATES}
        rate = next((rate for rate, at in ticks.items() if abs(at - at.round()).max() < 0.05), 30)
        at.notes.append(f"its keys are not one per frame: read {rate} times a second; say it with fps=, or --fps-in")
    count = (times[-1] - times[0]) * rate
    if not count < _MOST_FRAMES:
        raise at.error(f"{count:.3g} frames", place="times")
    return times[0] + np.arange(int(count + 0.05) + 1) / rate, float(rate)


def _local(
    at: Location, node: dict, number: int, tracks: dict, times: np.ndarray
) -> tuple[Tensor, Tensor, Tensor, bool]:
    """Where a node stands (T, 3), how it is turned (T, 3, 3), its mean size (3,), and whether that is even."""
    still = {what: node.get(what, rest) for what, rest in _REST.items()}
    if "matrix" in node:
        matrix = checked_array(at, node["matrix"], "16", f"node {number} matrix").reshape(4, 4).T
        size = np.linalg.norm(matrix[:3, :3], axis=0)
        if not size.min() > 0 or not np.linalg.det(matrix[:3, :3]) > 0:
            raise at.error("a matrix that flattens or mirrors", place=f"node {number} matrix")
        turn = torch.from_numpy(matrix[:3, :3] / size)
        quaternion = rotation.matrix_to_quaternion(rotation.nearest(turn))[[1, 2, 3, 0]]
        still = {"translation": matrix[:3, 3], "rotation": quaternion.numpy(), "scale": size}
    read = {}
    for what, rest in _REST.items():
        value = checked_array(at, still[what], str(len(rest)), f"node {number} {what}")
        track = tracks.get((number, what))
        read[what] = torch.from_numpy(_sampled(*track, times) if track else np.tile(value, (len(times), 1)))
    if ((read["rotation"].norm(dim=-1) - 1).abs() > 0.01).any():
        raise at.error("not a unit quaternion", place=f"node {number} rotation")
    size = read["scale"].mean(0)
    even = bool((read["scale"] - size.mean()).abs().max() <= 0.01 * size.mean().abs())
    if not size.min() > 0:
        raise at.error("a scale that flattens or mirrors", place=f"node {number} scale")
    size = torch.ones(3, dtype=torch.float64) if even and abs(size.mean() - 1) < 1e-3 else size.mean() if even else size
    return read["translation"], rotation.quaternion_to_matrix(read["rotation"][:, [3, 0, 1, 2]]), size, even


def _sampled(sampler: dict, keys: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A channel at other times than its keys (the glTF specification, 3.11 and appendix C)."""
    how = sampler.get("interpolation", "LINEAR")
    if how != "CUBICSPLINE" and keys.shape == times.shape and abs(keys - times).max() <= 1e-4:
        return values
    at = np.clip(np.searchsorted(keys, times + 1e-5, side="right") - 1, 0, max(len(keys) - 2, 0))
    after = np.minimum(at + 1, len(keys) - 1)
    step = np.maximum(keys[after] - keys[at], 1e-9)
    t = np.clip((times - keys[at]) / step, 0, 1)[:, None]
    if how == "STEP":
        return np.where(t < 1 - 1e-3, values[at], values[after])
    if how == "CUBICSPLINE":
        (a, b), step = (values[at], values[after]), step[:, None]
        found = (2 * t**3 - 3 * t**2 + 1) * a[:, 1] + (t**3 - 2 * t**2 + t) * step * a[:, 2]
        found = found + (3 * t**2 - 2 * t**3) * b[:, 1] + (t**3 - t**2) * step * b[:, 0]
        return found / np.linalg.norm(found, axis=1, keepdims=True) if found.shape[1] == 4 else found
    if values.shape[1] == 3:
        return values[at] + t * (values[after] - values[at])
    a, b = (rotation.quaternion_to_matrix(torch.from_numpy(values[k][:, [3, 0, 1, 2]])) for k in (at, after))
    return rotation.matrix_to_quaternion(rotation.slerp(a, b, torch.from_numpy(t[:, 0])))[:, [1, 2, 3, 0]].numpy()


def _bound(at: Location, content: dict, blob: bytes, skin: dict, joints: list[int], chains: dict) -> Tensor:
    """How the joints (J, 3, 3) are turned where the mesh is bound; without a mesh, where the nodes rest."""
    rest = {node: _local(at, content["nodes"][node], node, {}, np.zeros(1))[1][0] for j in joints for node in chains[j]}
    turned = torch.stack([torch.linalg.multi_dot([torch.eye(3).double()] * 2 + [rest[n] for n in chains[j][::-1]])
                          for j in joints])  # fmt: skip
    if "inverseBindMatrices" not in skin:
        return turned
    inverse = _array(at, content, blob, skin["inverseBindMatrices"], 16, "inverseBindMatrices").reshape(-1, 4, 4)
    bound = torch.from_numpy(inverse[:, :3, :3].copy())  # glTF stores columns first, so this is the transpose
    where = [skin["joints"].index(joint) for joint in joints]
    if len(bound) <= max(where) or not (torch.linalg.det(bound[where]) > 0).all():
        return turned
    return rotation.nearest(bound[where])
