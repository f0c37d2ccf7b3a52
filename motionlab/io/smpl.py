"""SMPL-format bodies (SMPL, SMPL+H, SMPL-X) from npz, and from the official pkl files without running them.

A pickle is a program. Here it is only ever read as data: every class that it names becomes a passive
record of the arguments and the state given to it, arrays are then rebuilt from those records by this
module, and a name outside the short list of what a body file holds is refused before anything is built.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from pathlib import Path

import numpy as np
import scipy.sparse
import torch

from motionlab.body import BodyModel
from motionlab.io.reading import LARGEST, Spot, numbers, read_bytes, read_npz, reading
from motionlab.skeleton import STANDARD, Skeleton

_KEYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
_REMEDY = "use an unchanged model file of SMPL, SMPL+H or SMPL-X (smpl.is.tue.mpg.de), or an npz of its arrays"
_POINTS = ("nose", "right_eye", "left_eye", "right_ear", "left_ear", "left_big_toe", "left_small_toe", "left_heel")
_POINTS += ("right_big_toe", "right_small_toe", "right_heel")
# Source: smplx (Pavlakos et al.), vertex_ids.py; keyed by the number of vertices.
_VERTICES = {
    6890: (332, 6260, 2800, 4071, 583, 3216, 3226, 3387, 6617, 6624, 6787),
    10475: (9120, 9929, 9448, 616, 6, 5770, 5780, 8846, 8463, 8474, 8635),
}


def load(path: str | Path, betas: int = 10) -> BodyModel:
    """Reads a body from a file in SMPL's format, on the 22 standard joints.

    Hands, jaw and eyes of larger models move rigidly with the wrist or head above them: their weights are
    folded into it. Pose correctives (``posedirs``) of the 21 moving joints are kept and applied by
    :func:`motionlab.body.lbs`; those of the hands are dropped.

    Args:
        betas: how many shape directions to keep, as far as the file has them.

    Source: Loper et al. 2015; Romero et al. 2017; Pavlakos et al. 2019.
    Raises:
        DataError: naming the file, the key and the remedy; nothing that a pickle asks for is executed.
    """
    with reading(path, _REMEDY) as at:
        data = read_bytes(at)
        keys = (*_KEYS, "posedirs")
        raw = read_npz(at, keys) if data[:2] == b"PK" else _unpickle(at, data, keys)
        for key in _KEYS:
            if key not in raw:
                raise at.error(f"no key {key!r}; found {', '.join(raw) or 'none of the keys of a body'}", place=key)
        return _body(at, raw, betas)


def _body(at: Spot, raw: dict[str, np.ndarray], betas: int) -> BodyModel:
    count = len(STANDARD)
    template = numbers(at, raw["v_template"], "V 3", "v_template")
    vertices = len(template)
    height = np.ptp(template[:, 1])
    if not 0.2 < height < 3:
        raise at.error(f"a body {height:.3g} m high (y is up)", place="v_template", remedy="convert it to metres, y up")
    parents = _parents(at, raw["kintree_table"])
    shape = numbers(at, raw["shapedirs"], f"{vertices} 3 B", "shapedirs")[..., :betas]
    weights = numbers(at, raw["weights"], f"{vertices} {len(parents)}", "weights")
    regressor = numbers(at, raw["J_regressor"], f"{len(parents)} {vertices}", "J_regressor")
    for key, rows in (("weights", weights), ("J_regressor", regressor)):
        off = np.abs(rows.sum(1) - 1)
        if not off.max() < 1e-3:
            raise at.error(f"row {off.argmax()} sums to {rows.sum(1)[off.argmax()]:.4g}, expected 1", place=key)
    if weights.min() < 0:
        raise at.error(f"a negative weight at vertex {weights.min(1).argmin()}", place="weights")
    faces = numbers(at, raw["f"], "F 3", "f")
    if faces.min() < 0 or faces.max() >= vertices or (faces != faces.round()).any():
        raise at.error(f"expected indices of {vertices} vertices, found {faces.min()} to {faces.max()}", place="f")
    folded = np.zeros((vertices, count))
    for joint in range(len(parents)):
        owner = joint
        while owner >= count:
            owner = parents[owner]
        folded[:, owner] += weights[:, joint]
    joints = regressor[:count] @ template
    directions = np.einsum("jv,vcb->jcb", regressor[:count], shape)
    offsets = joints - np.vstack((joints[:1], joints[list(STANDARD.parents[1:])]))
    posed = raw.get("posedirs")
    if posed is not None:
        posed = numbers(at, posed, f"{vertices} 3 {9 * (len(parents) - 1)}", "posedirs")[..., : 9 * (count - 1)]
        posed = torch.from_numpy(posed).float()
    notes = [f"{at.path.name}: {vertices} vertices, {len(parents)} joints, {shape.shape[-1]} betas"]
    if len(parents) > count:
        notes.append(f"weights of joints {count} to {len(parents) - 1} folded into the wrists and the head")
    if vertices not in _VERTICES:
        notes.append(f"no keypoint vertices are known for a mesh of {vertices} vertices")
    sole = float(joints[:, 1].min() - template[:, 1].min())
    return BodyModel(
        template=torch.from_numpy(template).float(),
        shape_directions=torch.from_numpy(shape).float(),
        joints=torch.from_numpy(joints).float(),
        joint_directions=torch.from_numpy(directions).float(),
        bind_rot=torch.eye(3).repeat(count, 1, 1),
        weights=torch.from_numpy(folded / folded.sum(1, keepdims=True)).float(),
        faces=torch.from_numpy(faces).long(),
        skeleton=Skeleton(
            STANDARD.names, STANDARD.parents, torch.from_numpy(offsets).float(), STANDARD.contact_names, sole
        ),
        keypoint_vertices=dict(zip(_POINTS, _VERTICES.get(vertices, ()), strict=False)),
        pose_directions=posed,
        notes=tuple(notes),
    )


def _parents(at: Spot, table: np.ndarray) -> list[int]:
    """The tree as parent indices; it must begin with the 22 joints of the body."""
    table = numbers(at, table, "2 J", "kintree_table")
    parents = [-1, *table[0, 1:].astype(int).tolist()]  # the root's own entry is -1 or 2**32 - 1
    for joint, parent in enumerate(parents[1:], start=1):
        if not 0 <= parent < joint:
            raise at.error(f"joint {joint} has parent {parent}", place="kintree_table")
    if tuple(parents[: len(STANDARD)]) != STANDARD.parents:
        raise at.error("does not begin with the tree of SMPL's 22 body joints", place="kintree_table")
    return parents


class _Record:
    """What a pickle said about one object: the name of its class, the arguments, the state. It does nothing."""

    name = ""

    def __new__(cls, *args, **_):
        record = object.__new__(cls)
        record.args, record.state = args, None
        return record

    def __init__(self, *args, **_):
        pass

    def __setstate__(self, state):
        self.state = state


_NUMPY = {
    **{
        f"{core}.multiarray.{name}": name
        for core in ("numpy.core", "numpy._core")
        for name in ("_reconstruct", "scalar")
    },
    **{f"{core}.numeric._frombuffer": "_frombuffer" for core in ("numpy.core", "numpy._core")},
    "numpy.ndarray": "ndarray",
    "numpy.dtype": "dtype",
}
_SPARSE = re.compile(r"scipy\.sparse\.(?:_?(?:csc|csr|coo)\.)?(csc|csr|coo)_(?:matrix|array)")
_CHUMPY = re.compile(r"chumpy(?:\.\w+)*")


class _Reader(pickle.Unpickler):
    def __init__(self, at: Spot, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")
        self.at = at

    def find_class(self, module: str, name: str):
        full = f"{module}.{name}"
        if full in ("copy_reg._reconstructor", "copyreg._reconstructor"):
            return _reconstructor
        if full in ("__builtin__.object", "builtins.object", "__builtin__.set", "builtins.set"):
            return _record(name)
        if full == "_codecs.encode":
            return _latin1
        if full in ("__builtin__.bytes", "builtins.bytes"):
            return _no_bytes
        if full in _NUMPY:
            return _record(_NUMPY[full])
        if sparse := _SPARSE.fullmatch(full):
            return _record(sparse[1])
        if _CHUMPY.fullmatch(module):
            return _record("chumpy")
        raise self.at.error(
            f"asks for {full}, which a body never needs: refused, nothing was executed",
            place="pickle",
            remedy="do not trust this file; get the model from its authors",
        )

    def persistent_load(self, pid):
        raise self.at.error("refers to objects outside the file", place="pickle")


def _record(name: str) -> type[_Record]:
    return type("Record", (_Record,), {"name": name})


def _reconstructor(cls, base, state):
    """Protocol 0 and 1's way to make an empty object; only of records."""
    if not (isinstance(cls, type) and issubclass(cls, _Record)):
        raise TypeError("not a class")
    return cls()


