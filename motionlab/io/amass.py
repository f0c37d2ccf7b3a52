"""AMASS npz: sequences of SMPL, SMPL+H or SMPL-X body parameters."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import ShapeError, check_shape
from motionlab.files import write_whole
from motionlab.io.reading import Spot, check_writable, frame_rate, numbers, read_npz, reading
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, Skeleton

#: Columns of ``poses`` -> model. All three begin with the same 22 joints: root and 21 body joints.
MODELS = {72: "smpl", 156: "smplh", 165: "smplx"}
#: Columns after the 22 body joints: SMPL's two hands as one joint each; fingers; jaw, eyes and fingers.
EXTRA = {"smpl": 6, "smplh": 90, "smplx": 99}
#: The split keys of SMPL-X files, in the order of ``poses``, and their columns.
POSE_PARTS = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}
RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
BODY = 66
#: Radians; a larger angle is a damaged number, and float64 has no digits left for its rotation.
LARGEST_ANGLE = 1e4


@dataclass(frozen=True, eq=False)
class Amass:
    """What an AMASS file holds. Axis-angle in radians, metres, z up.

    poses (T, D): root orientation and 21 body joints (66 columns), then what the model adds. trans (T, 3):
    SMPL's translation. betas (B,): body shape. gender: as the file says. fps: frames per second. model: one of
    ``EXTRA``. contacts (T, 9) or None: of ``STANDARD.contact_names``; not AMASS's own, HuMoR and we add it.
    """

    poses: Tensor
    trans: Tensor
    betas: Tensor
    gender: str
    fps: float
    model: str
    contacts: Tensor | None = None


def _read(path: str | Path) -> Amass:
    """Reads everything in an AMASS file, float64, as it is.

    Both spellings of the frame rate (``mocap_framerate``, ``mocap_frame_rate``) and ``fps`` are known; ``poses``
    or the split keys ``root_orient``, ``pose_body``, ... (those after the body may be absent).

    Raises:
        DataError: a key is missing, its numbers have another shape or are not finite, or two frame rates differ.
    """
    with reading(path, 'save "poses" (T, 72, 156 or 165), "trans" (T, 3) and "mocap_framerate"') as at:
        arrays = read_npz(at, ("poses", "trans", "betas", "gender", "contacts", *RATES, *POSE_PARTS))
        poses = _poses(at, arrays)
        if "trans" not in arrays:
            raise at.error("this key is missing", place="trans")
        trans = numbers(at, arrays["trans"], f"{len(poses)} 3", "trans")
        rates = {key: frame_rate(at, arrays[key], key) for key in RATES if key in arrays}
        if not rates:
            raise at.error("the frame rate is missing", place=" / ".join(RATES))
        if len(set(rates.values())) > 1:
            raise at.error(
                f"the frame rates disagree: {', '.join(f'{rate:g}' for rate in rates.values())}",
                place=", ".join(rates),
                remedy="keep the key that is right",
            )
        betas = numbers(at, arrays["betas"], "B", "betas") if arrays.get("betas", np.empty(0)).size else np.zeros(0)
        contacts = arrays.get("contacts")
        if contacts is not None:
            contacts = torch.from_numpy(
                numbers(at, contacts, f"{len(poses)} {len(STANDARD.contact_names)}", "contacts")
            )
        return Amass(
            torch.from_numpy(poses),
            torch.from_numpy(trans),
            torch.from_numpy(betas),
            _text(arrays.get("gender", np.array("neutral"))),
            next(iter(rates.values())),
            MODELS[poses.shape[1]],
            contacts,
        )


def load(path: str | Path, *, skeleton: Skeleton = STANDARD, pelvis_offset: Tensor | None = None) -> Motion:
    """Reads the body of an AMASS file as a Motion on 22 joints; hands, jaw and eyes are left out.

    root = trans + pelvis_offset. SMPL's translation is not the pelvis: pelvis = trans + J_0(betas), where J_0 is
    the pelvis of the shaped template, which the root rotation leaves where it is. Without the body model J_0 is
    not known and the root lies some 0.3 m off (upwards for SMPL); the motion is the same.

    Args:
        skeleton: 22 joints in SMPL's order, such as that of the subject's own body.
        pelvis_offset: (3,) J_0(betas) in metres; None is zero.

    Raises:
        DataError: see ``read``.
        ShapeError: the skeleton has not 22 joints, or pelvis_offset is not (3,).
    """
    if len(skeleton) != BODY // 3:
        raise ShapeError(f"skeleton: expected the {BODY // 3} body joints of SMPL, got {len(skeleton)}")
    amass = _read(path)
    guess = "pelvis offset J_0(betas) not given: SMPL's translation is taken as the place of the root"
    notes = () if pelvis_offset is not None else (guess,)
    if amass.poses.shape[1] > BODY:
        notes += (f"{amass.model}: hands and face are left out, 22 joints of the body are read",)
    turns = amass.poses[:, :BODY].unflatten(-1, (-1, 3))
    return Motion(
        skeleton,
        (amass.trans + _offset(pelvis_offset)).float(),
        rotation.axis_angle_to_matrix(turns).float(),
        amass.fps,
        contacts=None if amass.contacts is None else amass.contacts.float(),
        name=Path(path).stem,
        notes=notes,
    )


def save(
    path: str | Path,
    motion: Motion,
    *,
    pelvis_offset: Tensor | None = None,
    betas: Tensor | None = None,
    gender: str = "neutral",
    model: str = "smplh",
) -> None:
    """Writes a motion on SMPL's 22 joints as an AMASS npz that ``load`` with the same offset gives back exactly.

    trans = root - pelvis_offset; joints that the model adds are zero; contacts are kept under ``contacts``.

    Raises:
        ShapeError: batch axes, no frames, not 22 joints, or a model not in ``EXTRA``.
        DataError: NaN or infinity, or the file cannot be written.
    """
    check_writable(path, motion)
    check_shape(motion.rot, f"T {BODY // 3} 3 3", "rot")
    if model not in EXTRA:
        raise ShapeError(f"model: expected one of {', '.join(EXTRA)}, got {model!r}")
    turns = rotation.matrix_to_axis_angle(motion.rot.double()).flatten(-2)
    poses = torch.cat((turns, turns.new_zeros(len(turns), EXTRA[model])), -1)
    content = {
        "poses": poses.cpu().numpy(),
        "trans": (motion.root.double().cpu() - _offset(pelvis_offset)).numpy(),
        "betas": np.zeros(16) if betas is None else betas.double().cpu().numpy(),
        "gender": np.array(gender),
        "mocap_framerate": np.array(float(motion.fps)),
    }
    if motion.contacts is not None and motion.skeleton.contact_names == STANDARD.contact_names:
        content["contacts"] = motion.contacts.cpu().numpy()
    archive = io.BytesIO()
    np.savez_compressed(archive, **content)
    write_whole(path, archive.getvalue())


def _poses(at: Spot, arrays: dict[str, np.ndarray]) -> np.ndarray:
    if "poses" in arrays:
        poses = numbers(at, arrays["poses"], "T D", "poses", LARGEST_ANGLE)
    else:
        for key in ("root_orient", "pose_body"):
            if key not in arrays:
                raise at.error(f'neither "poses" nor "{key}" is there', place=key)
        found = {
            key: numbers(at, arrays[key], f"T {POSE_PARTS[key]}", key, LARGEST_ANGLE)
            for key in POSE_PARTS
            if key in arrays
        }
        rows = {len(part) for part in found.values()}
        if len(rows) > 1:
            raise at.error(f"expected equally many frames, got {sorted(rows)}", place=", ".join(found))
        poses = np.concatenate([found.get(key, np.zeros((*rows, width))) for key, width in POSE_PARTS.items()], axis=1)
    if poses.shape[1] not in MODELS:
        raise at.error(f"expected {', '.join(map(str, MODELS))} columns, got {poses.shape[1]}", place="poses")
    return poses


def _offset(pelvis_offset: Tensor | None) -> Tensor:
    if pelvis_offset is None:
        return torch.zeros(3, dtype=torch.float64)
    check_shape(pelvis_offset, "3", "pelvis_offset")
    return pelvis_offset.double().cpu()


def _text(value: np.ndarray) -> str:
    item = value.reshape(-1)[0] if value.size and value.dtype.kind in "US" else "neutral"
    return item.decode("latin-1") if isinstance(item, bytes) else str(item)
