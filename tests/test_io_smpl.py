import io
import pickle
import struct
import sys
import types

import numpy as np
import pytest
import scipy.sparse
import torch
from seeds import smpl_arrays as arrays

from motionlab import rotation
from motionlab.body import lbs
from motionlab.errors import DataError
from motionlab.io import smpl
from motionlab.skeleton import STANDARD, fk

VERTICES = 60


def write_npz(path, data):
    np.savez(path, **data)
    return path


def write_pkl(path, data, **options):
    path.write_bytes(pickled(data, **options))
    return path


class Python2(pickle._Pickler):
    """Writes bytes as Python 2 wrote its str: what the official files hold."""

    dispatch = dict(pickle._Pickler.dispatch)  # noqa: RUF012, as in its base

    def save_bytes(self, value):
        self.write(b"T" + struct.pack("<i", len(value)) + value)
        self.memoize(value)

    dispatch[bytes] = save_bytes


def pickled(data, protocol=2, python2=False):
    if not python2:
        return pickle.dumps(data, protocol)
    stream = io.BytesIO()
    Python2(stream, 2).dump(data)
    return stream.getvalue().replace(b"numpy._core", b"numpy.core")


@pytest.fixture
def chumpy():
    """A stand-in for the chumpy package, there only while a file is written."""
    package, ch, reordering = (types.ModuleType(n) for n in ("chumpy", "chumpy.ch", "chumpy.reordering"))
    ch.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    reordering.Select = type("Select", (), {"__module__": "chumpy.reordering"})
    modules = {"chumpy": package, "chumpy.ch": ch, "chumpy.reordering": reordering}
    sys.modules.update(modules)
    yield ch.Ch, reordering.Select
    for name in modules:
        sys.modules.pop(name, None)


def same(body, other):
    for name in ("template", "joints", "weights", "faces", "pose_directions"):
        assert torch.equal(getattr(body, name), getattr(other, name)), name


def test_npz_and_every_kind_of_pickle_give_one_body(tmp_path):
    data = arrays()
    body = smpl.load(write_npz(tmp_path / "a.npz", data))
    assert body.template.shape == (VERTICES, 3) and body.weights.shape == (VERTICES, 22)
    for protocol in range(6):
        same(body, smpl.load(write_pkl(tmp_path / "a.pkl", data, protocol=protocol)))
    same(body, smpl.load(write_pkl(tmp_path / "b.pkl", data, python2=True)))
    for form in ("csc", "csr"):
        for kind in ("matrix", "array"):
            sparse = getattr(scipy.sparse, f"{form}_{kind}")(data["J_regressor"])
            for protocol in (0, 2, 5):
                path = write_pkl(tmp_path / "c.pkl", {**data, "J_regressor": sparse}, protocol=protocol)
                same(body, smpl.load(path))
    turned = {**data, "v_template": np.asfortranarray(data["v_template"].astype(">f8"))}
    for path in (write_pkl(tmp_path / "d.pkl", turned), write_npz(tmp_path / "d.npz", turned)):
        same(body, smpl.load(path))


def test_chumpy_objects_are_read_without_chumpy(tmp_path, chumpy):
    ch, select = chumpy
    data = arrays()
    body = smpl.load(write_npz(tmp_path / "a.npz", data))
    wrapped, chosen, mixed = ch(), select(), np.arange(data["weights"].size)[::-1]
    wrapped.__dict__ |= {"x": data["shapedirs"], "_dirty_vars": {"x"}}
    inner = ch()
    inner.x = data["weights"].ravel()[mixed]
    chosen.__dict__ |= {"a": inner, "idxs": mixed, "preferred_shape": data["weights"].shape}
    path = write_pkl(tmp_path / "a.pkl", {**data, "shapedirs": wrapped, "weights": chosen, "bs_type": "lrotmin"})
    for name in ("chumpy.ch", "chumpy.reordering", "chumpy"):
        sys.modules.pop(name)
    with pytest.raises(ModuleNotFoundError):
        pickle.loads(path.read_bytes())
    same(body, smpl.load(path))
    assert "chumpy" not in sys.modules


