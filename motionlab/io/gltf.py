"""Animated GLB files (glTF 2.0, binary), and .gltf with its numbers inside or beside: of all kinds read as motions;
written with a skinned body, as Blender and three.js open them.

glTF is y up: world (x, y, z) is written as (x, z, -y), which Blender turns back into the same (x, y, z).
Blender, three.js and glTF bind a vertex with world_j inverse_bind_j; ours are [R_j | p_j] and
[bind_rot_j^T | -bind_rot_j^T joint_j], so that a viewer computes exactly :func:`motionlab.body.lbs`.

Source: the glTF 2.0 specification (Khronos), 3.7.3 Skins, 3.11 Animations, 4.4 GLB layout, appendix C on interpolation.
"""

import base64
import json
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.body import BodyModel, tailored, vertex_normals
from motionlab.errors import ShapeError
from motionlab.files import write_whole
from motionlab.io import judging
from motionlab.io.judging import Axes, Fps, Unit, rerooted
from motionlab.io.reading import RATES, Location, checked_array, frame_rate, read_bytes, reading
from motionlab.motion import Motion, single
from motionlab.rest import reframed
from motionlab.skeleton import Skeleton

MAGIC, JSON_CHUNK, BIN_CHUNK = b"glTF", b"JSON", b"BIN\0"
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
GENERATOR = "motionlab"
_REST = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
#: Component types that are read, and what one is where they are normalised.
_NUMBERS = {5126: ("<f4", 0), 5120: ("<i1", 127), 5121: ("<u1", 255), 5122: ("<i2", 32767), 5123: ("<u2", 65535)}
_COMPONENTS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_VERTICES, _INDICES = 34962, 34963  # targets of a buffer view
_COLOUR = (0.62, 0.66, 0.72)  # linear red, green, blue of a body
#: glTF from world: a quarter turn about x.
_Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def load(
    path: str | Path, *, person: int = 0, animation: str | int | None = None, unit: Unit = None, up: Axes = None,
    axes: Axes = None, fps: Fps = None, translations: str = "strict",
) -> Motion:  # fmt: skip
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
        remedy = "unpack it (gltf-transform copy), or export it again uncompressed"
        raise at.error(f"packed, by {packed[0]}", place="extensionsRequired", remedy=remedy)
    for buffer in content.get("buffers", ()):
        starts.append(len(blob))
        blob += _named(at, buffer["uri"]) if "uri" in buffer else chunk
        if len(blob) < starts[-1] + buffer["byteLength"]:
            raise at.error(f"fewer bytes of numbers than the {buffer['byteLength']} promised", place="buffers")
    for view in content.get("bufferViews", ()):
        view |= {"byteOffset": view.get("byteOffset", 0) + starts[view.get("buffer", 0)], "buffer": 0}
    return content, blob


def _of_glb(at: Location, data: bytes) -> tuple[bytes, bytes]:
    version, length = struct.unpack_from("<II", data.ljust(12, b"\0"), 4)
    if data[:4] != MAGIC or version != 2 or length != len(data):
        what = f"version {version}, {length} bytes promised, {len(data)} present"
        raise at.error("not a GLB file" if data[:4] != MAGIC else what, place="header")
    found, start = {}, 12
    while start < length:
        size, kind = struct.unpack_from("<I4s", data, start)
        found.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    return found[JSON_CHUNK], found.get(BIN_CHUNK, b"")


def _named(at: Location, uri: str) -> bytes:
    """The numbers of a buffer: written out in its address, or those of a file beside or below."""
    head, _, numbers = uri.partition(",")
    if head.startswith("data:") and head.endswith(";base64"):
        return base64.b64decode(numbers)
    folder = at.path.parent.resolve()
    path = (folder / unquote(uri)).resolve()
    if not path.is_relative_to(folder) or not path.is_file():
        remedy = "put it beside this one or below, or export one .glb"
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
    if stride < size * width:
        raise at.error(f"values lie {stride} bytes apart, expected {size * width} or more", place=place)
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


