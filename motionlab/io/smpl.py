"""SMPL, SMPL+H and SMPL-X: sequences of their parameters, and their bodies.

Sequences are AMASS and its kin as npz, and what GVHMR, WHAM, TRAM, PHALP (4DHumans) and AIST++ give as .pt, .pkl or
.npy. Bodies are npz, and the official pkl files. Pickles are read without running them.
"""

import io
from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from motionlab import rotation
from motionlab.body import BodyModel
from motionlab.errors import check_shape
from motionlab.files import write_whole
from motionlab.io import judging
from motionlab.io.judging import Axes, Fps
from motionlab.io.pickles import array_of, arrays_of, read_pickle
from motionlab.io.reading import Location, check_keys, checked_array, frame_rate, read_bytes, read_npz, reading
from motionlab.motion import Motion, single
from motionlab.skeleton import STANDARD

#: Joints of SMPL, SMPL+H and SMPL-X. All begin with the same 22: root and 21 body joints.
_MODELS = (24, 52, 55)
#: Keys of poses, whole or split, of translations and of frame rates; what is in the world before what is in a camera.
POSES = ("pose_world", "poses", "smpl_poses", "pose", "fullpose", "pred_rotmat")
ROOT, PARTS = ("root_orient", "global_orient", "poses_root"), ("pose_body", "body_pose", "poses_body")
TRANS = ("trans_world", "trans", "transl", "smpl_trans", "translation", "pred_trans")
RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate", "framerate")
_KEYS = (*POSES, *ROOT, *PARTS, *TRANS, *RATES, "contacts", "smpl_scaling", "frame_ids")
BODY = len(STANDARD)
#: Keys that tell a system: its name, what is up in its world, and its usual frame rate.
_SYSTEMS = {
    "smpl_params_global": ("GVHMR", "y", 30.0), "pose_world": ("WHAM", "y", 30.0), "pred_rotmat": ("TRAM", "-y", 30.0),
    "phalp_cam": ("PHALP", "-y", 30.0), "smpl_poses": ("AIST++", "y", 60.0),
}  # fmt: skip
_OF_FRAME = ("tid", "smpl", "camera", "tracked_time")  # lists of PHALP's: a number, a body, where, frames unseen
#: Columns a joint, over three, of which there are twice as many: 6-D rotations.
_DOUBLE = {2 * joints for joints in (BODY - 1, BODY, BODY + 1, *_MODELS)}
_FASTEST, _FARTHEST = 30.0, 30.0  # metres a second, and from the origin: more are hardly a person's


def _arrays(at: Location, person: int) -> tuple[dict[str, np.ndarray], tuple[str, str, float | None]]:
    """The arrays of one body that are known, and of which system: its name, up axis and usual rate."""
    data = read_bytes(at)
    plain = data[:2] == b"PK" and b"data.pkl" not in data[:200]  # torch's archives begin with it
    tree = read_npz(at, _KEYS) if plain else read_pickle(at, data)
    bodies = _bodies(_by_person(at, tree))
    in_world = [(way, body) for way, body in bodies if "cam" not in way]
    keys = {key for way, body in bodies for key in (*way.split(), *body)}
    system = next((found for key, found in _SYSTEMS.items() if key in keys), ("SMPL", "z", None))
    trees = [body for _, body in in_world or bodies] or [tree]
    people = [one for each in trees for one in _one_by_one(arrays_of(at, each, _KEYS, "whole file"))]
    people.sort(key=lambda each: -max((len(each[key]) for key in (*POSES, *PARTS) if key in each), default=0))
    if len(people) > 1:
        at.notes.append(f"person {person} of {len(people)}, the longest first: choose with person=, or --person")
    if person and not 0 <= person < len(people):
        raise at.error(f"no person {person} of {len(people)}", remedy="count them from 0, the longest first")
    if "pred_rotmat" in people[person] or (bodies and not in_world):
        at.notes.append("in the axes of the camera, whose own motion is not in this file")
    return people[person], system


def _bodies(tree: object, way: str = "", depth: int = 4) -> list[tuple[str, dict]]:
    """The dictionaries of a tree that hold poses, each with the keys that lead there."""
    if not isinstance(tree, dict) or {*POSES, *PARTS} & tree.keys():
        return [(way, tree)] if isinstance(tree, dict) else []
    return [found for key, each in tree.items() for found in _bodies(each, f"{way} {key}", depth - 1) if depth]