def _no_bytes():
    """How Python 3 writes empty bytes in protocol 2."""
    return b""


def _latin1(text, encoding="latin1"):
    """How Python 3 writes bytes in protocol 2."""
    if encoding not in ("latin1", "latin-1"):
        raise ValueError("not latin1")
    return str(text).encode("latin1")


def _unpickle(at: Spot, data: bytes, keys: tuple[str, ...]) -> dict[str, np.ndarray]:
    at.place = "pickle"
    for _ in pickletools.genops(data):
        pass  # a first reading: promised lengths are compared with what is there before memory is asked for
    tree = _Reader(at, data).load()
    if not isinstance(tree, dict):
        raise at.error(f"holds a {type(tree).__name__}, expected a dictionary of arrays", place="pickle")
    arrays = {}
    for key in keys:
        if tree.get(key) is not None:
            at.place = key
            arrays[key] = _array(at, tree[key])
    at.place = ""
    return arrays


def _array(at: Spot, value: object) -> np.ndarray:
    """An array from what the pickle said: numpy, a scipy sparse matrix, a chumpy object around one, or numbers."""
    if not isinstance(value, _Record):
        if isinstance(value, int | float | list | tuple):
            return np.asarray(value)
        raise at.error(f"holds a {type(value).__name__}, expected an array")
    state = value.state
    if value.name in ("_reconstruct", "ndarray"):
        shape, dtype, fortran, raw = state[-4:]
        return _from_bytes(at, raw, dtype, shape, "F" if fortran else "C")
    if value.name == "_frombuffer":
        raw, dtype, shape, order = value.args
        return _from_bytes(at, raw, dtype, shape, order)
    if value.name == "scalar":
        return _from_bytes(at, value.args[1], value.args[0], (), "C")
    if value.name in ("csc", "csr", "coo"):
        return _dense(at, value.name, state)
    if value.name == "chumpy" and isinstance(state, dict):
        if "x" in state:
            return _array(at, state["x"])
        if "a" in state and "idxs" in state:  # reordering.Select: entries of another array
            picked = _array(at, state["a"]).ravel()[_array(at, state["idxs"]).ravel()]
            shape = state.get("preferred_shape")
            return picked if shape is None else picked.reshape(_shape(at, shape))
    raise at.error(f"holds a {value.name} object without an array in it")