def test_lbs_of_a_loaded_body_follows_the_papers_formula(tmp_path, generator):
    """All 24 joints by hand, hands at rest, against the 22-joint body: Loper et al., Eq. 2-9, homogeneous matrices."""
    data = arrays()
    betas = torch.randn(2, generator=generator).double()
    body = smpl.load(write_npz(tmp_path / "a.npz", data), betas.tolist()).to(torch.float64)
    rot = rotation.random((24,), generator, dtype=torch.float64)
    rot[22:] = torch.eye(3)
    root = torch.randn(3, generator=generator).double()
    shaped = data["v_template"] + data["shapedirs"] @ betas.numpy()
    joints = data["J_regressor"] @ shaped
    posed = shaped + data["posedirs"] @ (rot[1:].numpy() - np.eye(3)).ravel()
    world = []
    for j, parent in enumerate((*STANDARD.parents, 20, 21)):
        local = np.eye(4)
        local[:3, :3] = rot[j]
        local[:3, 3] = joints[j] - joints[parent] if j else root
        world.append(world[parent] @ local if j else local)
    expected = np.zeros((VERTICES, 3))
    for j, pose in enumerate(world):
        moved = (posed - joints[j]) @ pose[:3, :3].T + pose[:3, 3]
        expected += data["weights"][:, j, None] * moved
    found = lbs(body, body.skeleton, root[None], rot[None, :22])[0]
    torch.testing.assert_close(found, torch.from_numpy(expected), rtol=0, atol=1e-5)  # stored in float32
    bare = type(body)(**{**vars(body), "pose_directions": None})
    without = lbs(bare, bare.skeleton, root[None], rot[None, :22])[0]
    assert (without - found).abs().max() > 1e-3  # the correctives do something


@pytest.mark.parametrize("joints", [52, 55])
def test_larger_models_fold_hands_and_face_into_what_carries_them(tmp_path, joints):
    data = arrays(joints)
    if joints == 55:
        data["kintree_table"][0, 22:25] = 15  # SMPL-X: jaw and eyes hang on the head
    body = smpl.load(write_npz(tmp_path / "a.npz", data))
    parents = data["kintree_table"][0].astype(int)
    expected = data["weights"][:, :22].copy()
    for joint in range(22, joints):
        expected[:, parents[joint]] += data["weights"][:, joint]  # in this file every extra joint hangs on the body
    assert set(parents[22:]) <= {15, 20, 21}
    torch.testing.assert_close(body.weights.double(), torch.from_numpy(expected), rtol=0, atol=1e-6)
    assert body.pose_directions.shape == (VERTICES, 3, 189)


def test_skeleton_and_betas(tmp_path):
    data = arrays()
    path = write_npz(tmp_path / "a.npz", data)
    body = smpl.load(path)
    expected = data["J_regressor"][:22] @ data["v_template"]
    standing = fk(body.skeleton, body.joints[0], torch.eye(3).repeat(22, 1, 1))[0]
    torch.testing.assert_close(standing.double(), torch.from_numpy(expected), rtol=0, atol=1e-6)
    with pytest.raises(DataError, match="2 shape directions"):
        smpl.load(path, [0.0, 1.0, 2.0])
    without = {k: v for k, v in data.items() if k != "posedirs"}
    assert smpl.load(write_npz(tmp_path / "b.npz", without)).pose_directions is None
    assert body.keypoint_vertices == {}


