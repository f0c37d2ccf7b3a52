"""Character clips for simulation: AMP (IsaacGymEnvs) as npz, DeepMimic as JSON.

AMP: poselib's arrays, any skeleton, quaternions x first. DeepMimic: frames of 44 numbers for one fixed 15-joint
humanoid.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from motionlab import rotation
from motionlab.io.reading import Location, check_keys, checked_array, frame_rate, read_json, read_npz, reading
from motionlab.motion import Motion, resample
from motionlab.skeleton import UPRIGHT, Skeleton

_AMP_KEYS = ("node_names", "parent_indices", "local_translation", "root_translation", "fps", "is_local")
_AMP_ROTATION = "local_or_global_rotation_xyzw"
#: Joint, parent, attachment in metres (x forward, y up, z right), numbers in a frame.
#: Source: DeepMimic, data/characters/humanoid3d.txt (MIT, Copyright (c) 2018 Xue Bin Peng).
_NAMES, _PARENTS, _OFFSETS, _WIDTHS = zip(
    ("root", -1, (0.0, 0.0, 0.0), 4),
    ("chest", 0, (0.0, 0.236151, 0.0), 4),
    ("neck", 1, (0.0, 0.223894, 0.0), 4),
    ("right_hip", 0, (0.0, 0.0, 0.084887), 4),
    ("right_knee", 3, (0.0, -0.421546, 0.0), 1),
    ("right_ankle", 4, (0.0, -0.409870, 0.0), 4),
    ("right_shoulder", 1, (-0.02405, 0.24350, 0.18311), 4),
    ("right_elbow", 6, (0.0, -0.274788, 0.0), 1),
    ("right_wrist", 7, (0.0, -0.258947, 0.0), 0),
    ("left_hip", 0, (0.0, 0.0, -0.084887), 4),
    ("left_knee", 9, (0.0, -0.421546, 0.0), 1),
    ("left_ankle", 10, (0.0, -0.409870, 0.0), 4),
    ("left_shoulder", 1, (-0.02405, 0.24350, -0.18311), 4),
    ("left_elbow", 12, (0.0, -0.274788, 0.0), 1),
    ("left_wrist", 13, (0.0, -0.258947, 0.0), 0),
    strict=True,
)
#: The character's body: x forward, y up, z right at rest; its ankles stand 5 cm above the floor.
_DEEPMIMIC = Skeleton(_NAMES, _PARENTS, torch.tensor(_OFFSETS), sole=0.05)


def load_amp(path: str | Path) -> Motion:
    """Reads an AMP clip: metres, z up, the file's own skeleton (x forward, y left, z up at rest).

    Rotations are against the parent where ``is_local`` is true, else against the world and are made
    local: R_local = R_parent^T R.

    Raises:
        DataError: not such a file; names the key.
    """
    with reading(path, "convert the poselib file again, with all its keys") as at:
        arrays = read_npz(at)
        check_keys(at, arrays, (_AMP_ROTATION, *_AMP_KEYS))
        names = arrays["node_names"]
        if names.ndim != 1 or names.dtype.kind != "U" or len(set(names.tolist())) != names.size or not names.size:
            raise at.error("expected a list of different names", place="node_names")
        parents = checked_array(at, arrays["parent_indices"], f"{names.size}", "parent_indices").astype(int).tolist()
        offsets = checked_array(at, arrays["local_translation"], f"{names.size} 3", "local_translation")
        at.place = "parent_indices"
        skeleton = Skeleton(tuple(names.tolist()), tuple(parents), torch.from_numpy(offsets).float())
        quaternion = checked_array(at, arrays[_AMP_ROTATION], f"T {len(skeleton)} 4", place=_AMP_ROTATION)
        root = checked_array(at, arrays["root_translation"], f"{len(quaternion)} 3", place="root_translation")
        rot = _rotations(at, quaternion[..., [3, 0, 1, 2]], skeleton.names, 0.05)
        if not checked_array(at, arrays["is_local"].reshape(-1), "1", "is_local")[0]:
            rot = skeleton.local(rot)
        fps = frame_rate(at, arrays["fps"], "fps")
        return Motion(skeleton, torch.from_numpy(root).float(), rot.float(), fps, name=at.path.stem)


def load_deepmimic(path: str | Path) -> Motion:
    """Reads a DeepMimic motion: metres, z up, the character's own skeleton.

    A frame is duration, root position, root quaternion (w first), then per joint a quaternion (spherical) or an angle
    about z (knees and elbows). The frame rate is 1 / the median duration; the last one is 0 in clips that do not loop.
    Where frames last differently the clip is resampled evenly, and noted.

    Raises:
        DataError: not such a file; names the frame.
    """
    with reading(path, "take the file from the DeepMimic repository again") as at:
        content = read_json(at)
        if not isinstance(content, dict) or not isinstance(content.get("Frames"), list):
            raise at.error('no list "Frames"', place="top level")
        rows = [checked_array(at, frame, "44", f"frame {i}") for i, frame in enumerate(content["Frames"])]
        table = checked_array(at, rows, "T 44", place='"Frames"')
        fps, times = _frame_rate(at, table[:, 0])
        rot = torch.eye(3, dtype=torch.float64).expand(len(table), len(_DEEPMIMIC), 3, 3).clone()
        parts = np.split(table, np.cumsum((4, *_WIDTHS)), axis=1)[1:-1]
        for joint, (name, part) in enumerate(zip(_NAMES, parts, strict=True)):
            if part.shape[1] == 4:  # rounded by hand in places: humanoid3d_punch goes down to 0.93
                rot[:, joint] = _rotations(at, part[:, None], (name,), 0.2)[:, 0]
            elif part.shape[1] == 1:
                rot[:, joint] = rotation.rotation_about("z", torch.from_numpy(part[:, 0]))
        rot[:, 0] = UPRIGHT.double() @ rot[:, 0]
        root = torch.from_numpy(table[:, 1:4]) @ UPRIGHT.double().T
        motion = Motion(_DEEPMIMIC, root, rot, fps, name=at.path.stem)
        if np.abs(np.diff(times) - 1).max(initial=0) >= 0.1:
            note = f"frames last up to {np.diff(times).max():.2f} times as long as usual: resampled to one rate"
            motion = replace(resample(motion, fps, times=times / fps), notes=(note,))
        return motion.to(torch.float32)


def _frame_rate(at: Location, durations: np.ndarray) -> tuple[float, np.ndarray]:
    """Frames per second, and the time of every frame in units of one frame."""
    inner = durations[:-1] if len(durations) > 1 else durations
    typical = float(np.sort(inner)[(len(inner) - 1) // 2])  # the lower median is a duration that occurs
    odd = int(inner.argmin() if inner.min() <= 0 else inner.argmax())
    if not 0 < inner[odd] or inner.sum() > 100 * typical * len(durations):
        message = f"lasts {inner[odd]} s, the typical frame {typical} s; only the last frame may last 0"
        raise at.error(message, place=f"frame {odd}")
    times = np.concatenate(([0.0], np.cumsum(inner)))[: len(durations)] / typical
    whole = round(1 / typical)  # durations are printed with six digits: 0.033332 is 1/30
    return frame_rate(at, float(whole) if abs(typical * whole - 1) < 1e-3 else 1 / typical, "frame 0"), times


def _rotations(at: Location, quaternions: np.ndarray, names: tuple[str, ...], off: float) -> torch.Tensor:
    """Matrices (T, J, 3, 3) of quaternions (T, J, 4), w first, of about length 1."""
    length = np.linalg.norm(quaternions, axis=-1)
    if len(bad := np.argwhere(np.abs(length - 1) > off)):
        frame, joint = bad[0]
        raise at.error(f"quaternion of length {length[frame, joint]:.3g}", place=f"frame {frame}, {names[joint]}")
    return rotation.quaternion_to_matrix(torch.from_numpy(quaternions / length[..., None]))
