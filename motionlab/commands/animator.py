"""The animator's commands: ``inbetween``, ``repair``, ``complete``, ``plant``, ``cycle`` and ``retarget`` of a motion
file or a folder of them, and ``generate``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab.commands.motions import READ, WRITTEN, add_reading, make_folder, read_motion, say_note
from motionlab.commands.printing import add_command, add_sharing, is_watched
from motionlab.commands.showing import CUT, check_film, cut, draw_film
from motionlab.errors import DataError

if TYPE_CHECKING:
    from motionlab.animate.filling import Animated
    from motionlab.motion import Motion

_METHODS = ("network", "curves")
_IN = f"a motion ({READ}), or a folder: of it all {' '.join(WRITTEN)}"
_OUT = f"a file ({' '.join(WRITTEN)}; the format of IN keeps the file's own numbers), or for a folder another folder"
_DRAW = "draw one of the motions that are possible, by the network; none: its one answer, closest on average"


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Adds the commands; nothing heavy is imported before one runs."""
    add = partial(_command, commands)
    example = "walk.bvh --keys 0,30,60,90,120-last --out between.bvh --film between.mp4"
    command = add("inbetween", "keep the frames you name, make those between them", example, _inbetween, _DRAW)
    command.add_argument("--keys", required=True, help="frames that stay, from 0: 0,45,90 or 0-20,60-last")
    command.add_argument("--joints", type=_words, default=[], help="joints that stay in all frames, as left_wrist,arms")
    command.add_argument("--method", choices=_METHODS, help="default: what is measured best for the longest gap")

    option = add("repair", "take noise and jumps out of a motion", "walk.bvh --out repaired.bvh", _repair).add_argument
    option("--noise", type=_noise, metavar="auto|DEGREES[,MM]", help="of joints and root (default: auto, as measured)")
    option("--method", choices=_METHODS, help="default: network; for jumps as of inbetween")
    option("--drift", action="store_true", help="the path goes by the feet: of a walk seen on a video")

    example = "walk.bvh --hidden legs --out completed.bvh"
    command = add("complete", "make joints that are missing or wrong", example, _complete, _DRAW)
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("--hidden", type=_words, help="joints to make: legs, left_arm, right_knee, ...; others stay")
    which.add_argument("--known", type=_words, help="joints whose places alone are known: left_wrist,head, ...")

    add("plant", "hold feet that stand in place", "walk.bvh --out planted.bvh", _plant, plants=False)

    example = "walk.bvh --loop --cut 1.467 2.567 --out loop.bvh"
    command = add("cycle", "make a motion a loop, or let it go nowhere", example, _cycle)
    command.add_argument("--loop", action="store_true", help="its last frame is its first again; best cut to one round")
    command.add_argument("--in-place", action="store_true", help="the root stays above one point of the floor")
    command.add_argument("--cut", **CUT, help="only these seconds")
    command.add_argument("--blend", type=float, metavar="SECONDS", help="in which each end gives in (default: 0.25)")

    text, example = "put the movement of a motion on the rig of another", "walk.bvh --onto rig.bvh --out mine.bvh"
    option = add("retarget", text, example, None, plants=False).add_argument
    option("--onto", type=Path, required=True, metavar="RIG", help=f"its bones, names and rest pose: {READ}")
    option("--onto-names", type=Path, metavar="FILE.json", help="as --names, of RIG")

    text, example = "make new motions, or what may follow on one", "--seconds 4 --count 2 --out made/"
    command = add_command(commands, "generate", text, example, _generate)
    command.add_argument("--seconds", type=float, default=4.0, help="how long each is, or goes on (default 4)")
    command.add_argument("--count", type=int, default=1, help="how many, each from its own seed (default 1)")
    command.add_argument("--start", type=Path, metavar="IN", help="a motion to go on from, which stays as it is")
    command.add_argument("--format", choices=[s[1:] for s in WRITTEN], help="default: that of --start, or bvh")
    command.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    text = "also write a film: what was made, side by side"
    command.add_argument("--film", type=Path, metavar="FILE.mp4", help=text)
    _usual(command, "of the first (default 0)")


def _command(commands, name: str, text: str, example: str, make: Callable | None, *seed: str, plants: bool = True):
    command = add_command(commands, name, text, example, _on_motions)
    command.add_argument("source", metavar="IN", type=Path, help=_IN)
    command.add_argument("--out", type=Path, required=True, help=_OUT)
    text = "also write a film: what was given beside what was made of it; not of a folder"
    command.add_argument("--film", type=Path, metavar="FILE.mp4", help=text)
    add_sharing(command, "of a folder")
    command.set_defaults(make=make)
    _usual(command, *seed, plants=plants)
    return command


def _usual(command: argparse.ArgumentParser, seed: str = "", plants: bool = True) -> None:
    if seed:  # of what draws
        command.add_argument("--seed", type=_seed, help=seed)
    if plants:
        command.add_argument("--no-planting", dest="plant", action="store_false", help="leave sliding feet alone")
    add_reading(command)


def _words(text: str) -> list[str]:
    return [word for word in text.split(",") if word.strip()]


def _seed(text: str) -> int:
    if not text.isdecimal() or len(text) > 18:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0, of 18 digits at most, got {text!r}")
    return int(text)


def _noise(text: str) -> tuple[float, float] | None:
    """Degrees and millimetres; None for auto."""
    if text == "auto":
        return None
    degrees, _, mm = text.partition(",")
    try:
        size = float(degrees), float(mm or 5 * float(degrees))
    except ValueError:
        size = (-1.0,)
    if not all(0 <= part < 1000 for part in size):  # not a number is neither
        raise argparse.ArgumentTypeError(f"expected auto or degrees[,millimetres], from 0 to 1000, got {text!r}")
    return size


