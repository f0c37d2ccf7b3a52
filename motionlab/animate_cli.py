"""The animator's commands: ``inbetween``, ``repair``, ``complete`` and ``generate``, each a motion file in and out."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab.errors import DataError

if TYPE_CHECKING:
    from motionlab.animate import Animated
    from motionlab.motion import Motion

_METHODS = ("network", "curves", "nearest")
_WRITERS = {".bvh": "bvh", ".npz": "amass", ".glb": "gltf"}


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Adds the four commands; nothing heavy is imported before one runs."""
    command = _command(commands, "inbetween", "frames between keys, which stay as they are", _inbetween)
    command.add_argument("--keys", required=True, help="frames that stay, from 0: 0,45,90 or 0-20,60-last")
    command.add_argument("--joints", type=_words, default=[], help="joints that stay in all frames, as left_wrist,arms")
    command.add_argument("--method", choices=_METHODS, help="default: what is measured best for the longest gap")

    command = _command(commands, "repair", "a motion without glitches and noise", _repair)
    command.add_argument(
        "--noise", type=_noise, metavar="auto|DEGREES[,MM]", help="of joints and root (default: auto, as measured)"
    )
    command.add_argument("--method", choices=_METHODS[:2], default="network", help="default: network")

    command = _command(commands, "complete", "joints that are missing or wrong", _complete)
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("--hidden", type=_words, help="joints to make: legs, left_arm, right_knee, ...; others stay")
    which.add_argument("--known", type=_words, help="joints whose places alone are known: left_wrist,head, ...")
    command.add_argument("--method", choices=("network", "nearest"), default="network", help="default: network")

    command = commands.add_parser("generate", help="new motions, or what may follow on one")
    command.add_argument("--seconds", type=float, default=4.0, help="of each (default 4)")
    command.add_argument("--count", type=int, default=1, help="how many, each from its own seed (default 1)")
    command.add_argument("--start", type=Path, metavar="IN", help="a motion to go on from, which stays as it is")
    command.add_argument("--format", choices=[s[1:] for s in _WRITERS], help="default: that of --start, or bvh")
    command.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    _usual(command, _generate)


def _command(commands: argparse._SubParsersAction, name: str, text: str, run: Callable) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text)
    command.add_argument("source", metavar="IN", type=Path, help=".bvh .amc .npz .glb, or DeepMimic's .txt")
    command.add_argument("--out", type=Path, required=True, help="the same format keeps the file's own numbers")
    _usual(command, run)
    return command


def _usual(command: argparse.ArgumentParser, run: Callable) -> None:
    command.add_argument("--seed", type=int, default=0, help="of what is drawn at random (default 0)")
    command.add_argument("--no-planting", dest="plant", action="store_false", help="leave sliding feet alone")
    command.add_argument("--unit", choices=("m", "cm", "mm", "inch"), help="of a .bvh (default: detected)")
    command.add_argument("--up", choices=("y", "z"), help="of a .bvh: the axis that points up (default: detected)")
    command.set_defaults(run=run)


def _words(text: str) -> list[str]:
    return [word for word in text.split(",") if word.strip()]


def _noise(text: str) -> tuple[float, float] | None:
    """Degrees and millimetres; None for auto."""
    if text == "auto":
        return None
    try:
        degrees, _, mm = text.partition(",")
        return float(degrees), float(mm or 5 * float(degrees))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected auto or degrees[,millimetres], got {text!r}") from None


def _key_frames(text: str, frames: int, place: str = "--keys") -> set[int]:
    """Reads frame numbers such as ``0,45,60-last`` of a motion of so many frames, from what ``place`` names.

    Raises:
        DataError: what is no number or range; names it.
    """
    found: set[int] = set()
    for word in filter(None, text.replace(" ", "").split(",")):
        ends = [
            frames - 1 if end == "last" else int(end) if end.isdecimal() and len(end) < 10 else None
            for end in word.split("-")
        ]
        if None in ends or len(ends) > 2 or ends[0] > ends[-1]:
            remedy = "write frames from 0 and ranges, as 0,45,60-last"
            raise DataError(f"{word!r} is no frame", place=place, remedy=remedy)
        if ends[-1] >= frames:
            raise DataError(f"no frame {ends[-1]}", place=place, remedy=f"give numbers from 0 to {frames - 1}")
        found |= set(range(ends[0], ends[-1] + 1))
    if not found:
        raise DataError("no frame is kept", place=place, remedy="write frames from 0, as 0,45,last")
    return found


def _load(path: Path, options: argparse.Namespace) -> Motion:
    """Reads the motion that a command works on.

    Raises:
        DataError: not a readable motion, or an option that is for another format.
    """
    from motionlab import io

    guided = {key: value for key in ("unit", "up") if (value := getattr(options, key)) is not None}
    if guided and path.suffix.lower() != ".bvh":
        raise DataError("its unit and axes are known", path=path, remedy="--unit and --up are for .bvh only")
    return io.load(path, **guided)


