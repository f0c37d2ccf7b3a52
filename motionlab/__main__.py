"""The command line: ``python -m motionlab COMMAND``; ``--help`` lists the commands."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab import animate_cli, doctor
from motionlab.errors import DataError, MissingData, ShapeError

if TYPE_CHECKING:
    from motionlab.skeleton import Skeleton


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
    command.add_argument("target", metavar="OUT", type=Path, help=" ".join(sorted(SAVERS)))
    command.add_argument("--fps", type=float, help="frames per second of the output (default: those of the input)")
    command.add_argument("--unit", type=_metres, help="of a .bvh: m, cm, mm, inch or metres (default: detected)")
    command.add_argument("--up", choices=("y", "z"), help="of a .bvh: the axis that points up (default: detected)")
    command.add_argument("--standard", action="store_true", help="retarget to the 22 standard joints (always for .npz)")
    flesh = command.add_mutually_exclusive_group()
    flesh.add_argument("--body", action="store_true", help="the default body on the 22 joints (of a .glb the default)")
    flesh.add_argument("--bones", "--no-body", action="store_true", help="a .glb of the file's own joints, no body")
    command.set_defaults(run=_convert)

    command = commands.add_parser("fit", help="from a video and its 2-D keypoints to a scene")
    command.add_argument("video", nargs="?", type=Path, help="a video, or a folder of images; without it: on paper")
    command.add_argument(
        "--keypoints", type=Path, metavar="PATH",
        help="what a 2-D pose detector wrote, told by content: a file, or a folder with a file per frame "
        "(default: found in the video, needs motionlab[detect])",
    )  # fmt: skip
    command.add_argument("--out", type=Path, metavar="FOLDER/", help="gets motion, scene, film and report")
    command.add_argument("--people", action="store_true", help="list who was seen, and stop")
    command.add_argument(
        "--person", nargs="+", default=["longest"], metavar="ID", help="longest, largest, all, or ids (see --people)"
    )
    command.add_argument("--size", type=_size, metavar="WxH", help="of the image, where no file says it, in pixels")
    command.add_argument("--fps", type=float, help="of the keypoints, where neither they nor the video say it")
    command.add_argument("--layout", help="of the keypoints, where it is not told: BODY_25, COCO_17, HALPE_26, ...")
    command.add_argument(
        "--camera", type=Path, metavar="FILE", help='Qualisys XML, Captury .calib, or JSON: "intrinsics" (3x3, px), '
        '"width", "height"; if known "rotation" (3x3) and "translation" from the world, z up, floor z = 0'
    )  # fmt: skip
    command.add_argument("--camera-name", help="which of the file's cameras (default: by the number in PATH's name)")
    command.add_argument("--prior", type=Path, metavar="FILE", help="of motion: an official HuMoR .pth, or your own")
    command.add_argument("--pose-prior", type=Path, metavar="FILE", help="a VPoser snapshot, or your own")
    command.add_argument("--initial", type=Path, metavar="FILE", help="of first states: official .npz, or your own")
    command.add_argument(
        "--pelvis", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="needed with official files: the pelvis from SMPL's translation, J_0 of the mean body in metres",
    )  # fmt: skip
    command.add_argument(
        "--solver", choices=("shooting", "rollout"), default="shooting",
        help="of stage 3; rollout: HuMoR's schedule, in all stages, with its unknowns and weights, a minute or more",
    )  # fmt: skip
    command.add_argument("--quick", action="store_true", help="few steps, a small film: a first look")
    command.set_defaults(run=_fit)

    animate_cli.add_commands(commands)

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


def text_table(rows: Sequence[Mapping[str, object]]) -> str:
    """Returns rows (all with the same keys) as aligned columns."""
    cells = [[f"{v:.1f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    cells = [list(rows[0]), *cells] if rows else [["nothing found"]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells)


SAVERS = {".bvh": "bvh", ".npz": "amass", ".glb": "gltf"}


def _convert(options: argparse.Namespace) -> int:
    from importlib import import_module

    from motionlab import io
    from motionlab.body import BodyModel
    from motionlab.motion import resample
    from motionlab.retarget import retarget
    from motionlab.skeleton import STANDARD

    suffix = options.target.suffix.lower()
    if suffix not in SAVERS:
        raise DataError("cannot write this format", path=options.target, remedy=f"use one of {', '.join(SAVERS)}")
    if (options.body or options.bones) and suffix != ".glb":
        raise DataError("only a GLB holds a body", path=options.target, remedy="leave out --body and --bones")
    body = suffix == ".glb" and not options.bones
    guided = {key: value for key in ("unit", "up") if (value := getattr(options, key)) is not None}
    if guided and options.source.suffix.lower() != ".bvh":
        raise DataError("its unit and axes are known", path=options.source, remedy="--unit and --up are for .bvh only")
    motion = io.load(options.source, **guided)
    if suffix == ".npz" and not _has_standard_bones(motion.skeleton):
        leg = float(STANDARD.offsets[STANDARD.indices(["left_knee", "left_ankle"])].norm(dim=-1).sum())
        found = retarget(motion, proportions="standard", leg=leg)
        motion = found.motion
        print(f"note: AMASS files hold no bone lengths: put on the standard body, {found.scale:.3f} times the size")
    elif (options.standard or body) and motion.skeleton.names != STANDARD.names:
        motion = retarget(motion).motion
    if options.fps is not None:
        motion = resample(motion, options.fps)
    more = {"body": BodyModel.from_anny()} if body else {}
    import_module(f"motionlab.io.{SAVERS[suffix]}").save(options.target, motion, **more)
    for note in motion.notes:
        print(f"note: {note}")
    print(f"{options.target}: {motion.frames} frames at {motion.fps:g} fps, {len(motion.skeleton)} joints")
    return 0


def _metres(text: str) -> float:
    """A unit of length by its name, or as metres per unit."""
    from motionlab.io.bvh import UNITS

    try:
        metres = UNITS.get(text) or float(text)
    except ValueError:
        metres = math.nan
    if not 0 < metres < math.inf:
        raise argparse.ArgumentTypeError(f"expected metres above zero or one of {', '.join(UNITS)}, got {text!r}")
    return metres


def _has_standard_bones(skeleton: Skeleton) -> bool:
    from motionlab.skeleton import STANDARD

    return skeleton.names == STANDARD.names and bool((skeleton.offsets - STANDARD.offsets)[1:].abs().max() < 1e-4)


def _size(text: str) -> tuple[int, int]:
    """An image size such as 1280x720."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isdecimal() and 0 < int(side) < 100_000 for side in sides):
        raise argparse.ArgumentTypeError(f"expected width x height in pixels, such as 1280x720, got {text!r}")
    return int(sides[0]), int(sides[1])


def _fit(options: argparse.Namespace) -> int:
    from motionlab import fit

    if options.out is None and not options.people:
        raise DataError("nowhere to write to", place="--out", remedy="name a folder: --out OUT/")
    if not options.people:
        return fit.run(options)
    how = {name: getattr(options, name) for name in ("out", "fps", "size", "layout")}
    clip = fit.open_clip(options.keypoints, options.video, progress=True, **how)
    print(text_table(clip.footage.table()))
    for note in clip.notes:
        print(f"note: {note}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