def _figure(at: Location, content: dict, blob: bytes, person: int, animation: str | int | None, fps: Fps) -> _Figure:
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
    names = [str(nodes[joint].get("name") or f"joint{joint}") for joint in joints]
    names = [name if names.count(name) == 1 else f"{name}{k}" for k, name in zip(joints, names, strict=True)]
    used = {node for joint in joints for node in chains[joint]}
    moved = [channel for channel in channels if channel[0] in used]
    tracks = {(k, what): (s, *_keys(at, content, blob, s, what, f"node {k} {what}")) for k, what, s in moved}
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
    contact_names, sole = tuple(extras.get("contact_names", ())), float(extras.get("sole", 0.0))
    skeleton = Skeleton(tuple(names), parents, place[0], contact_names, sole)
    if len(skins) > 1:
        at.notes.append(f"person {person} of {len(skins)} in the file")
    ours, frames = content.get("asset", {}).get("generator") == GENERATOR, torch.eye(3, dtype=torch.float64)
    frames = frames.repeat(len(joints), 1, 1) if ours else _bound(at, content, blob, skin, joints, chains)
    name = str((skin if len(skins) > 1 else chosen).get("name", ""))
    return _Figure(joints, skeleton, place, rot, sizes, frames, tracks, times, rate, name)


def _animation(at: Location, content: dict, wanted: str | int | None) -> dict:
    """The animation of that name or number, counted from 0, of a skin without one its pose; others are noted."""
    every = content.get("animations") or []
    if not every and content.get("skins") and wanted is None:
        at.notes.append("holds no animation: read as the one pose in which its nodes rest")
        return {"samplers": [], "channels": []}
    names = [str(one.get("name", k)) for k, one in enumerate(every)]
    known = {str(k): k for k in range(len(every))} | {name: names.index(name) for name in names}
    if (number := known.get(str(wanted or 0))) is None:
        raise at.error(f"no animation {wanted!r}: it holds {', '.join(names) or 'none'}", place="animations")
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
    (root, size), *_ = Counter(roots.values()).most_common(1)
    if size < 0.6 * len(joints):
        raise at.error("the joints are not one tree", place="skin")
    lost = [str(nodes[joint].get("name", joint)) for joint in joints if roots[joint] != root]
    if lost:
        at.notes.append(f"joints beside the figure are left out: {', '.join(lost)}")
    return [joint for joint in joints if roots[joint] == root], chains


def _keys(at: Location, content: dict, blob: bytes, sampler: dict, what: str, place: str) -> tuple:
    """Times (N,) and values (N, W) of a channel, or (N, 3, W) of a cubic spline with its tangents."""
    keys = _array(at, content, blob, sampler["input"], 1, f"{place} times")[:, 0]
    values = _array(at, content, blob, sampler["output"], len(_REST[what]), place)
    if sampler.get("interpolation") == "CUBICSPLINE":
        values = values.reshape(-1, 3, values.shape[1])
    if len(values) != len(keys) or (np.diff(keys) < 0).any():
        raise at.error(f"{len(values)} values for {len(keys)} times that should ascend", place=place)
    return keys, values


def _grid(at: Location, keys: list[np.ndarray], says: object, fps: Fps) -> tuple[np.ndarray, float]:
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
    if fps is None and says is None:
        ticks = {rate: (times - times[0]) * rate for rate in RATES}
        rate = next((rate for rate, at in ticks.items() if abs(at - at.round()).max() < 0.05), 30)
        at.notes.append(f"its keys are not one per frame: read {rate} times a second; say it with fps=, or --fps-in")
    count = (times[-1] - times[0]) * rate
    if not count < 1e6:
        raise at.error(f"{count:.3g} frames", place="times")
    return times[0] + np.arange(int(count + 0.05) + 1) / rate, float(rate)


def _local(at: Location, node: dict, number: int, tracks: dict, times: np.ndarray) -> tuple:
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
    ways = ([rest[node] for node in chains[j][::-1]] for j in joints)
    turned = torch.stack([torch.linalg.multi_dot([torch.eye(3).double()] * 2 + way) for way in ways])
    if "inverseBindMatrices" in skin:
        inverse = _array(at, content, blob, skin["inverseBindMatrices"], 16, "inverseBindMatrices").reshape(-1, 4, 4)
        bound = torch.from_numpy(inverse[:, :3, :3].copy())  # glTF stores columns first, so this is the transpose
        where = [skin["joints"].index(joint) for joint in joints]
        if len(bound) > max(where) and (torch.linalg.det(bound[where]) > 0).all():
            return rotation.nearest(bound[where])
    return turned


