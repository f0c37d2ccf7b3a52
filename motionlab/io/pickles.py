"""Pickles, read as data and never run.

A pickle is a program. Here every class that it names becomes a passive record of the arguments and the state given to
it, arrays are then rebuilt from those records by this module, and a name outside a short list (numpy's arrays, torch's
tensors, plain containers, what a body of SMPL holds) is refused before anything is built.
"""

import io
import math
import pickle
import re
import zipfile
import zlib
from collections.abc import Iterable

import numpy as np
import scipy.sparse
import torch

from motionlab.io.reading import LARGEST, Location, read_npy


def read_pickle(at: Location, data: bytes) -> object:
    """Reads a pickle, or what joblib (packed or not), torch or numpy.save wrote, without executing anything.

    Containers of what :func:`array_of` takes; of a .npy its array, or of one of objects the first. What asks for
    anything else is refused.
    """
    if data[:6] == b"\x93NUMPY":
        return read_npy(at, data, first_object)
    at.place = "pickle"
    if data[:3] == b"BZh" or data[:6] == b"\xfd7zXZ\x00" or data[:2] == b"]\x00":
        raise at.error("packed by bz2 or lzma", remedy="pack it as zlib: joblib.dump(..., compress=3)")
    if data[:1] == b"x" or data[:2] == b"\x1f\x8b":  # zlib and gzip, in which joblib packs
        data = zlib.decompressobj(_EITHER).decompress(data, LARGEST)
    if data[:2] == b"PK" or data.startswith(_LEGACY):
        return _of_torch(at, data)
    reader = _Reader(at, data)
    tree = reader.load()
    if reader.storages:
        raise _refused(at, "what lies outside of it")
    return tree


