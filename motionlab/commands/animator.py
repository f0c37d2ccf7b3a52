"""``inbetween``, ``repair``, ``complete``, ``plant``, ``cycle`` and ``retarget`` of a motion file or a folder of them,
each by its function; and ``generate``."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from motionlab.animate import filling, looping, restore
from motionlab.animate.filling import Animated
from motionlab.animate.rewriting import check_target, write_back
from motionlab.baselines import Noise
from motionlab.commands import batch
from motionlab.commands.motions import check_film, cut, draw, read_motion, say_note
from motionlab.commands.options import WRITTEN
from motionlab.errors import DataError
from motionlab.files import writing
from motionlab.motion import Motion
from motionlab.retarget import retarget_onto


def run(options: argparse.Namespace) -> int:
    """Runs a command on one motion, or on every motion of a folder."""
    if not options.source.is_dir():
        if options.jobs is not None or options.cluster is not None:
            what, remedy = "one motion is not shared out", "give a folder of motions"
            raise DataError(what, place="--jobs, --cluster", remedy=remedy)
        if options.film:
            check_film(options.film)
        given, made = _made(options.source, options.out, options, say_note)
        print(f"{options.out}: written")
        if options.film:
            print(draw({"given": given, "made": made}, options.film))
        return 0
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
    with writing(options.out):
        options.out.mkdir(parents=True, exist_ok=True)
    if len(found) < len(files):
        print(f"note: {len(files) - len(found)} of {len(files)} files were passed over: not {' '.join(WRITTEN)}")
    clips = [(path.name, path, None, options.out / path.name) for path in found]
    return batch.run_clips(partial(_make, options=options), clips, lambda clip: clip[3].exists(), options)


def _make(clip: tuple, options: argparse.Namespace) -> list[str]:
    """Does it with one of many; says how."""
    notes: list[str] = []
    _made(clip[1], clip[3], options, notes.append)
    return notes


def _made(source: Path, target: Path, options, say: Callable) -> tuple[Motion, Motion]:
    """Reads a motion, makes another of it and writes that; returns both, and says what was guessed, and how."""
    check_target(source, target)
    motion = given = read_motion(source, options, say)
    if "onto" in options:  # of which names are given, and what to do with bones that change their length
        source, said = options.onto, lambda note: say(f"{options.onto.name}: {note}")
        stretched = options.translations if source.suffix.lower() in (".bvh", ".glb", ".gltf") else None
        given = read_motion(source, argparse.Namespace(names=options.onto_names, translations=stretched), said)
        found = retarget_onto(motion, given)
    else:
        found = MAKERS[options.make](options, motion)
    for note in (*found.notes, write_back(source, target, given, found.motion)):
        say(note)
    return motion, found.motion


def _inbetween(options: argparse.Namespace, motion: Motion) -> Animated:
    keep = filling.key_mask(motion, filling.frames_named(options.keys, motion.frames), options.joints)
    return filling.inbetween(motion, keep, method=options.method, seed=options.seed, plant=options.plant)


def _repair(options: argparse.Namespace, motion: Motion) -> Animated:
    noise = None if not options.noise else Noise.of(options.noise[0], options.noise[1] / 10)
    return restore.repaired(motion, noise, method=options.method, drift=options.drift, plant=options.plant)


def _complete(options: argparse.Namespace, motion: Motion) -> Animated:
    if options.known:
        if options.seed is not None:
            raise DataError("poses from places have one answer", place="--seed", remedy="leave it out")
        return restore.posed(motion, options.known, plant=options.plant)
    return filling.completed(motion, options.hidden or [], seed=options.seed, plant=options.plant)


def _cycle(options: argparse.Namespace, motion: Motion) -> Animated:
    if not (options.loop or options.in_place):
        raise DataError("nothing to do", path=options.source, place="cycle", remedy="give --loop, --in-place or both")
    motion = cut(motion, options.source, options.cut)
    how = {"loop": options.loop, "in_place": options.in_place, "blend": options.blend, "plant": options.plant}
    return looping.cycled(motion, **how)


MAKERS = {
    "inbetween": _inbetween, "repair": _repair, "complete": _complete, "cycle": _cycle,
    "plant": lambda options, motion: looping.planted(motion),
}  # fmt: skip


def generate(options: argparse.Namespace) -> int:
    """Makes new motions."""
    with writing(options.out):
        options.out.mkdir(parents=True, exist_ok=True)
    if options.film:
        check_film(options.film, options.count)
    start = read_motion(options.start, options) if options.start else None
    suffix = options.start.suffix.lower() if options.start else ""
    suffix = suffix if suffix in WRITTEN else ".bvh"
    made, said = {}, []
    for k in range(options.seed or 0, (options.seed or 0) + options.count):  # each is on disk before the next is begun
        found = restore.generated(options.seconds, start=start, seed=k, plant=options.plant)
        target = options.out / f"generated_{k}{suffix}"
        made[target.name] = found.motion
        for note in (*found.notes, write_back(options.start, target, start, found.motion)):
            if note not in said:  # once, though it is true of all
                print(f"note: {note}")
                said.append(note)
        print(f"{target}: {found.motion.frames} frames at {found.motion.fps:g} fps")
    if options.film:
        print(draw(made, options.film))
    return 0
