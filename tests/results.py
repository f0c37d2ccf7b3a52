"""Made-up results of systems that find people in videos, as these write them: GVHMR, WHAM, TRAM, PHALP, AIST++."""

import io
import pickle
import zlib
from collections import defaultdict

import numpy as np
import torch

from motionlab import rotation
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT

#: A file's axes from the world's: y up, and of a camera that looks along y.
Y_UP, CAMERA = UPRIGHT.T.double(), torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()


def person(frames: int = 6, seed: int = 4) -> Motion:
    draw = torch.Generator().manual_seed(seed)
    rot = rotation.exp(0.2 * torch.randn(frames, 22, 3, generator=draw))
    rot[:, 0] = UPRIGHT @ rot[:, 0]
    return Motion(STANDARD, torch.tensor([0.3, 2.0, 0.93]) + 0.02 * torch.arange(frames)[:, None], rot, 30.0)


def parameters(axes: torch.Tensor, motion: Motion | None = None) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
    """Axis-angle (T, 66), translations (T, 3) and matrices (T, 22, 3, 3), in a file's axes."""
    motion = motion or person()
    rot = motion.rot.double().clone()
    rot[:, 0] = axes @ rot[:, 0]
    turns = rotation.matrix_to_axis_angle(rot).flatten(1)
    return turns.float().numpy(), (motion.root.double() @ axes.T).float().numpy(), rot.float()


def gvhmr(motion: Motion | None = None) -> bytes:
    turns, trans, _ = (torch.as_tensor(x) for x in parameters(Y_UP, motion))
    body = {"global_orient": turns[:, :3], "body_pose": turns[:, 3:], "transl": trans}
    body["betas"] = torch.zeros(len(turns), 10)
    away = {key: value + 7 for key, value in body.items()}
    camera = torch.eye(3).expand(len(turns), 3, 3)
    stream = io.BytesIO()
    torch.save({"smpl_params_global": body, "smpl_params_incam": away, "K_fullimg": camera}, stream)
    return stream.getvalue()


def tram() -> bytes:
    _, trans, rot = parameters(CAMERA)
    whole = torch.cat((rot, torch.eye(3).expand(6, 2, 3, 3)), 1)
    tree = {"pred_rotmat": whole, "pred_trans": torch.from_numpy(trans)[:, None], "pred_shape": torch.zeros(6, 10)}
    stream = io.BytesIO()
    np.save(stream, tree, allow_pickle=True)
    return stream.getvalue()


def aist() -> bytes:
    turns, trans, _ = parameters(Y_UP)
    poses = np.concatenate((turns, np.zeros((6, 6))), 1)
    return pickle.dumps({"smpl_poses": poses, "smpl_trans": 93 * trans, "smpl_scaling": np.array([93.0])})


def wham(people=((4, 3), (9, 6))) -> bytes:
    results = defaultdict(dict)
    for name, frames in people:
        turns, trans, _ = parameters(Y_UP, person(frames))
        hands = np.zeros((frames, 6), np.float32)
        pose = np.concatenate((turns, hands), 1)
        results[name] = {"pose": pose + 5, "trans": trans + 5, "pose_world": pose, "trans_world": trans}
        results[name] |= {"betas": np.zeros((frames, 10)), "frame_ids": np.arange(frames)}
    return as_joblib(results)


def phalp(packed: bool = True) -> bytes:
    """4DHumans' tracks: a dictionary a frame, in it everybody; one comes in the third frame, and is unseen in one."""
    tree = {}
    for t in range(6):
        frame = tree[f"img/{t:06}.jpg"] = {key: [] for key in ("tid", "smpl", "camera", "tracked_time", "mask")}
        frame["time"] = t
        for who, since in ((7, 0), (3, 2)):
            _, trans, rot = parameters(CAMERA, person(seed=4 + since))
            hands = torch.eye(3).expand(2, 3, 3)
            body = {"global_orient": rot[t, :1].numpy(), "body_pose": torch.cat((rot[t, 1:], hands)).numpy()}
            if t >= since:
                frame["tid"].append(np.int64(who) if since else who)
                frame["smpl"].append(body | {"betas": np.zeros(10, np.float32)})
                frame["camera"].append(trans[t])
                frame["tracked_time"].append(int(since > 0 and t == 4))
                frame["mask"].append({"size": [4, 4], "counts": b"04"})
    return zlib.compress(as_joblib(tree), 3) if packed else as_joblib(tree)


def as_joblib(tree: object) -> bytes:
    """What joblib.dump writes: a pickle in which each array is a record, then padding to 16 bytes, then its numbers."""
    stream, arrays = io.BytesIO(), []

    class Pickler(pickle._Pickler):
        def save(self, thing, *rest):
            if not isinstance(thing, np.ndarray):
                return super().save(thing, *rest)
            self.write(pickle.GLOBAL + b"joblib.numpy_pickle\nNumpyArrayWrapper\n" + pickle.EMPTY_TUPLE + pickle.NEWOBJ)
            record = {"subclass": np.ndarray, "shape": thing.shape, "order": "C", "dtype": thing.dtype}
            super().save(record | {"allow_mmap": True, "numpy_array_alignment_bytes": 16})
            self.write(pickle.BUILD)
            self.framer.commit_frame(force=True)
            padding = 16 - (stream.tell() + 1) % 16
            stream.write(bytes([padding]) + b"\xff" * padding + thing.tobytes())
            arrays.append(thing)

    Pickler(stream, protocol=4).dump(tree)
    assert arrays
    return stream.getvalue()
