"""The animator's commands: ``inbetween``, ``repair`` and ``complete`` of a motion file or a folder of them, and
``generate``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab.commands import many
from motionlab.commands.many import Job
from motionlab.commands.motions import WRITTEN, add_axes, read_motion
from motionlab.commands.printing import is_watched
from motionlab.errors import DataError

if TYPE_CHECKING:
    from motionlab.animate import Animated
    from motionlab.motion import Motion

_METHODS = ("network", "curves", "nearest")
_READ = f"a motion: {' '.join(WRITTEN)}, or .amc and DeepMimic's .txt, which are read, not written"
_OUT = f"{' '.join(WRITTEN)}; the format of IN keeps the file's own numbers; of a folder: another folder"


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
    command.add_argument("--method", choices=_METHODS[:2], help="default: network; for jumps as of inbetween")

    command = _command(commands, "complete", "joints that are missing or wrong", _complete)
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("--hidden", type=_words, help="joints to make: legs, left_arm, right_knee, ...; others stay")
    which.add_argument("--known", type=_words, help="joints whose places alone are known: left_wrist,head, ...")
    command.add_argument("--method", choices=("network", "nearest"), default="network", help="default: network")

    command = commands.add_parser("generate", help="new motions, or what may follow on one")
    command.add_argument("--seconds", type=float, default=4.0, help="of each (default 4)")
    command.add_argument("--count", type=int, default=1, help="how many, each from its own seed (default 1)")
    command.add_argument("--start", type=Path, metavar="IN", help="a motion to go on from, which stays as it is")
    command.add_argument("--format", choices=[s[1:] for s in WRITTEN], help="default: that of --start, or bvh")
    command.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    command.set_defaults(run=_generate)
    _usual(command)


def _command(commands: argparse._SubParsersAction, name: str, text: str, make: Callable) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text)
    command.add_argument("source", metavar="IN", type=Path, help=f"{_READ}, or a folder: of it all {' '.join(WRITTEN)}")
    command.add_argument("--out", type=Path, required=True, help=_OUT)
    many.add_sharing(command, "of a folder")
    command.set_defaults(make=make, run=_on_motions)
    _usual(command)
    return command


def _usual(command: argparse.ArgumentParser) -> None:
    command.add_argument("--seed", type=int, default=0, help="of what is drawn at random (default 0)")
    command.add_argument("--no-planting", dest="plant", action="store_false", help="leave sliding feet alone")
    add_axes(command)


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


def _on_motions(options: argparse.Namespace) -> int:
    """Runs a command on one motion, or on every motion of a folder."""
    if not options.source.is_dir():
        if options.jobs is not None or options.cluster is not None:
            remedy = "give a folder of motions"
            raise DataError("one motion is not shared out", place="--jobs, --cluster", remedy=remedy)
        for note in _make((options.source.name, options.source, None, options.out), options, progress=is_watched()):
            print(f"note: {note}")
        print(f"{options.out}: written")
        return 0
    if options.out.suffix.lower() in WRITTEN:
        raise DataError("a folder of motions goes into a folder", path=options.out, remedy="name a folder")
    if options.out.exists() and options.out.samefile(options.source):
        raise DataError("the motions would be written over", path=options.out, remedy="name another folder")
    files = [path for path in options.source.iterdir() if path.is_file()]
    found = sorted(path for path in files if path.suffix.lower() in WRITTEN)
    if not found:
        raise DataError(f"no motion ({', '.join(WRITTEN)}) in this folder", path=options.source, remedy="name another")
    options.out.mkdir(parents=True, exist_ok=True)
    if len(found) < len(files):
        print(f"note: {len(files) - len(found)} of {len(files)} files were passed over: not {' '.join(WRITTEN)}")
    clips = [(path.name, path, None, options.out / path.name) for path in found]
    return many.run_clips(partial(_make, options=options), clips, _is_made, options)


def _is_made(clip: Job) -> bool:
    return clip[3].exists()


def _make(clip: Job, options: argparse.Namespace, progress: bool = False) -> list[str]:
    """Reads a motion, makes another of it, and writes that; says how."""
    from motionlab.io.rewriting import check_target, write_back

    _, source, _, target = clip
    check_target(source, target)
    motion = read_motion(source, options)
    found = options.make(options, motion, progress)
    return [*found.notes, write_back(source, target, motion, found.motion)]


def _inbetween(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab import animate

    keep = animate.kept(motion, animate.frames_named(options.keys, motion.frames), options.joints)
    how = {"method": options.method, "seed": options.seed, "plant": options.plant}
    return animate.inbetween(motion, keep, progress=progress, **how)


def _repair(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab import renew
    from motionlab.diffusion.denoising import Noise

    noise = None if options.noise is None else Noise.of(options.noise[0], options.noise[1] / 10)
    how = {"method": options.method, "seed": options.seed, "plant": options.plant}
    return renew.repaired(motion, noise, progress=progress, **how)


def _complete(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab import animate, renew

    how = {"method": options.method, "seed": options.seed, "plant": options.plant}
    if options.known:
        return renew.posed(motion, options.known, **how)
    return animate.completed(motion, options.hidden or [], progress=progress, **how)


def _generate(options: argparse.Namespace) -> int:
    from motionlab import renew
    from motionlab.io.rewriting import write_back

    start = read_motion(options.start, options) if options.start else None
    suffix = f".{options.format}" if options.format else options.start.suffix.lower() if options.start else ".bvh"
    suffix = suffix if suffix in WRITTEN else ".bvh"
    if options.count < 1:
        raise DataError(f"{options.count} motions", place="--count", remedy="give a number above 0")
    options.out.mkdir(parents=True, exist_ok=True)
    for k in range(options.count):  # each is on disk before the next is begun
        found = renew.generated(options.seconds, start=start, seed=options.seed + k, plant=options.plant)
        target = options.out / f"generated_{options.seed + k}{suffix}"
        for note in (*found.notes, write_back(options.start, target, start, found.motion)):
            print(f"note: {note}")
        print(f"{target}: {found.motion.frames} frames at {found.motion.fps:g} fps")
    return 0