CALLS = {
    "os.system": b"cposix\nsystem\n(S'touch {}'\ntR.",
    "eval": b'cbuiltins\neval\n(S\'open("{}", "w")\'\ntR.',
    "open": b"cbuiltins\nopen\n(S'{}'\nS'w'\ntR.",
    "inst opcode": b"(S'{}'\nS'w'\nibuiltins\nopen\n.",
    "getattr": b"cbuiltins\ngetattr\n(cbuiltins\nobject\nS'__subclasses__'\ntR.",
    "partial": b"cfunctools\npartial\n(cposix\nsystem\nS'touch {}'\ntR.",
    "attrgetter": b"coperator\nattrgetter\n(S'system'\ntR.",
    "copyreg extension": b"ccopyreg\nadd_extension\n(S'os'\nS'system'\nI1\ntR.",
    "numpy load": b"cnumpy\nload\n(S'{}'\ntR.",
    "numpy exec": b'cnumpy.testing._private.utils\nrunstring\n(S\'open("{}","w")\'\n}tR.',
    "numpy memmap": b"cnumpy\nmemmap\n(S'{}'\nS'u1'\nS'w+'\nI0\nI9\ntR.",
    "torch": b"ctorch\nload\n(S'{}'\ntR.",
    "dotted": b"\x80\x04\x8c\x05numpy\x8c\x0cf2py.os.open\x93(\x8c\x01{}tR.",
    "dotted from chumpy": b"\x80\x04\x8c\x06os.sys\x8c\x06chumpy\x93.",
    "scipy": b"cscipy.sparse\nload_npz\n(S'{}'\ntR.",
    "persistent id": b"Pos.system\n.",
    "extension code": b"\x82\x01.",
    "reconstruct a foreign class": b"ccopy_reg\n_reconstructor\n(cposix\nsystem\nc__builtin__\nobject\nNtR.",
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("inside", [False, True])
def test_hostile_pickles_are_refused_before_anything_runs(tmp_path, name, inside):
    canary = tmp_path / "canary"
    call = CALLS[name].replace(b"{}", str(canary).encode())
    if inside:  # hidden in a dictionary that is otherwise a good body
        good = pickled(arrays(), protocol=0)
        call = good[:-1] + b"S'extra'\n" + call[call.startswith(b"\x80") * 2 : -1] + b"s."
    path = tmp_path / "model.pkl"
    path.write_bytes(call)
    with pytest.raises(DataError) as caught:
        smpl.load(path)
    assert not canary.exists()
    assert "model.pkl" in str(caught.value) and "remedy" in str(caught.value)


def test_a_hostile_pickle_does_run_where_nobody_guards_it(tmp_path):
    """The negative control: the canary sings under plain pickle, so its silence above means something."""
    canary = tmp_path / "canary"
    pickle.loads(CALLS["os.system"].replace(b"{}", str(canary).encode()))
    assert canary.exists()


def put(key, value):
    return lambda data: data.update({key: value(data[key])})


def first(value):
    return lambda array: np.concatenate(([value], array.ravel()[1:])).reshape(array.shape)


BROKEN = {
    "missing weights": (lambda d: d.pop("weights"), "weights"),
    "missing template": (lambda d: d.pop("v_template"), "v_template"),
    "missing tree": (lambda d: d.pop("kintree_table"), "kintree_table"),
    "NaN": (put("v_template", first(np.nan)), "v_template"),
    "flat template": (put("v_template", np.ravel), "v_template"),
    "empty template": (put("v_template", lambda x: x[:0]), "v_template"),
    "one vertex short": (put("weights", lambda x: x[:-1]), "weights"),
    "one joint short": (put("J_regressor", lambda x: x[:-1]), "J_regressor"),
    "rows do not sum to 1": (put("weights", lambda x: 0.9 * x), "weights"),
    "regressor sums to 2": (put("J_regressor", lambda x: 2 * x), "J_regressor"),
    "negative weight": (put("weights", lambda x: x + np.eye(1, 24) - np.eye(1, 24, 1)), "weights"),
    "faces out of range": (put("f", first(VERTICES)), "f"),
    "half a face": (put("f", lambda x: x + 0.5), "f"),
    "quads": (put("f", lambda x: x.reshape(-1, 4)), "f"),
    "text": (put("f", lambda x: x.astype(str)), "f"),
    "cyclic tree": (put("kintree_table", lambda x: np.where(x == 0, 5, x)), "kintree_table"),
    "another tree": (put("kintree_table", lambda x: np.vstack((np.maximum(x[1], 1) - 1, x[1]))), "kintree_table"),
    "centimetres": (put("v_template", lambda x: 100 * x), "v_template"),
    "correctives of another model": (put("posedirs", lambda x: x[..., :-9]), "posedirs"),
}


@pytest.mark.parametrize("name", BROKEN)
@pytest.mark.parametrize("write", [write_npz, write_pkl])
def test_wrong_contents(tmp_path, name, write):
    (change, place), data = BROKEN[name], arrays()
    change(data)
    path = write(tmp_path / ("model.npz" if write is write_npz else "model.pkl"), data)
    with pytest.raises(DataError) as caught:
        smpl.load(path)
    assert caught.value.place.startswith(place) and caught.value.remedy and str(path) in str(caught.value)
