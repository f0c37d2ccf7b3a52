"""Writes a changed motion back into the file that it came from: what did not change stays, byte for byte.

A rotation or root position that equals the loaded one keeps the numbers, the channel order, unit and axes of the file;
whatever else the file holds (End Sites, betas, a skin) stays. Frames may be added behind the last one; a BVH may
also have fewer, and another frame rate; a GLB in other frames gets one more animation.
"""

import io
from contextlib import suppress
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import humanml, rotation
from motionlab.errors import DataError
from motionlab.files import write_whole
from motionlab.io import bvh, gltf, smpl
from motionlab.io.judging import UNITS
from motionlab.io.reading import Location, read_npz, read_text, reading
from motionlab.motion import Motion, single
from motionlab.rest import reframed
from motionlab.retarget import retarget
from motionlab.skeleton import STANDARD

_REMEDY = "name an --out of another format, which is written anew"


def _changed(loaded: Motion, made: Motion) -> tuple[Tensor, Tensor]:
    """Returns where rotations (T, J) and root places (T,) are not bit for bit those of ``loaded``; new frames are."""
    loaded = loaded.cut(0, made.frames)
    rot, root = torch.ones(made.rot.shape[:2], dtype=torch.bool), torch.ones(made.frames, dtype=torch.bool)
    rot[: loaded.frames] = (made.rot[: loaded.frames] != loaded.rot).any(-1).any(-1)
    root[: loaded.frames] = (made.root[: loaded.frames] != loaded.root).any(-1)
    return rot, root