def save(
    path: str | Path, motions: Motion | Sequence[Motion], body: BodyModel | None = None, *, names: Sequence[str] = ()
) -> None:
    """Writes one person or several as an animated GLB: each an armature of joints, one key per frame, and the body as
    a skinned mesh. One animation moves all of them, since most viewers play only the first.

    The nodes rest at the first frame. The file appears whole or not at all. Contacts are not kept.

    Args:
        motions: one clip, or one per person at one frame rate; no batch axes. All begin at time 0.
        body: its mesh and weights, tailored to the bones of each; None writes the armatures alone, bound in the rest
            pose.
        names: of the people; by default those of the motions.

    Raises:
        ShapeError: nobody, a motion has batch axes, frame rates differ, or the body has other joints. ValueError: names
            are not one per person.
        DataError: a motion holds NaN or infinity (names the frame), or the file cannot be written.
    """
    people = [motions] if isinstance(motions, Motion) else list(motions)
    for motion in people:
        single(motion, path)
        if body is not None and body.skeleton.names != motion.skeleton.names:
            raise ShapeError(f"the body's joints are {body.skeleton.names}, the motion's {motion.skeleton.names}")
    if len({motion.fps for motion in people}) != 1:
        raise ShapeError(f"expected one frame rate, got {[motion.fps for motion in people]}: use motion.resample")
    names = list(names) or [motion.name or "motion" for motion in people]
    file = _Buffer()
    for motion, name in zip(people, names, strict=True):
        skeleton, first = motion.skeleton, _animate(file, motion, name)
        if body is None:
            _bind(file, first, name, skeleton, skeleton.rest_positions(), torch.eye(3).expand(len(skeleton), 3, 3))
        else:
            worn = tailored(body, skeleton)
            _bind(file, first, name, skeleton, worn.joints, body.bind_rot)
            _mesh(file, name, worn)
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
    resting = zip(skeleton.names, places, quaternion[0].tolist(), strict=True)
    nodes += [{"name": joint, "translation": place, "rotation": turn} for joint, place, turn in resting]
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


def _mesh(file: _Buffer, name: str, body: BodyModel) -> None:
    """Add the mesh of the last skin, in its bind pose, beside the joints.

    A vertex keeps its four largest weights, scaled to sum to 1: every viewer reads so many. anny's hang on up to six
    joints, whose weakest two have up to 3 % (millimetres at a few vertices).
    """
    template, faces, nodes = body.template.detach().cpu().double(), body.faces.cpu(), file.content["nodes"]
    attributes = {"POSITION": file.add(template, "f4", _VERTICES, bounds=True)}
    attributes["NORMAL"] = file.add(vertex_normals(template, faces), "f4", _VERTICES)
    joints = body.weights.shape[1]
    most = body.weights.detach().cpu().double().topk(min(4, joints), dim=1)
    share, which = (torch.nn.functional.pad(x, (0, 4 - x.shape[1])) for x in most)
    which = torch.where(share > 0, which, 0)
    share = (share / share.sum(1, keepdim=True)).numpy()
    attributes["JOINTS_0"] = file.add(which, "u1" if joints <= 256 else "u2", _VERTICES)
    attributes["WEIGHTS_0"] = file.add(share, "f4", _VERTICES)
    indices = file.add(faces.reshape(-1), "u2" if len(template) < 65535 else "u4", _INDICES)
    matt = {"baseColorFactor": [*_COLOUR, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7}
    file.content["materials"] = [{"name": "body", "pbrMetallicRoughness": matt}]
    meshes = file.content.setdefault("meshes", [])
    nodes[-1]["children"].append(len(nodes))
    nodes.append({"name": f"{name} body", "mesh": len(meshes), "skin": len(file.content["skins"]) - 1})
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    meshes.append({"name": f"{name} body", "primitives": [primitive]})
