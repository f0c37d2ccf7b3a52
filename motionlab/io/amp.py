"""AMP clips of IsaacGymEnvs: poselib's arrays, converted to npz; any skeleton, quaternions x first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from motionlab import rotation
from motionlab.io.reading import Spot, frame_rate, numbers, read_npz, reading
from motionlab.motion import Motion
from motionlab.skeleton import Skeleton

_KEYS = ("node_names", "parent_indices", "local_translation", "root_translation", "fps", "is_local")
_ROTATION = "local_or_global_rotation_xyzw"


def load(path: str | Path) -> Motion:
    """Read an AMP clip: metres, z up, the file's own skeleton (x forward, y left, z up at rest).

    Rotations are against the parent where ``is_local`` is true, else against the world and are made
    local: R_local = R_parent^T R.

    Raises:
        DataError: not such a file; names the key.
    """
    with reading(path, "convert the poselib file again, with all its keys") as at:
        arrays = read_npz(at)
        missing = [key for key in (_ROTATION, *_KEYS) if key not in arrays]
        if missing:
            raise at.error(
                f"missing {', '.join(missing)}; found {', '.join(sorted(arrays)) or 'nothing'}", place="keys"
            )
        skeleton = _skeleton(at, arrays)
        quaternion = numbers(at, arrays[_ROTATION], f"T {len(skeleton)} 4", place=_ROTATION)
        root = numbers(at, arrays["root_translation"], f"{len(quaternion)} 3", place="root_translation")
        length = np.linalg.norm(quaternion, axis=-1)
        if (np.abs(length - 1) > 0.05).any():
            frame, joint = np.argwhere(np.abs(length - 1) > 0.05)[0]
            place = f"{_ROTATION}, frame {frame}, {skeleton.names[joint]}"
            raise at.error(f"quaternion of length {length[frame, joint]:.3g}, expected 1", place=place)
        wxyz = torch.from_numpy((quaternion / length[..., None])[..., [3, 0, 1, 2]])
        rot = rotation.quaternion_to_matrix(wxyz)
        is_local = arrays["is_local"]
        if is_local.size != 1 or is_local.dtype.kind not in "biu":
            raise at.error(f"expected true or false, got {is_local!r}", place="is_local")
        if not is_local.item():
            rot[:, 1:] = rot[:, list(skeleton.parents[1:])].mT @ rot[:, 1:]
        fps = frame_rate(at, arrays["fps"], "fps")
        return Motion(skeleton, torch.from_numpy(root).float(), rot.float(), fps, name=at.path.stem)


def _skeleton(at: Spot, arrays: dict[str, np.ndarray]) -> Skeleton:
    names = arrays["node_names"]
    if names.ndim != 1 or names.dtype.kind != "U" or len(set(names.tolist())) != names.size or not names.size:
        raise at.error("expected a list of different names", place="node_names")
    parents = numbers(at, arrays["parent_indices"], f"{names.size}", place="parent_indices").astype(int).tolist()
    if any(not (-1 <= p < j) or (p == -1) != (j == 0) for j, p in enumerate(parents)):
        raise at.error(f"one root first, then parents before children; got {parents}", place="parent_indices")
    offsets = numbers(at, arrays["local_translation"], f"{names.size} 3", place="local_translation")
    return Skeleton(tuple(names.tolist()), tuple(parents), torch.from_numpy(offsets).float())
