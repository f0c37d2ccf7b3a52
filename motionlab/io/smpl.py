"""SMPL-format bodies (SMPL, SMPL+H, SMPL-X) from npz, and from the official pkl files without running them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from motionlab.body import BodyModel
from motionlab.io.pickles import arrays_of, read_pickle
from motionlab.io.reading import check_keys, checked_array, read_bytes, read_npz, reading
from motionlab.skeleton import STANDARD

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

    Hands, jaw and eyes of larger models move rigidly with the wrist or head above them: their weights are folded into
    it. Pose correctives (``posedirs``) of the 21 moving joints are kept and applied by :func:`motionlab.body.lbs`.

    betas: how many shape directions to keep, as far as the file has them.

    Source: Loper et al. 2015; Romero et al. 2017; Pavlakos et al. 2019.
    Raises:
        DataError: naming the file, the key and the remedy; nothing that a pickle asks for is executed.
    """
    with reading(path, _REMEDY) as at:
        data = read_bytes(at)
        keys = (*_KEYS, "posedirs")
        raw = read_npz(at, keys) if data[:2] == b"PK" else arrays_of(at, read_pickle(at, data), keys, "pickle")
        check_keys(at, raw, _KEYS)
        count = len(STANDARD)
        template = checked_array(at, raw["v_template"], "V 3", "v_template")
        vertices, height = len(template), np.ptp(template[:, 1])
        if not 0.2 < height < 3:
            raise at.error(f"{height:.3g} m high (y is up)", place="v_template", remedy="convert it to metres, y up")
        table = checked_array(at, raw["kintree_table"], "2 J", "kintree_table")
        parents = [-1, *table[0, 1:].astype(int).tolist()]  # the root's own entry is -1 or 2**32 - 1
        if wrong := [joint for joint, parent in enumerate(parents) if joint and not 0 <= parent < joint]:
            raise at.error(f"joint {wrong[0]} has parent {parents[wrong[0]]}", place="kintree_table")
        if tuple(parents[:count]) != STANDARD.parents:
            raise at.error("does not begin with the tree of SMPL's 22 body joints", place="kintree_table")
        shape = checked_array(at, raw["shapedirs"], f"{vertices} 3 B", "shapedirs")[..., :betas]
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
        directions = np.einsum("jv,vcb->jcb", regressor[:count], shape)
        offsets = joints - np.vstack((joints[:1], joints[list(STANDARD.parents[1:])]))
        posed = None
        if "posedirs" in raw:
            posed = checked_array(at, raw["posedirs"], f"{vertices} 3 {9 * (len(parents) - 1)}", "posedirs")
            posed = torch.from_numpy(posed[..., : 9 * (count - 1)]).float()
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
            skeleton=replace(STANDARD, offsets=torch.from_numpy(offsets).float(), sole=sole),
            keypoint_vertices=dict(zip(_POINTS, _VERTICES.get(vertices, ()), strict=False)),
            pose_directions=posed,
            notes=tuple(notes),
        )
