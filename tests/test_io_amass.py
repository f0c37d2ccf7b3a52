import gzip
import io as bytes_io
import pickle
import re
import zipfile
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from seeds import amass_arrays as arrays

import results
from motionlab import io, rotation
from motionlab.animate import rewriting
from motionlab.errors import DataError
from motionlab.io import smpl
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

FRAMES = 7


def written(path, content: dict):
    np.savez(path, **content)
    return path


@pytest.mark.parametrize("columns", [72, 156, 165])
def test_body_joints_of_every_layout_agree_with_scipy(tmp_path, columns):
    content = arrays(columns)
    path = written(tmp_path / "a.npz", content)
    motion = smpl.load_motion(path)
    expected = Rotation.from_rotvec(content["poses"][:, :66].reshape(-1, 3)).as_matrix()
    np.testing.assert_allclose(motion.rot.reshape(-1, 3, 3).numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(motion.root.numpy(), content["trans"], atol=1e-6)
    assert motion.fps == 120 and motion.skeleton is STANDARD


def test_split_keys_are_the_whole_pose(tmp_path):
    whole = arrays(165)
    split = {k: v for k, v in whole.items() if k not in ("poses", "mocap_framerate")}
    split |= {"root_orient": whole["poses"][:, :3], "pose_body": whole["poses"][:, 3:66]}
    split["mocap_frame_rate"] = np.array(120.0)
    a, b = smpl.load_motion(written(tmp_path / "a.npz", whole)), smpl.load_motion(written(tmp_path / "b.npz", split))
    torch.testing.assert_close(a.rot, b.rot, atol=0, rtol=0)
    assert a.fps == b.fps == 120


@pytest.mark.parametrize("key", smpl.RATES)
def test_every_spelling_of_the_frame_rate(tmp_path, key):
    content = arrays()
    content[key] = content.pop("mocap_framerate")
    assert smpl.load_motion(written(tmp_path / "a.npz", content)).fps == 120


def test_frame_rates_that_disagree_are_refused_and_ones_that_agree_are_not(tmp_path):
    same = arrays() | {"fps": np.array(120)}
    assert smpl.load_motion(written(tmp_path / "a.npz", same)).fps == 120
    with pytest.raises(DataError, match=r"mocap_framerate, fps: .*disagree: 120, 60"):
        smpl.load_motion(written(tmp_path / "b.npz", same | {"fps": np.array(60)}))


@pytest.mark.parametrize("seed", range(3))
def test_motion_to_amass_to_motion_is_exact(tmp_path, seed):
    generator = torch.Generator().manual_seed(seed)
    rot = rotation.random((FRAMES, 22), generator)
    contacts = torch.randint(0, 2, (FRAMES, 9), generator=generator).float()
    motion = Motion(STANDARD, torch.randn(FRAMES, 3, generator=generator), rot, 30.0, contacts)
    smpl.save_motion(tmp_path / "a.npz", motion)
    back = smpl.load_motion(tmp_path / "a.npz")
    torch.testing.assert_close(back.root, motion.root, atol=1e-7, rtol=0)
    torch.testing.assert_close(back.rot, motion.rot, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.contacts, contacts, atol=0, rtol=0)
    assert back.fps == 30.0


@pytest.mark.parametrize("columns", [72, 156, 165])  # SMPL's, SMPL+H's, SMPL-X's
def test_amass_to_motion_to_amass_keeps_the_body(tmp_path, columns):
    content = arrays(columns)
    motion = smpl.load_motion(written(tmp_path / "a.npz", content))
    smpl.save_motion(tmp_path / "b.npz", motion)
    back = np.load(tmp_path / "b.npz")
    np.testing.assert_allclose(back["poses"][:, :66], content["poses"][:, :66], atol=2e-6)
    np.testing.assert_allclose(back["trans"], content["trans"], atol=1e-6)
    assert back["poses"].shape == (FRAMES, 156) and not back["poses"][:, 66:].any()


def test_pickled_members_that_nobody_needs_are_not_touched(tmp_path):
    content = arrays() | {"markers_latent_vids": np.array({"a": 1}, dtype=object)}
    assert smpl.load_motion(written(tmp_path / "a.npz", content)).frames == FRAMES


SYSTEMS = {"gvhmr.pt": results.gvhmr, "wham.pkl": results.wham, "tram.npy": results.tram, "aist.pkl": results.aist}
SYSTEMS["phalp.pkl"] = results.phalp


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_other_systems_write_is_the_person_they_saw(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(SYSTEMS[name]())
    loaded, person = io.load(path), results.person()
    torch.testing.assert_close(loaded.rot, person.rot, atol=2e-6, rtol=0)
    torch.testing.assert_close(loaded.root, person.root, atol=2e-5, rtol=0)
    usual = 60 if name == "aist.pkl" else 30
    assert loaded.fps == usual and any("--fps-in" in note for note in loaded.notes)
    assert io.load(path, fps=24).fps == 24
    assert any("camera" in note for note in loaded.notes) == (name in ("tram.npy", "phalp.pkl"))


def test_of_several_people_the_longest_is_first_and_the_others_are_said(tmp_path):
    (tmp_path / "a.pkl").write_bytes(results.wham())
    first, second = io.load(tmp_path / "a.pkl"), io.load(tmp_path / "a.pkl", person=1)
    assert (first.frames, second.frames) == (6, 3) and any("person 0 of 2" in note for note in first.notes)
    with pytest.raises(DataError, match="no person 2 of 2"):
        io.load(tmp_path / "a.pkl", person=2)


def test_tracks_of_frames_are_people_where_they_were_seen(tmp_path):
    (tmp_path / "a.pkl").write_bytes(results.phalp())
    second, person = io.load(tmp_path / "a.pkl", person=1), results.person(seed=6)
    seen = [2, 3, 5]
    torch.testing.assert_close(second.rot, person.rot[seen], atol=2e-6, rtol=0)
    torch.testing.assert_close(second.root, person.root[seen], atol=2e-5, rtol=0)
    assert any("frames are missing" in note for note in second.notes)
    (tmp_path / "b.pkl").write_bytes(gzip.compress(results.phalp(packed=False)))
    assert torch.equal(io.load(tmp_path / "b.pkl").rot, io.load(tmp_path / "a.pkl").rot)
    for broken in (zlib.compress(results.as_joblib([np.zeros(3), Hostile()])), results.phalp()[:-200], b"x\x9cno"):
        (tmp_path / "c.pkl").write_bytes(broken)
        with pytest.raises(DataError):
            io.load(tmp_path / "c.pkl")


@pytest.mark.parametrize("shape", ["66 columns", "joints", "matrices", "split", "smplx", "no body"])
def test_shapes_that_people_save(tmp_path, shape):
    content, person = arrays(156), results.person(FRAMES)
    turns, trans, rot = results.parameters(torch.eye(3).double(), person)
    content |= {
        "poses": np.concatenate((turns, content["poses"][:, 66:]), 1),
        "trans": trans,
        "betas": np.zeros((1, 10)),
    }
    change = {
        "66 columns": {"poses": turns},
        "joints": {"poses": content["poses"].reshape(FRAMES, 52, 3), "betas": np.zeros((FRAMES, 10))},
        "matrices": {"poses": rot.numpy(), "betas": np.float64(0)},
        "split": {"global_orient": turns[:, None, :3], "body_pose": turns[:, 3:].reshape(FRAMES, 21, 3)},
        "smplx": {"global_orient": rot[:, 0].numpy(), "body_pose": rot[:, 1:].numpy()},
        "no body": {"poses": turns[:, :63]},
    }[shape]
    if "body_pose" in change:
        del content["poses"]
        content["transl"] = content.pop("trans")
    path = written(tmp_path / "a.npz", content | change)
    if shape == "no body":
        with pytest.raises(DataError, match="expected 66 columns or more, got 63"):
            smpl.load_motion(path)
        return
    loaded = smpl.load_motion(path)
    torch.testing.assert_close(loaded.rot, person.rot, atol=2e-6, rtol=0)
    torch.testing.assert_close(loaded.root, person.root, atol=1e-6, rtol=0)
    rot = loaded.rot.clone()
    rot[2, 5] = torch.eye(3)
    rewriting.write_back(path, tmp_path / "b.npz", loaded, replace(loaded, rot=rot))
    torch.testing.assert_close(smpl.load_motion(tmp_path / "b.npz").rot, rot, atol=2e-6, rtol=0)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_people_in_a_plain_pickle(tmp_path, protocol):
    turns, trans, _ = results.parameters(results.Y_UP)
    one = {"pose_world": np.concatenate((turns, np.zeros((len(turns), 6))), 1), "trans_world": trans}
    people = {0: {key: value[:2] for key, value in one.items()}, 3: one}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(people, protocol=protocol))
    torch.testing.assert_close(io.load(tmp_path / "a.pkl").rot, results.person().rot, atol=2e-6, rtol=0)
    assert io.load(tmp_path / "a.pkl", person=1).frames == 2


@pytest.mark.parametrize("new", [True, False])
def test_arrays_of_numpy_in_a_file_of_torch(tmp_path, new):
    turns, trans, _ = results.parameters(results.Y_UP)
    body = {"global_orient": turns[:, :3], "body_pose": turns[:, 3:], "transl": trans, "fps": np.float64(30)}
    torch.save({"smpl_params_global": body}, tmp_path / "a.pt", _use_new_zipfile_serialization=new)
    torch.testing.assert_close(io.load(tmp_path / "a.pt").rot, results.person().rot, atol=2e-6, rtol=0)


def test_a_damaged_kind_of_numbers_in_a_file_of_torch_ends_no_interpreter(tmp_path):
    """numpy's dtype would, where it is told so little of itself."""
    torch.save({"pose_world": np.zeros((2, 72)), "trans_world": np.zeros((2, 3))}, stream := bytes_io.BytesIO())
    with zipfile.ZipFile(stream) as archive, zipfile.ZipFile(tmp_path / "a.pt", "w") as damaged:
        for name in archive.namelist():
            damaged.writestr(name, re.sub(rb"<q.NNN", b"<N", archive.read(name), count=1))
    assert io.load(tmp_path / "a.pt").frames == 2


class Hostile:
    def __reduce__(self):
        return print, ("executed",)


def test_code_is_refused_wherever_it_hides(tmp_path, capsys):
    stream = bytes_io.BytesIO()
    torch.save({"smpl_params_global": Hostile()}, stream)
    nested = bytes_io.BytesIO()
    np.save(nested, {"pred_rotmat": Hostile()}, allow_pickle=True)
    state = b"\x80\x02c_codecs\nencode\n}X\x01\x00\x00\x00aX\x01\x00\x00\x00bsb."  # sets the state of a function
    hostile = {
        "a.pt": stream.getvalue(),
        "b.npy": nested.getvalue(),
        "c.pkl": results.as_joblib([np.zeros(3), Hostile()]),
    }
    for name, data in (hostile | {"d.pkl": state}).items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(DataError) as error:
            io.load(tmp_path / name)
        assert "weights_only" not in str(error.value)  # torch's advice to run it after all
    assert "executed" not in capsys.readouterr().out


def test_several_people_in_one_array_of_each(tmp_path):
    """SLAHMR's (P, T, ...), HMR's (1, T, ...); an editor's copy holds one of them."""
    people = [results.person(FRAMES, seed) for seed in (0, 1)]
    turns, trans, _ = zip(*(results.parameters(torch.eye(3).double(), person) for person in people), strict=True)
    content = {"root_orient": np.stack(turns)[..., :3], "pose_body": np.stack(turns)[..., 3:], "trans": np.stack(trans)}
    path = written(tmp_path / "a.npz", content | {"fps": 30.0})
    for k, person in enumerate(people):
        loaded = io.load(path, person=k)
        torch.testing.assert_close(loaded.rot, person.rot, atol=2e-6, rtol=0)
        torch.testing.assert_close(loaded.root, person.root, atol=1e-5, rtol=0)
        assert any(f"person {k} of 2" in note for note in loaded.notes)
        rewriting.write_back(path, tmp_path / "b.npz", loaded, loaded)
        torch.testing.assert_close(io.load(tmp_path / "b.npz").rot, person.rot, atol=2e-6, rtol=0)
    lone = io.load(written(tmp_path / "c.npz", {k: v[1:] for k, v in content.items()}), fps=30)
    torch.testing.assert_close(lone.rot, people[1].rot, atol=2e-6, rtol=0)
    assert not any("person" in note for note in lone.notes)
    with pytest.raises(DataError, match="no person 2 of 2"):
        io.load(path, person=2)


@pytest.mark.parametrize("kind", ["PromptHMR", "EMDB", "camera alone", "list"])
def test_bodies_are_found_however_deep_those_of_the_world_first(tmp_path, kind):
    person = results.person(FRAMES)
    turns, trans, _ = results.parameters(torch.eye(3).double(), person)
    wrong = {"pose": 0 * turns, "trans": 0 * trans}
    tree = {
        "PromptHMR": {"people": {"1": {"smplx_cam": wrong, "smplx_world": {"pose": turns, "trans": trans}}}},
        "EMDB": {"smpl": {"poses_root": turns[:, :3], "poses_body": turns[:, 3:], "trans": trans}, "camera": {"w": 1}},
        "camera alone": {"smpl_params_incam": {"pose": turns, "trans": trans}},
        "list": {"poses": [turns], "trans": [trans]},  # 3DPW's
    }[kind]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(tree))
    loaded = io.load(tmp_path / "a.pkl", fps=30)
    torch.testing.assert_close(loaded.rot, person.rot, atol=2e-6, rtol=0)
    assert any("axes of the camera" in note for note in loaded.notes) == (kind == "camera alone")