def _of_torch(at: Location, data: bytes) -> object:
    """Reads what torch.save wrote: a pickle, and what its tensors store, as files beside it in a zip or, before torch
    1.6, behind it. Not by torch, which numpy can crash when it rebuilds a damaged array."""
    if data[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            sizes = {member.filename: member.file_size for member in archive.infolist()}
            folder = next(name for name in sizes if name.endswith("data.pkl")).removesuffix("data.pkl")
            if max(sizes.values()) > LARGEST:
                raise at.error(f"{max(sizes.values())} bytes are more than {LARGEST}")
            reader = _Reader(at, archive.read(f"{folder}data.pkl"))
            tree = reader.load()
            for key, storage in reader.storages.items():
                storage.state = archive.read(f"{folder}data/{key}")
            return tree
    reader = _Reader(at, data)
    *_, tree, keys = (reader.load() for _ in range(5))  # behind a number, a version, and sizes of the machine's types
    for key in keys:
        (kind,), count = reader.storages[key].args, int.from_bytes(reader.stream.read(8), "little")
        reader.storages[key].state = reader.stream.read(kind.itemsize * count)
    return tree


def first_object(at: Location, data: bytes) -> object:
    """Reads the first object of the pickle of an array of objects."""
    return read_pickle(at, data).state[-1][0]


def _refused(at: Location, asked: str) -> Exception:
    message = f"asks for {asked}, which is no array, tensor or container: refused, nothing was executed"
    remedy = "do not trust this file; save plain arrays with numpy.savez"
    return at.error(message, place="pickle", remedy=remedy)


_EITHER = 32 + zlib.MAX_WBITS  # for zlib: a header of its own or of gzip
_LEGACY = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # how files of torch before its version 1.6 begin


class _Record:
    """What a pickle said about one object: the name of its class, the arguments, the state. It does nothing."""

    name, state, args = "", None, ()

    def __new__(cls, *args, **_):
        record = object.__new__(cls)
        record.args = args
        return record


def _record(name: str) -> type[_Record]:
    return type("Record", (_Record,), {"name": name.rpartition(".")[2]})


_MOVED = {"__builtin__": "builtins", "copy_reg": "copyreg"}  # modules of Python 2, by their names now
#: What is built of a name: containers, bytes, and records of numpy's arrays, torch's tensors and joblib's arrays, which
#: lie in the file behind their records.
_BUILT = {
    "copyreg._reconstructor": lambda cls, *_: cls(),  # protocol 0 and 1's way to make an empty object
    "_codecs.encode": lambda text, *_: str(text).encode("latin1"),  # how Python 3 writes bytes in protocol 2
    "builtins.bytes": lambda: b"",  # and none
    # to be filled; what a defaultdict makes of what it lacks is left out
    **dict.fromkeys(("builtins.dict", "collections.OrderedDict", "collections.defaultdict"), lambda *_: {}),
    **{name: _record(name) for name in (
        "builtins.object", "builtins.set", "numpy._core.multiarray._reconstruct", "numpy._core.multiarray.scalar",
        "numpy._core.numeric._frombuffer", "numpy.ndarray", "numpy.dtype", "torch._utils._rebuild_tensor_v2",
        "torch._utils._rebuild_parameter", "torch.storage._load_from_bytes", "joblib.numpy_pickle.NumpyArrayWrapper",
    )},
    "torch.Size": tuple,
    "torch.CharStorage": torch.int8, "torch.ByteStorage": torch.uint8,
    **{f"torch.{name}Storage": getattr(torch, name.lower()) for name in (
        "Double", "Float", "Half", "BFloat16", "Long", "Int", "Short", "Bool",
    )},
}  # fmt: skip
#: More records, by what they are called here: sparse matrices, chumpy's arrays, and what may lie beside what is asked
#: for, and is no array.
_RECORDS = re.compile(
    r"scipy\.sparse\.(?:_?cs[cr]\.)?(cs[cr])_(?:matrix|array)|(chumpy)(?:\.\w+)+|(builtins\.complex|collections\.Counter"
    r"|scipy\.sparse\.(?:_?coo\.)?coo_(?:matrix|array)|torch\.(?:_utils\._rebuild_\w+|(?:storage\.)?\w+Storage|serialization\._get_layout|device|bool|[a-z]+\d+\w*))"
)


class _Reader(pickle._Unpickler):  # the one in Python: it asks for no more memory than there is file
    def __init__(self, at: Location, data: bytes) -> None:
        self.stream, self.storages = io.BytesIO(data), {}
        super().__init__(self.stream, encoding="latin1")
        self.at, self.dispatch = at, pickle._Unpickler.dispatch | {pickle.BUILD[0]: _Reader.load_build}

    def find_class(self, module: str, name: str):
        full = f"{_MOVED.get(module, module.replace('numpy.core.', 'numpy._core.'))}.{name}"
        if full in _BUILT:
            return _BUILT[full]
        if known := _RECORDS.fullmatch(full):
            return _record(known[known.lastindex])
        raise _refused(self.at, f"{module}.{name}")

    def persistent_load(self, what: tuple) -> _Record:
        _, kind, key, *_ = what
        return self.storages.setdefault(key, _record("storage")(kind))

    def load_build(self) -> None:
        state, record = self.stack.pop(), self.stack[-1]
        if isinstance(record, dict):  # what a state_dict says beside its tensors
            return
        if not isinstance(record, _Record):  # a function of this module would take what it is told
            raise self.at.error("sets the state of what is no array", place="pickle")
        record.state = state
        if record.name == "NumpyArrayWrapper":
            if state.get("numpy_array_alignment_bytes"):
                self.stream.read(self.stream.read(1)[0])
            shape, kind = _shape(self.at, state["shape"]), _kind(self.at, state["dtype"])
            raw = self.stream.read(kind.itemsize * math.prod(shape))
            self.stack[-1] = _from_bytes(self.at, raw, state["dtype"], shape, state["order"])


def arrays_of(at: Location, tree: object, keys: Iterable[str], place: str) -> dict[str, np.ndarray]:
    """Reads those arrays of a dictionary that are there; ``at.place`` goes along."""
    if not isinstance(tree, dict):
        raise at.error(f"holds a {type(tree).__name__}, expected a dictionary of arrays", place=place)
    arrays = {}
    for key in keys:
        if tree.get(key) is not None:
            at.place = key
            arrays[key] = array_of(at, tree[key])
    at.place = ""
    return arrays


def array_of(at: Location, value: object) -> np.ndarray:
    """Makes an array of what a pickle said: of numpy, torch, scipy (sparse), chumpy around one of these, or numbers."""
    if isinstance(value, list | tuple):
        return np.asarray([array_of(at, each) if isinstance(each, _Record) else each for each in value])
    if isinstance(value, int | float | np.ndarray):
        return np.asarray(value)
    if not isinstance(value, _Record):
        raise at.error(f"holds a {type(value).__name__}, expected an array")
    state = value.state
    if value.name in ("_reconstruct", "ndarray"):
        shape, dtype, fortran, raw = state[-4:]
        return _from_bytes(at, raw, dtype, shape, "F" if fortran else "C")
    if value.name == "_frombuffer":
        return _from_bytes(at, *value.args)
    if value.name == "scalar":
        return _from_bytes(at, value.args[1], value.args[0], (), "C")
    if value.name in ("csc", "csr"):
        shape = _shape(at, state.get("_shape", state.get("shape")))
        if 8 * math.prod(shape) > LARGEST:
            raise at.error(f"a sparse matrix of shape {shape}")
        parts = [array_of(at, state[key]) for key in ("data", "indices", "indptr")]
        matrix = getattr(scipy.sparse, f"{value.name}_array")(tuple(parts), shape=shape)
        matrix.check_format(full_check=True)
        return matrix.toarray()
    if value.name == "chumpy" and isinstance(state, dict):
        if "x" in state:
            return array_of(at, state["x"])
        if "a" in state and "idxs" in state:  # reordering.Select: entries of another array
            picked = array_of(at, state["a"]).ravel()[array_of(at, state["idxs"]).ravel()]
            shape = state.get("preferred_shape")
            return picked if shape is None else picked.reshape(_shape(at, shape))
    if value.name in ("_rebuild_parameter", "_rebuild_parameter_with_state"):
        return array_of(at, value.args[0])
    if value.name == "_rebuild_tensor_v2":
        stored, offset, size, stride = value.args[:4]
        stored = _of_torch(at, *stored.args) if stored.name == "_load_from_bytes" else stored
        whole = torch.frombuffer(bytearray(stored.state), dtype=stored.args[0]) if stored.state else torch.empty(0)
        if math.prod(size) > max(whole.numel(), 2**20) or any(value.args[6:]):  # a view that is expanded or negative
            raise at.error(f"a tensor of shape {tuple(size)} that holds {whole.numel()} numbers, or a view of another")
        whole = whole.as_strided(size, stride, offset)
        return (whole.float() if whole.dtype == torch.bfloat16 else whole).numpy().copy()
    raise at.error(f"holds a {value.name} object without an array in it")


def _shape(at: Location, shape: object) -> tuple[int, ...]:
    sizes = np.atleast_1d(array_of(at, shape))
    if sizes.ndim > 1 or (sizes < 0).any():
        raise at.error(f"{shape!r} is not a shape")
    return tuple(sizes.astype(int).tolist())


def _kind(at: Location, dtype: object) -> np.dtype:
    code = dtype.args[0] if isinstance(dtype, _Record) and dtype.name == "dtype" and dtype.args else None
    if not isinstance(code, str) or not re.fullmatch(r"[biuf][1248]", code):
        raise at.error(f"an array of {code!r}, expected plain numbers")
    endian = dtype.state[1] if isinstance(dtype.state, tuple) and len(dtype.state) > 1 else "="
    return np.dtype((endian if endian in ("<", ">") else "=") + code)


def _from_bytes(at: Location, raw: object, dtype: object, shape: object, order: str) -> np.ndarray:
    raw = raw.encode("latin1") if isinstance(raw, str) else raw
    return np.frombuffer(raw, _kind(at, dtype)).reshape(_shape(at, shape), order="F" if order == "F" else "C")