def _by_person(at: Location, tree: object) -> object:
    """PHALP's frames by person, each in the frames in which they were seen; another tree as it is."""
    frames = [*tree.values()] if isinstance(tree, dict) else []
    if not frames or not all(isinstance(frame, dict) and {"tid", "smpl"} <= frame.keys() for frame in frames):
        return tree
    people: dict[int, list[dict]] = {}
    for frame in frames:
        for who, body, place, unseen in zip(*(frame[key] for key in _OF_FRAME), strict=True):
            if not array_of(at, unseen):
                row = {"transl": place, "frame_ids": frame["time"]} | {key: body[key] for key in (ROOT[1], PARTS[1])}
                people.setdefault(int(array_of(at, who)), []).append(row)
    return {"phalp_cam": {who: {key: [row[key] for row in rows] for key in rows[0]} for who, rows in people.items()}}


def _one_by_one(arrays: dict[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """The bodies of arrays, which may be of several: (P, T, ...)."""
    trans = arrays.get(keys_of(arrays)[-1], np.zeros(0))
    if trans.ndim != 3 or trans.shape[1] == 1:
        return [arrays]
    return [{k: a[n] if a.shape[:2] == trans.shape[:2] else a for k, a in arrays.items()} for n in range(len(trans))]


def keys_of(arrays: Container[str]) -> tuple[str, ...]:
    """Returns the keys of the whole pose, of its root and body, and of the translation; "" where there is none."""
    return tuple(next((key for key in keys if key in arrays), "") for keys in (POSES, ROOT, PARTS, TRANS))


def _turns(at: Location, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Axis-angle (T, J, 3) of all joints: of ``POSES``, or of the split ``ROOT`` and ``PARTS``."""
    whole, root, parts, _ = keys_of(arrays)
    if not whole and not (root and parts):
        raise at.error(f'neither "poses" nor "{(PARTS if root else ROOT)[0]}" is there', place="keys")
    keys = [whole] if whole else [root, parts]
    turns = np.concatenate([_axis_angles(at, arrays[key], key) for key in keys], axis=1)
    angles = np.linalg.norm(turns, axis=-1)
    if angles.any() and np.quantile(angles[angles > 0], 0.75) > 2 * np.pi:
        raise at.error("these are degrees", place=", ".join(keys), remedy="convert them to radians (numpy.deg2rad)")
    if turns.shape[1] < BODY:
        raise at.error(f"expected {3 * BODY} columns or more, got {3 * turns.shape[1]}", place=keys[-1])
    return turns


def _axis_angles(at: Location, array: np.ndarray, key: str) -> np.ndarray:
    """Axis-angle (T, J, 3) of (T, 3J), of (T, J, 3), or of matrices (T, J, 3, 3)."""
    # a larger angle than 1e4 is a damaged number, and float64 has no digits left for its rotation
    array = checked_array(at, array, " ".join("TJKL"[: max(array.ndim, 2)]), key, 1e4)
    if array.shape[-2:] != (3, 3) or (array.ndim == 3 and key not in ROOT):
        if array[0].size % 3 or array[0].size // 3 in _DOUBLE:
            remedy = "convert quaternions or 6-D rotations to it"
            raise at.error(f"expected axis-angle, got {array.shape}", place=key, remedy=remedy)
        return array.reshape(len(array), -1, 3)
    matrix = torch.from_numpy(array.reshape(len(array), -1, 3, 3))
    if not (matrix.mT @ matrix - torch.eye(3)).abs().max() < 0.1 or not (torch.linalg.det(matrix) > 0).all():
        raise at.error("matrices that are no rotations", place=key)
    return rotation.matrix_to_axis_angle(rotation.nearest(matrix)).numpy()


def _rate(at: Location, arrays: dict[str, np.ndarray], system: str, usual: float | None) -> float:
    rates = {key: frame_rate(at, arrays[key], key, judging.SAY_RATE) for key in RATES if key in arrays}
    if not rates and usual is None:
        raise at.error("the frame rate is missing", place=" / ".join(RATES), remedy=judging.SAY_RATE)
    if not rates:
        at.notes.append(f"{system} keeps no frame rate: taken as {usual:g}; {judging.SAY_RATE}")
    if len(set(rates.values())) > 1:
        said = ", ".join(f"{rate:g}" for rate in rates.values())
        raise at.error(f"the frame rates disagree: {said}", place=", ".join(rates), remedy="keep the key that is right")
    return next(iter(rates.values()), usual)


def load_motion(path: str | Path, *, person: int = 0, up: Axes = None, axes: Axes = None, fps: Fps = None) -> Motion:
    """Reads the body of a file as a Motion on 22 joints; hands, jaw and eyes are left out, shapes are not read.

    root = trans. SMPL's translation is not the pelvis: pelvis = trans + J_0(betas), where J_0 is the pelvis of the
    shaped template, which the root rotation leaves where it is. Without the body model J_0 is not known and the root
    lies some 0.3 m off (upwards for SMPL); the motion is the same.

    Args:
        person: whom, of a file of several; the longest first.
        up, axes: instead of z up (GVHMR, WHAM and AIST++: y; TRAM: -y), which is doubted where the heads of the file
            are above its feet along another axis. fps: instead of the file's.

    Raises:
        DataError: a key is missing, its numbers have another shape or are not finite, or two frame rates differ;
            nothing that a pickle asks for is executed.
    """
    with reading(path, 'save "poses" (T, 66 or more), "trans" (T, 3) and "mocap_framerate"') as at:
        arrays, (system, says_up, usual) = _arrays(at, person)
        turns = _turns(at, arrays)
        frames, joints = turns.shape[:2]
        *_, key = keys_of(arrays)
        if not key:
            raise at.error("this key is missing", place="trans")
        trans = arrays[key].reshape(len(arrays[key]), -1) if arrays[key].ndim == 3 else arrays[key]
        trans = checked_array(at, trans, f"{frames} 3", key)
        if "smpl_scaling" in arrays:
            trans = trans / checked_array(at, arrays["smpl_scaling"].reshape(-1), "1", "smpl_scaling")
        ids, contacts = arrays.get("frame_ids", np.zeros(0)), None
        if ids.size == frames > 1 and (np.diff(ids.ravel().astype(float)) != 1).any():
            at.notes.append("frames are missing in between, which the file joins: see its frame_ids")
        if "contacts" in arrays:  # not AMASS's own, HuMoR and we add it
            contacts = checked_array(at, arrays["contacts"], f"{frames} {len(STANDARD.contact_names)}", "contacts")
            contacts = torch.from_numpy(contacts).float()
        rate = _rate(at, arrays, system, usual) if fps is None else frame_rate(at, fps, "fps")
        fast = rate * np.linalg.norm(np.diff(trans, axis=0), axis=-1).max(initial=0.0)
        far = np.linalg.norm(np.median(trans, axis=0))
        if fast > _FASTEST or far > _FARTHEST:
            at.notes.append(f"{key} moves by up to {fast:.3g} m/s, {far:.3g} m from the origin: is it in metres?")
        at.notes.append("pelvis offset J_0(betas) not given: SMPL's translation is taken as the place of the root")
        if joints > BODY:
            at.notes.append(f"{joints} joints: hands and face are left out, {BODY} joints of the body are read")
        rot = rotation.axis_angle_to_matrix(torch.from_numpy(turns[:, :BODY]))
        motion = Motion(STANDARD, torch.from_numpy(trans), rot, rate, contacts, at.path.stem, tuple(at.notes))
        return judging.to_world(at, motion, unit=1.0, up=up, axes=axes, says_up=says_up, trust=0.5)


def save_motion(path: str | Path, motion: Motion) -> None:
    """Writes a motion on SMPL's 22 joints as an AMASS npz that ``load_motion`` gives back exactly.

    trans = root; the hands of SMPL+H and the betas are zero; contacts are kept under ``contacts``.

    Raises:
        ShapeError: batch axes, no frames, or not 22 joints.
        DataError: NaN or infinity, or the file cannot be written.
    """
    single(motion, path)
    check_shape(motion.rot, f"T {BODY} 3 3", "rot")
    turns = rotation.matrix_to_axis_angle(motion.rot.double()).flatten(-2)
    content = {
        "poses": torch.nn.functional.pad(turns, (0, 3 * (52 - BODY))).cpu().numpy(),
        "trans": motion.root.double().cpu().numpy(),
        "betas": np.zeros(16),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(float(motion.fps)),
    }
    if motion.contacts is not None and motion.skeleton.contact_names == STANDARD.contact_names:
        content["contacts"] = motion.contacts.cpu().numpy()
    archive = io.BytesIO()
    np.savez_compressed(archive, **content)
    write_whole(path, archive.getvalue())


# -------------------------------------------------------------------------------------------------- bodies
_ARRAYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
_UNCHANGED = "use an unchanged model file of SMPL, SMPL+H or SMPL-X (smpl.is.tue.mpg.de), or an npz of its arrays"
_POINTS = ("nose", "right_eye", "left_eye", "right_ear", "left_ear", "left_big_toe", "left_small_toe", "left_heel")
_POINTS += ("right_big_toe", "right_small_toe", "right_heel")
# Source: smplx (Pavlakos et al.), vertex_ids.py; keyed by the number of vertices.
_VERTICES = {
    6890: (332, 6260, 2800, 4071, 583, 3216, 3226, 3387, 6617, 6624, 6787),
    10475: (9120, 9929, 9448, 616, 6, 5770, 5780, 8846, 8463, 8474, 8635),
}


def load(path: str | Path, betas: Sequence[float] = ()) -> BodyModel:
    """Reads a body from a file in SMPL's format, on the 22 standard joints.

    Hands, jaw and eyes of larger models move rigidly with the wrist or head above them: their weights are folded into
    it. Pose correctives (``posedirs``) of the 21 moving joints are kept and applied by :func:`motionlab.body.lbs`.

    betas: the person's shape, standard deviations along the file's first directions; by default its average person.

    Source: Loper et al. 2015; Romero et al. 2017; Pavlakos et al. 2019.
    Raises:
        DataError: naming the file, the key and the remedy; nothing that a pickle asks for is executed.
    """
    with reading(path, _UNCHANGED) as at:
        data = read_bytes(at)
        keys = (*_ARRAYS, "posedirs")
        raw = read_npz(at, keys) if data[:2] == b"PK" else arrays_of(at, read_pickle(at, data), keys, "pickle")
        check_keys(at, raw, _ARRAYS)
        count = len(STANDARD)
        template = checked_array(at, raw["v_template"], "V 3", "v_template")
        vertices, height = len(template), np.ptp(template[:, 1])
        if not 0.2 < height < 3:
            raise at.error(f"{height:.3g} m high (y is up)", place="v_template", remedy="convert it to metres, y up")
        table = checked_array(at, raw["kintree_table"], "2 J", "kintree_table")
        parents = [-1, *table[0, 1:].astype(int).tolist()]  # the root's own entry is -1 or 2**32 - 1
        later = all(0 <= parent < joint for joint, parent in enumerate(parents[1:], start=1))
        if tuple(parents[:count]) != STANDARD.parents or not later:
            raise at.error("no tree that begins with SMPL's 22 body joints", place="kintree_table")
        shape = checked_array(at, raw["shapedirs"], f"{vertices} 3 B", "shapedirs")
        if len(betas) > shape.shape[-1]:
            raise at.error(f"{shape.shape[-1]} shape directions, fewer than the {len(betas)} betas", place="shapedirs")
        template = template + shape[..., : len(betas)] @ np.asarray(betas, float)
        weights = checked_array(at, raw["weights"], f"{vertices} {len(parents)}", "weights")
        regressor = checked_array(at, raw["J_regressor"], f"{len(parents)} {vertices}", "J_regressor")
        for key, rows in (("weights", weights), ("J_regressor", regressor)):
            off = np.abs(rows.sum(1) - 1)
            if not off.max() < 1e-3:
                raise at.error(f"row {off.argmax()} sums to {rows.sum(1)[off.argmax()]:.4g}, expected 1", place=key)
        if weights.min() < 0:
            raise at.error(f"a negative weight at vertex {weights.min(1).argmin()}", place="weights")
        faces = checked_array(at, raw["f"], "F 3", "f")
        if faces.min() < 0 or faces.max() >= vertices or (faces != faces.round()).any():
            raise at.error(f"expected indices of {vertices} vertices, found {faces.min()} to {faces.max()}", place="f")
        folded, owners = np.zeros((vertices, count)), [*range(count)]
        for joint, parent in enumerate(parents):
            owners += [owners[parent]] if joint >= count else []
            folded[:, owners[joint]] += weights[:, joint]
        joints = regressor[:count] @ template
        offsets = joints - np.vstack((joints[:1], joints[list(STANDARD.parents[1:])]))
        if (posed := raw.get("posedirs")) is not None:
            posed = checked_array(at, posed, f"{vertices} 3 {9 * (len(parents) - 1)}", "posedirs")
            posed = torch.from_numpy(posed[..., : 9 * (count - 1)]).float()
        sole = float(joints[:, 1].min() - template[:, 1].min())
        return BodyModel(
            template=torch.from_numpy(template).float(),
            joints=torch.from_numpy(joints).float(),
            bind_rot=torch.eye(3).repeat(count, 1, 1),
            weights=torch.from_numpy(folded / folded.sum(1, keepdims=True)).float(),
            faces=torch.from_numpy(faces).long(),
            skeleton=replace(STANDARD, offsets=torch.from_numpy(offsets).float(), sole=sole),
            keypoint_vertices=dict(zip(_POINTS, _VERTICES.get(vertices, ()), strict=False)),
            pose_directions=posed,
        )
