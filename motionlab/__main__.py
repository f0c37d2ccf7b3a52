"""The command line: ``python -m motionlab COMMAND``; ``--help`` lists the commands."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from motionlab import doctor
from motionlab.commands import animator, footage
from motionlab.commands.motions import WRITTEN, add_axes, read_motion
from motionlab.commands.printing import text_table
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
    except (ValueError, FileNotFoundError) as error:
        if not isinstance(error, DataError | MissingData | ShapeError):
            raise
        print(f"motionlab: {error}", file=sys.stderr)
        return 2


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """The commands; what takes seconds to import is imported by the command that needs it."""
    parser = argparse.ArgumentParser(prog="python -m motionlab", description="Human motion priors, measured.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("doctor", help="what is installed, what is missing, and the remedy")
    command.add_argument("--prepare", action="store_true", help="install rendering libraries if root, bake the body")
    command.set_defaults(run=_doctor)

    command = commands.add_parser("data", help="the recordings in a folder: clips, minutes, fps, joints")
    command.add_argument("folder", nargs="?", help="default: $MOTIONLAB_DATA")
    command.add_argument("--fps", type=float, help="frames per second of OpenPose folders, which do not store it")
    command.set_defaults(run=_data)

    command = commands.add_parser("convert", help="one motion file into another format, told by the suffixes")
    command.add_argument("source", metavar="IN", type=Path, help=".bvh .amc .npz .glb, or DeepMimic's .txt")
    command.add_argument("target", metavar="OUT", type=Path, help=" ".join(WRITTEN))
    command.add_argument("--fps", type=float, help="frames per second of the output (default: those of the input)")
    add_axes(command)
    command.add_argument("--standard", action="store_true", help="retarget to the 22 standard joints (always for .npz)")
    flesh = command.add_mutually_exclusive_group()
    flesh.add_argument("--body", action="store_true", help="the default body on the 22 joints (of a .glb the default)")
    flesh.add_argument("--bones", "--no-body", action="store_true", help="a .glb of the file's own joints, no body")
    command.set_defaults(run=_convert)

    footage.add_command(commands)
    animator.add_commands(commands)

    command = commands.add_parser("prepare", help="recordings into training motion: what is kept, what is cut and why")
    command.add_argument("folder", help="of recordings, one sub-folder per source")
    command.add_argument("--sources", nargs="+", metavar="NAME", help="only these sub-folders")
    command.add_argument("--strict", action="store_true", help="stop at a recording that cannot be used")
    command.add_argument("--out", type=Path, help="where it is kept (default: the user's cache)")
    command.set_defaults(run=_prepare)

    command = commands.add_parser("models", help="the table of the models that ship, into checkpoints/README.md")
    command.add_argument("--data", help="recordings: measure the transition priors on people nobody trained on, first")
    command.set_defaults(run=_models)

    command = commands.add_parser("train", help="train a model: a checkpoint with its recipe")
    if "train" in arguments[:1]:  # its presets come with torch
        from motionlab import train

        train.add_options(command)
    return parser


def _prepare(options: argparse.Namespace) -> int:
    from motionlab import corpus, parallel

    how = {"kept": options.out, "strict": options.strict, "workers": parallel.cores()}
    found = corpus.assemble(options.folder, options.sources, **how)
    print(found.report())
    print(f"kept in {options.out or corpus.cache_folder()}")
    return 0


def _models(options: argparse.Namespace) -> int:
    from motionlab import checkpoint, models

    for path in sorted(checkpoint.SHIPPED.glob("humor_*.json")) if options.data else []:
        models.judge_prior(path.stem, options.data)
    print(models.write_readme())
    return 0


def _doctor(options: argparse.Namespace) -> int:
    if options.prepare:
        return 0 if doctor.prepare() else 1
    checks = doctor.examine(os.environ.get("MOTIONLAB_DATA"))
    print(doctor.table(checks))
    missing = sum(not check.ok for check in checks)
    print(f"{missing} thing{'s' * (missing > 1)} to mend" if missing else "all is well")
    return 1 if missing else 0


def _data(options: argparse.Namespace) -> int:
    folder = options.folder or os.environ.get("MOTIONLAB_DATA")
    if not folder:
        raise MissingData("the folder of recordings", "Name it, or set MOTIONLAB_DATA to it.")
    from motionlab.io import recordings

    rows = recordings.inventory(Path(folder), video_fps=options.fps)
    print(
        text_table(
            [
                {
                    "source": row.source,
                    "kind": row.kind,
                    "clips": row.clips,
                    "minutes": row.minutes,
                    "fps": _span(row.fps),
                    "joints": _span(row.points),
                    "seen %": 100 * row.seen,
                    "licence": row.licence,
                }
                for row in rows
            ]
        )
    )
    print(f"{sum(row.clips for row in rows)} clips, {sum(row.minutes for row in rows):.1f} minutes")
    unread = [error for row in rows for error in row.unread]
    for error in unread:
        print(f"cannot be read: {error}", file=sys.stderr)
    return 1 if unread else 0


def _span(ends: tuple[float, float]) -> str:
    low, high = (f"{end:.4g}" for end in ends)
    return low if low == high else f"{low}-{high}"


def _convert(options: argparse.Namespace) -> int:
    from motionlab.body import BodyModel
    from motionlab.io.rewriting import WRITERS, check_target, for_amass
    from motionlab.motion import resample
    from motionlab.retarget import retarget
    from motionlab.skeleton import STANDARD

    suffix = options.target.suffix.lower()
    check_target(options.source, options.target)
    if (options.body or options.bones) and suffix != ".glb":
        raise DataError("only a GLB holds a body", path=options.target, remedy="leave out --body and --bones")
    body = suffix == ".glb" and not options.bones
    motion = read_motion(options.source, options)
    if suffix == ".npz":
        motion, note = for_amass(motion)
        if note:
            print(f"note: {note}")
    elif (options.standard or body) and motion.skeleton.names != STANDARD.names:
        motion = retarget(motion).motion
    if options.fps is not None:
        motion = resample(motion, options.fps)
    more = {"body": BodyModel.from_anny()} if body else {}
    WRITERS[suffix](options.target, motion, **more)
    for note in motion.notes:
        print(f"note: {note}")
    print(f"{options.target}: {motion.frames} frames at {motion.fps:g} fps, {len(motion.skeleton)} joints")
    return 0


if __name__ == "__main__":
    sys.exit(main())