def _save(source: Path | None, target: Path, loaded: Motion | None, made: Motion) -> str:
    """Writes a motion, into a copy of the file it came from where the format is the same; says which it was.

    Raises:
        DataError: a format that cannot be written.
    """
    from importlib import import_module

    from motionlab.io import rewriting

    suffix = target.suffix.lower()
    if suffix not in _WRITERS:
        raise DataError("cannot write this format", path=target, remedy=f"use one of {', '.join(_WRITERS)}")
    grown = loaded is not None and made.frames > loaded.frames
    same = source is not None and suffix == source.suffix.lower() and not (grown and suffix == ".glb")
    if same and rewriting.rewritable(source):
        rewriting.rewrite(source, target, loaded, made)
        return "what did not change has the file's own numbers, byte for byte"
    if suffix == ".npz" and len(made.skeleton) != 22:
        raise DataError("AMASS has 22 joints of its own", path=target, remedy="write a .bvh, and convert that")
    import_module(f"motionlab.io.{_WRITERS[suffix]}").save(target, made)
    return "written anew, its numbers rounded as the format does (in a BVH to 1e-8 m and 1e-6 degrees)"


def _done(source: Path | None, target: Path, loaded: Motion | None, found: Animated) -> int:
    said = _save(source, target, loaded, found.motion)
    for note in (*found.notes, said):
        print(f"note: {note}")
    made = found.motion
    print(f"{target}: {made.frames} frames at {made.fps:g} fps, {len(made.skeleton)} joints")
    return 0


def _inbetween(options: argparse.Namespace) -> int:
    from motionlab import animate

    motion = _load(options.source, options)
    keep = animate.kept(motion, _key_frames(options.keys, motion.frames), options.joints)
    how = {"method": options.method, "seed": options.seed, "plant": options.plant, "progress": True}
    return _done(options.source, options.out, motion, animate.inbetween(motion, keep, **how))


def _repair(options: argparse.Namespace) -> int:
    from motionlab import renew
    from motionlab.diffusion.denoising import Noise

    motion = _load(options.source, options)
    noise = None if options.noise is None else Noise.of(options.noise[0], options.noise[1] / 10)
    how = {"method": options.method, "seed": options.seed, "plant": options.plant, "progress": True}
    return _done(options.source, options.out, motion, renew.repaired(motion, noise, **how))


def _complete(options: argparse.Namespace) -> int:
    from motionlab import animate, renew

    motion = _load(options.source, options)
    how = {"method": options.method, "seed": options.seed, "plant": options.plant}
    if options.known:
        found = renew.posed(motion, options.known, **how)
    else:
        found = animate.completed(motion, options.hidden or [], progress=True, **how)
    return _done(options.source, options.out, motion, found)


def _generate(options: argparse.Namespace) -> int:
    from motionlab import renew

    start = _load(options.start, options) if options.start else None
    suffix = f".{options.format}" if options.format else options.start.suffix.lower() if options.start else ".bvh"
    suffix = suffix if suffix in _WRITERS else ".bvh"
    if options.count < 1:
        raise DataError(f"{options.count} motions", place="--count", remedy="give a number above 0")
    options.out.mkdir(parents=True, exist_ok=True)
    for k in range(options.count):  # each is on disk before the next is begun
        found = renew.generated(options.seconds, start=start, seed=options.seed + k, plant=options.plant)
        _done(options.start, options.out / f"generated_{options.seed + k}{suffix}", start, found)
    return 0


def editor(path: Path | str, backend: str | None = None, **guided: str):
    """Builds the widget of ``inbetween`` for a file: see ``viz.keyframes.keyframe_editor``. guided: unit, up of a BVH.

    Raises:
        DataError: not a readable motion.
    """
    from motionlab import animate
    from motionlab.viz.keyframes import keyframe_editor

    path = Path(path).resolve()
    motion = _load(path, argparse.Namespace(unit=guided.get("unit"), up=guided.get("up")))

    def read(keys: str) -> set[int]:
        return _key_frames(keys, motion.frames, "frames kept")

    def fill(frames: set[int], joints: list[str], method: str) -> tuple[Motion, tuple[str, ...]]:
        found = animate.inbetween(motion, animate.kept(motion, frames, joints), method=method or None)
        return found.motion, found.notes

    def export(made: Motion, name: str) -> str:
        target = Path(name).resolve()
        if target == path:  # what is kept is read from there at each export
            raise DataError("this is the file that was opened", path=name, remedy="give another name")
        return f"{target} is written: {_save(path, target, motion, made)}"

    joints = (*animate.GROUPS, *motion.skeleton.names)
    how = {"joints": joints, "methods": _METHODS, "target": f"{path.stem}_inbetween{path.suffix}", "backend": backend}
    return keyframe_editor(motion, read, fill, export, **how)