@pytest.mark.parametrize("kind", ["degrees", "6-D", "6-D flat", "quaternions"])
def test_rotations_of_another_kind_are_refused_not_misread(tmp_path, kind):
    content, person = arrays(66), results.person(FRAMES)
    turns = results.parameters(torch.eye(3).double(), person)[0]
    six = person.rot[..., :2].reshape(FRAMES, 22, 6).numpy()
    told = {"degrees": np.rad2deg(turns), "6-D": six, "6-D flat": six.reshape(FRAMES, 132)}
    told["quaternions"] = np.ones((FRAMES, 22, 4))
    with pytest.raises(DataError, match="degrees" if kind == "degrees" else "expected axis-angle") as caught:
        io.load(written(tmp_path / "a.npz", content | {"poses": told[kind]}))
    assert ("radians" if kind == "degrees" else "convert quaternions or 6-D") in caught.value.remedy


@pytest.mark.parametrize(("unit", "speed", "doubted"), [(1, 3.0, False), (100, 1.0, True), (100, 0.0, True)])
def test_a_path_that_is_not_in_metres_is_doubted(tmp_path, unit, speed, doubted):
    trans = unit * np.array([[speed * t / 120, 0.0, 0.9] for t in range(FRAMES)])
    loaded = io.load(written(tmp_path / "a.npz", arrays(66) | {"trans": trans}))
    assert any("is it in metres?" in note for note in loaded.notes) == doubted