def _shape(at: Spot, shape: object) -> tuple[int, ...]:
    sizes = np.asarray(_array(at, shape) if isinstance(shape, _Record) else shape)
    if sizes.ndim > 1 or (sizes.size and (sizes.dtype.kind not in "iu" or sizes.min() < 0)):
        raise at.error(f"{shape!r} is not a shape")
    return tuple(int(n) for n in np.atleast_1d(sizes))


def _from_bytes(at: Spot, raw: object, dtype: object, shape: object, order: str) -> np.ndarray:
    code = dtype.args[0] if isinstance(dtype, _Record) and dtype.name == "dtype" and dtype.args else None
    if not isinstance(code, str) or not re.fullmatch(r"[biuf][1248]", code):
        raise at.error(f"an array of {code!r}, expected plain numbers")
    endian = dtype.state[1] if isinstance(dtype.state, tuple) and len(dtype.state) > 1 else "="
    kind = np.dtype(({"<": "<", ">": ">"}.get(endian, "=")) + code)
    raw = raw.encode("latin1") if isinstance(raw, str) else raw
    shape = _shape(at, shape)
    if not isinstance(raw, bytes | bytearray) or len(raw) != kind.itemsize * int(np.prod(shape, dtype=object)):
        raise at.error(f"shape {shape} of {kind} does not fit its bytes")
    return np.frombuffer(raw, kind).reshape(shape, order="F" if order == "F" else "C")


def _dense(at: Spot, form: str, state: object) -> np.ndarray:
    if not isinstance(state, dict):
        raise at.error("a sparse matrix without contents")
    shape = _shape(at, state.get("_shape", state.get("shape")))
    if len(shape) != 2 or 8 * shape[0] * shape[1] > LARGEST:
        raise at.error(f"a sparse matrix of shape {shape}")
    values = _array(at, state["data"])
    if form == "coo":
        where = [_array(at, state[k]) for k in ("row", "col")] if "row" in state else _coords(at, state)
        return scipy.sparse.coo_array((values, where), shape=shape).toarray()
    make = {"csc": scipy.sparse.csc_array, "csr": scipy.sparse.csr_array}[form]
    matrix = make((values, _array(at, state["indices"]), _array(at, state["indptr"])), shape=shape)
    matrix.check_format(full_check=True)
    return matrix.toarray()


def _coords(at: Spot, state: dict) -> list[np.ndarray]:
    return [_array(at, axis) for axis in state["coords"]]