def _base(loaded: Motion, made: Motion, turn: Tensor, place: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Local rotations (T, J, 3, 3) and root places (T, 3) of ``made`` as the file counts them, float64.

    turn (T, 3, 3), place (T, 3): of the root joint in the file, against what is above it. What is above, axes and
    unit follow from the loaded motion: rot_0 = B turn, root = C + scale B place. New frames go by the last one.
    """
    above = loaded.rot[:, 0].double() @ turn.mT
    origin = loaded.root.double() - scale * (above @ place[..., None])[..., 0]
    at = torch.arange(made.frames).clamp(max=loaded.frames - 1)
    rot = made.rot.double().clone()
    rot[:, 0] = above[at].mT @ rot[:, 0]
    root = (above[at].mT @ (made.root.double() - origin[at])[..., None])[..., 0] / scale
    return rot, root


def _averaged(loaded: Motion) -> list[str]:
    """Joints whose bones change their length in the file, which are read at their mean places."""
    said = (note.partition(" moves ") for note in loaded.notes if note.endswith(": its mean place is kept"))
    return [name for name, _, _ in said if name in loaded.skeleton.names]


def _bvh(at: Location, loaded: Motion, made: Motion) -> bytes:
    text = read_text(at)
    joints, values, _ = bvh._parse(at, text)  # what it notes was said when the file was loaded
    place, turns, relative = bvh._local(joints, values)
    names = [joint.name for joint in joints]
    index = [names.index(name) for name in loaded.skeleton.names]
    lengths = loaded.skeleton.offsets[1:].norm(dim=-1).double().sum()
    scale = float(lengths / np.linalg.norm(place.mean(0)[index[1:]], axis=-1).sum())
    scale = next((unit for unit in UNITS.values() if abs(scale / unit - 1) < 1e-4), scale)
    top = index[0]
    rigid, means = _averaged(loaded), values.mean(0)
    rot, root = _base(loaded, made, turns[:, top], torch.from_numpy(place[:, top]), scale)
    new_rot, new_root = _changed(loaded, made)
    table = values[np.arange(made.frames).clip(max=loaded.frames - 1)]
    mine, turned = np.zeros(table.shape, dtype=bool), {}
    for k, i in enumerate(index):
        (order, where), rows = joints[i].turns, new_rot[:, k].numpy()
        if order and rows.any():
            table[np.ix_(rows, where)] = torch.rad2deg(rotation.matrix_to_euler(rot[rows, k], order)).numpy()
            mine[np.ix_(rows, where)] = True
            turned[tuple(where)] = order
        elif rows[: loaded.frames].any() and not joints[i].is_end:
            raise at.error(f"{names[i]} has no rotation channels", place=names[i])
        if names[i] in rigid:
            where = [*joints[i].moves.values()]
            table[:, where], mine[:, where] = means[where], True
    moving = joints[top].moves
    if new_root[: loaded.frames].any() and len(moving) < 3:
        raise at.error(f"{names[top]} has no position channels", place=names[top])
    if top in relative:
        root = root - torch.tensor(joints[top].offset).double()
    for axis, column in moving.items():
        table[new_root.numpy(), column] = root[new_root, axis].numpy()
        mine[new_root.numpy(), column] = True
    if turned:
        where = np.array(list(turned))
        proper = np.array([order[0] == order[2] for order in turned.values()])
        table[:, where] = _carried_on(table[:, where], mine[:, where[:, 0]], proper, values[0, where])
    return _bvh_text(text, table, mine, None if made.fps == loaded.fps else made.fps).encode(at.encoding)


def _carried_on(angles: np.ndarray, mine: np.ndarray, proper: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Euler angles (T, K, 3) in degrees, those that are ``mine`` (T, K) as near as may be to the frame before.

    Each turn has two solutions, (a, b, c) and (a + 180, 180 - b, c + 180), the middle one -b where the outer axes are
    the same, ``proper`` (K,); and whole turns. What comes before the first frame that stays goes by the frame behind
    it; joints of which nothing stays begin near ``first`` (K, 3).
    """
    other = angles + 180.0
    other[..., 1] = np.where(proper, 0.0, 180.0) - angles[..., 1]
    both, made = np.stack((angles, other)), angles.copy()

    def nearest(t: int, beside: np.ndarray) -> np.ndarray:
        options = both[:, t] + 360 * np.round((beside - both[:, t]) / 360)
        off = np.abs(options - beside).sum(-1)
        return np.where((off[1] < off[0])[:, None], options[1], options[0])

    early = np.logical_and.accumulate(mine) & ~mine.all(0)
    late = mine & ~early
    for t in np.flatnonzero(late.any(1)):
        made[t] = np.where(late[t, :, None], nearest(t, made[t - 1] if t else first), made[t])
    for t in np.flatnonzero(early.any(1))[::-1]:
        made[t] = np.where(early[t, :, None], nearest(t, made[t + 1]), made[t])
    return made


def _bvh_text(text: str, table: np.ndarray, mine: np.ndarray, fps: float | None) -> str:
    """The file's text with new numbers where ``mine``, and its own line ends; lines without one as they are.

    fps: None: the file's.
    """
    lines = text.splitlines(keepends=True)
    start = next(n for n, line in enumerate(lines) if line.split()[:1] and line.split()[0].upper() == "MOTION")
    rows = [n for n in range(start + 1, len(lines)) if lines[n].strip()]
    heading, rows, gone = rows[:2], rows[2 : 2 + len(table)], rows[2 + len(table) :]
    end, frames = lines[start].removeprefix(lines[start].rstrip("\r\n")), len(rows)
    words = [lines[n].split() for n in rows]
    words += words[-1:] * (len(table) - frames)
    found = [
        " ".join(f"{x:.6f}" if new else w for w, x, new in zip(old, row, its, strict=True))
        for old, row, its in zip(words, table, mine, strict=True)
    ]
    for n, line, its in zip(rows, found, mine, strict=False):
        lines[n] = line + lines[n].removeprefix(lines[n].rstrip("\r\n")) if its.any() else lines[n]
    if float(lines[heading[0]].partition(":")[2]) != len(table):
        lines[heading[0]] = f"Frames: {len(table)}{end}"
    if fps is not None:
        lines[heading[1]] = f"Frame Time: {1 / fps:.10f}{end}"
    if len(table) > frames:
        lines[rows[-1]] = lines[rows[-1]].rstrip("\r\n") + end
        lines[rows[-1] + 1 : rows[-1] + 1] = [line + end for line in found[frames:]]
    for n in gone:
        lines[n] = ""
    return "".join(lines)


def _npz(at: Location, loaded: Motion, made: Motion) -> bytes | None:
    places, moving = _smpl_keys(read_npz(at, smpl._KEYS))
    count = loaded.frames
    if not places or made.fps != loaded.fps or made.frames < count:
        return None
    arrays = {k: np.array(x, order="C") for k, x in read_npz(at).items()}
    for key in {moving, "contacts", *(key for key, _ in places), "pose_jaw", "pose_eye", "pose_hand"} & arrays.keys():
        if len(arrays[key]) == count:
            arrays[key] = np.concatenate((arrays[key], np.repeat(arrays[key][-1:], made.frames - count, 0)))
    table = {key: arrays[key].reshape(len(arrays[key]), -1) for key in {moving, *(key for key, _ in places)}}
    first, root = (torch.from_numpy(table[key][:count, :3].astype(np.float64)) for key in (places[0][0], moving))
    rot, root = _base(loaded, made, rotation.axis_angle_to_matrix(first), root, 1.0)
    new_rot, new_root = (x.numpy() for x in _changed(loaded, made))
    turns = rotation.matrix_to_axis_angle(rot).numpy()
    for j, (key, column) in enumerate(places):
        table[key][new_rot[:, j], column : column + 3] = turns[new_rot[:, j], j]
    table[moving][new_root] = root.numpy()[new_root]
    if "contacts" in arrays and made.contacts is not None:
        rows = new_rot.any(1) | new_root
        arrays["contacts"][rows] = made.contacts.numpy()[rows]
    archive = io.BytesIO()
    np.savez_compressed(archive, **arrays)
    return archive.getvalue()


def _smpl_keys(arrays: dict[str, np.ndarray]) -> tuple[list[tuple[str, int]], str]:
    """Where the axis-angle of each joint lies, as key and first column, and the key of the translation; else none."""
    whole, root, parts, moving = smpl.keys_of(arrays)
    split = [(root, 0), *((parts, 3 * j) for j in range(smpl.BODY - 1))]
    places = [(whole, 3 * j) for j in range(smpl.BODY)] if whole else split
    used = {key for key, _ in places} | {moving}
    several = moving and arrays[moving].ndim == 3 and arrays[moving].shape[1] > 1
    if "" in used or several or "smpl_scaling" in arrays or any(arrays[key].shape[-2:] == (3, 3) for key in used):
        return [], ""
    return places, moving


def _glb(at: Location, loaded: Motion, made: Motion) -> bytes:
    content, blob = gltf._chunks(at)
    person, number = _of_whom(at, content, loaded)
    found = gltf._figure(at, content, blob, person, number, None)
    index = found.skeleton.indices(loaded.skeleton.names)
    if len(found.times) != loaded.frames:
        raise at.error("read at other times than those of its keys", place="times")
    # what turns in the pose in which the mesh is bound, back to what the file's nodes turn by
    frames, nodes = found.frames[index], [found.joints[k] for k in index]
    doubles = (motion.to(torch.float64) for motion in (loaded, made))
    before, after = (replace(m, rot=reframed(m.skeleton, m.rot, frames.mT)[1]) for m in doubles)
    offsets = (loaded.skeleton.offsets[1:], found.skeleton.offsets[index[1:]])
    ours, its = (float(x.double().norm(dim=-1).sum()) for x in offsets)
    scale = ours / its if its else 1.0
    scale = float(found.sizes[index[0]]) * (1.0 if abs(scale - 1) < 1e-4 else scale)
    rigid, (new_rot, new_root) = _averaged(loaded), _changed(loaded, made)
    keys, still, at_frame = {}, {}, torch.arange(made.frames).clamp(max=loaded.frames - 1)
    for k, node in enumerate(nodes):
        place, turn, size, _ = gltf._local(at, content["nodes"][node], node, found.tracks, found.times)
        still |= {(node, "translation"): place[:1], (node, "scale"): size[None]}
        if k == 0:
            rot, root = _base(before, after, turn, place, scale)
            keys[node, "translation"] = torch.where(new_root[:, None], root, place[at_frame])
        elif loaded.skeleton.names[k] in rigid:
            keys[node, "translation"] = place.mean(0).expand(made.frames, 3)
        old = rotation.matrix_to_quaternion(turn[at_frame])[:, [1, 2, 3, 0]]
        if (values := found.tracks.get((node, "rotation"), (0, 0, old))[2]).shape == (loaded.frames, 4):
            old = torch.from_numpy(values)[at_frame]
        turned = rot[:, 0] if k == 0 else (turn @ before.rot[:, k].mT)[at_frame] @ after.rot[:, k]
        turned = rotation.matrix_to_quaternion(turned)[:, [1, 2, 3, 0]]
        keys[node, "rotation"] = rotation.unroll_quaternion(torch.where(new_rot[:, [k]], turned, old), dim=0)
    times, others = found.times, {key: values for key, (_, _, values) in found.tracks.items() if key not in keys}
    if anew := (made.frames, made.fps) != (loaded.frames, loaded.fps):
        if any(key not in still and np.ptp(values, 0).max() > 1e-4 for key, values in others.items()):
            raise at.error("what is above the joints is animated, too")
        times = torch.arange(made.frames, dtype=torch.float64) / made.fps
        keys |= {key: still.get(key, torch.from_numpy(values[:1])) for key, values in others.items()}
    animations = content.setdefault("animations", [])
    given = animations[number] if animations else {"samplers": [], "channels": []}
    file = gltf._Buffer()
    file.content, file.blob, file.samplers = content, bytearray(blob), [*given["samplers"]]
    file.channels = [c for c in given["channels"] if (c["target"].get("node"), c["target"]["path"]) not in keys]
    if file.channels and made.fps != loaded.fps:
        raise at.error("others are animated, at another rate")
    inputs = {n: file.add(times[:n], "f4", bounds=True) for n in {len(values) for values in keys.values()}}
    for (node, what), values in keys.items():
        file.move(node, what, inputs[len(values)], values)
    if anew:
        animations.insert(0, file.animation(made))
    else:
        animations[number] = given | {"samplers": file.samplers, "channels": file.channels}
    return file.glb()


def _of_whom(at: Location, content: dict, loaded: Motion) -> tuple[int, int | None]:
    """Which person and which animation of a GLB a motion is; no animation of one that has none."""
    people, animations = len(content.get("skins") or [0]), len(content.setdefault("animations", []))
    if not animations:
        return 0, None
    said = [k for k in range(people) if any(note.startswith(f"person {k} of") for note in loaded.notes)]
    for person, number in product(said or range(people), range(animations)):
        with suppress(DataError):  # of others
            one = gltf.load(at.path, person=person, animation=number, translations="mean")
            if one.skeleton.names == loaded.skeleton.names and one.rot.shape == loaded.rot.shape:
                if (one.rot[:, 1:] - loaded.rot[:, 1:].to(one.rot)).abs().max() < 1e-4:
                    return person, number
    raise at.error("read at other times than those of its keys", place="times")


WRITERS = {".bvh": bvh.save, ".npz": smpl.save_motion, ".glb": gltf.save, ".npy": humanml.save}
REWRITERS = {".bvh": _bvh, ".npz": _npz, ".glb": _glb}  #: the file's bytes; none where it cannot hold such a motion
_ANEW = {  # what is said of a file that is written anew
    ".bvh": "written anew, its numbers rounded to 1e-8 m and 1e-6 degrees",
    ".npz": "written anew as parameters of SMPL-H, in double precision",
    ".npy": "written anew as the places of 22 joints at 20 frames per second, as HumanML3D has them",
    ".glb": "written anew in single precision, as bones without a body (`convert` writes one with a body)",
}
#: What is said of a GLB in other frames.
_MORE = "the file's nodes and meshes stay; the motion is a new animation, the first, in single precision"


def check_target(source: str | Path | None, target: str | Path) -> None:
    """Checks that ``target`` can be what is made of ``source`` (None: of nothing).

    Raises:
        DataError: a format that cannot be written, or the file that is read.
    """
    target = Path(target)
    if target.suffix.lower() not in WRITERS:
        raise DataError("cannot write this format", path=target, remedy=f"use one of {', '.join(WRITERS)}")
    with suppress(OSError):  # one is not there, or has no name that can be
        if source is not None and target.samefile(source):  # what is kept is read from there at each export
            raise DataError("this is the file that was opened", path=target, remedy="give another name")


def write_back(source: str | Path | None, target: str | Path, loaded: Motion | None, made: Motion) -> str:
    """Writes what was made of a motion: where the format stays, into a copy of its file; says which it was.

    source, loaded: the file and the motion that was read from it; None where there is none.

    Raises:
        DataError: a target that cannot be (:func:`check_target`), or for an .npz a skeleton of unknown joints.
    """
    check_target(source, target)
    suffix, lost = Path(target).suffix.lower(), _left_behind(source)
    if source is not None and suffix == Path(source).suffix.lower() and suffix in REWRITERS:
        single(made, target)
        try:
            with reading(source, _REMEDY) as at:
                if made.skeleton.names != loaded.skeleton.names:
                    raise at.error("not the motion of this file")
                content = REWRITERS[suffix](at, loaded, made)
            if content is not None:
                write_whole(target, content)
                changed = (made.frames, made.fps) != (loaded.frames, loaded.fps)
                return _MORE if changed and suffix == ".glb" else _stayed(loaded, made)
        except DataError as error:  # a GLB need not have a key for what changed in every frame
            if suffix != ".glb":
                raise
            lost += f"; it could not be kept, for {str(error).partition(' (remedy')[0]}"
    if suffix == ".npz":
        made, body = for_amass(made)
        lost += body and f"; {body}"
    if suffix == ".npy" and made.skeleton.names != STANDARD.names:
        made = retarget(made).motion
    WRITERS[suffix](target, made)
    return f"{_ANEW[suffix]}{lost}"


def _stayed(loaded: Motion, made: Motion) -> str:
    """Says how much of a rewritten file is as it was: frames, and joints that stay in frames that changed."""
    new, new_root = _changed(loaded, made)
    new[:, 0] |= new_root
    new[:, loaded.skeleton.indices(_averaged(loaded))] = True
    frames, joints = int((~new.any(1)).sum()), int((~new.any(0)).sum())
    if not frames and not joints:
        return "what the file says of its joints, channels, unit and axes stays, byte for byte; all numbers are new"
    also = f", and {joints} of {new.shape[1]} joints in all frames," if joints and frames < made.frames else ""
    return f"{frames} of {made.frames} frames{also} keep the file's own numbers, byte for byte"


def for_amass(motion: Motion) -> tuple[Motion, str]:
    """Puts a motion on the 22 standard joints, in their order and proportions, as AMASS files have it; says so.

    A motion that is there already is given back, with nothing to say.

    Raises:
        DataError: a skeleton whose joints are not known.
    """
    own = motion.skeleton
    if own.names == STANDARD.names and (own.offsets - STANDARD.offsets)[1:].abs().max() < 1e-4:
        return motion, ""
    leg = float(STANDARD.offsets[STANDARD.indices(["left_knee", "left_ankle"])].norm(dim=-1).sum())
    found = retarget(motion, proportions="standard", leg=leg)
    return found.motion, f"AMASS files hold no bone lengths: put on the standard body, {found.scale:.3f} times as large"


def _left_behind(source: str | Path | None) -> str:
    """Says what a file loses that is written anew: of a GLB the body, and what is beside the motion."""
    if source is None or Path(source).suffix.lower() not in (".glb", ".gltf"):
        return ""
    with reading(source) as at:
        content = gltf._chunks(at)[0]
    beside = {"meshes": (0, "the body"), "animations": (1, "the other animations"), "skins": (1, "the other people")}
    lost = [what for key, (least, what) in beside.items() if len(content.get(key) or ()) > least]
    verb = "is" if lost == ["the body"] else "are"
    return f"; {', '.join(lost)} of the file that was read {verb} lost" if lost else ""