def _on_motions(options: argparse.Namespace) -> int:
    """Runs a command on one motion, or on every motion of a folder."""
    if not options.source.is_dir():
        if options.jobs is not None or options.cluster is not None:
            what, remedy = "one motion is not shared out", "give a folder of motions"
            raise DataError(what, place="--jobs, --cluster", remedy=remedy)
        if options.film:
            check_film(options.film)
        given, made = _made(options.source, options.out, options, say_note, progress=is_watched())
        print(f"{options.out}: written")
        if options.film:
            print(draw_film({"given": given, "made": made}, options.film))
        return 0
    from motionlab.commands import batch

    if options.film:
        remedy = "leave out --film, and draw the ones you want: motionlab show IN OUT --out FILM.mp4"
        raise DataError("a film shows one motion, this is a folder", path=options.source, place="--film", remedy=remedy)
    if options.out.suffix.lower() in WRITTEN:
        raise DataError("a folder of motions goes into a folder", path=options.out, remedy="name a folder")
    if options.out.exists() and options.out.samefile(options.source):
        raise DataError("the motions would be written over", path=options.out, remedy="name another folder")
    files = [path for path in options.source.iterdir() if path.is_file()]
    found = sorted(path for path in files if path.suffix.lower() in WRITTEN)
    if not found:
        raise DataError(f"no motion ({', '.join(WRITTEN)}) in this folder", path=options.source, remedy="name another")
    make_folder(options.out)
    if len(found) < len(files):
        print(f"note: {len(files) - len(found)} of {len(files)} files were passed over: not {' '.join(WRITTEN)}")
    clips = [(path.name, path, None, options.out / path.name) for path in found]
    return batch.run_clips(partial(_make, options=options), clips, lambda clip: clip[3].exists(), options)


def _make(clip: tuple, options: argparse.Namespace) -> list[str]:
    """Does it with one of many; says how."""
    notes: list[str] = []
    _made(clip[1], clip[3], options, notes.append)
    return notes


def _made(source: Path, target: Path, options, say: Callable, progress: bool = False) -> tuple[Motion, Motion]:
    """Reads a motion, makes another of it and writes that; returns both, and says what was guessed, and how."""
    from motionlab.animate.rewriting import check_target, write_back
    from motionlab.retarget import retarget_onto

    check_target(source, target)
    motion = given = read_motion(source, options, say)
    if "onto" in options:  # of which names are given, and what to do with bones that change their length
        source, said = options.onto, lambda note: say(f"{options.onto.name}: {note}")
        stretched = options.translations if source.suffix.lower() in (".bvh", ".glb", ".gltf") else None
        given = read_motion(source, argparse.Namespace(names=options.onto_names, translations=stretched), said)
        found = retarget_onto(motion, given)
    else:
        found = options.make(options, motion, progress)
    for note in (*found.notes, write_back(source, target, given, found.motion)):
        say(note)
    return motion, found.motion


def _inbetween(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab.animate import filling

    keep = filling.key_mask(motion, filling.frames_named(options.keys, motion.frames), options.joints)
    how = {"method": options.method, "seed": options.seed, "plant": options.plant}
    return filling.inbetween(motion, keep, progress=progress, **how)


def _repair(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab.animate import restore
    from motionlab.diffusion.denoising import Noise

    noise = None if options.noise is None else Noise.of(options.noise[0], options.noise[1] / 10)
    how = {"method": options.method, "drift": options.drift, "plant": options.plant}
    return restore.repaired(motion, noise, progress=progress, **how)


def _complete(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab.animate import filling, restore

    if options.known:
        if options.seed is not None:
            raise DataError("poses from places have one answer", place="--seed", remedy="leave it out")
        return restore.posed(motion, options.known, plant=options.plant)
    return filling.completed(motion, options.hidden or [], seed=options.seed, plant=options.plant, progress=progress)


def _plant(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab.animate import planting

    return planting.planted(motion)


def _cycle(options: argparse.Namespace, motion: Motion, progress: bool) -> Animated:
    from motionlab.animate import looping

    if not (options.loop or options.in_place):
        raise DataError("nothing to do", path=options.source, place="cycle", remedy="give --loop, --in-place or both")
    motion = cut(motion, options.source, options.cut)
    blend = looping.BLEND if options.blend is None else options.blend
    return looping.cycled(motion, loop=options.loop, in_place=options.in_place, blend=blend, plant=options.plant)


def _generate(options: argparse.Namespace) -> int:
    from motionlab.animate import restore
    from motionlab.animate.rewriting import write_back

    if options.count < 1:
        raise DataError(f"{options.count} motions", place="--count", remedy="give a number above 0")
    make_folder(options.out)
    if options.film:
        check_film(options.film, options.count)
    start = read_motion(options.start, options) if options.start else None
    suffix = f".{options.format}" if options.format else options.start.suffix.lower() if options.start else ".bvh"
    suffix = suffix if suffix in WRITTEN else ".bvh"
    how = {"start": start, "plant": options.plant, "progress": is_watched()}
    made, said = {}, []
    for k in range(options.seed or 0, (options.seed or 0) + options.count):  # each is on disk before the next is begun
        found = restore.generated(options.seconds, seed=k, **how)
        target = options.out / f"generated_{k}{suffix}"
        made[target.name] = found.motion
        for note in (*found.notes, write_back(options.start, target, start, found.motion)):
            if note not in said:  # once, though it is true of all
                print(f"note: {note}")
                said.append(note)
        print(f"{target}: {found.motion.frames} frames at {found.motion.fps:g} fps")
    if options.film:
        print(draw_film(made, options.film))
    return 0
