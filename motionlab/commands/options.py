"""The commands and their options, and what runs each: one table. Nothing heavy is imported here, so that ``--help``
takes no time; the module that runs a command is imported when it does."""

import argparse
import contextlib
import math
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

WRITTEN = (".bvh", ".npz", ".glb", ".npy")
READ = f"{' '.join(WRITTEN)} .gltf .amc, DeepMimic's .txt, or .pt .pkl of GVHMR, WHAM, PHALP"
METHODS, UP = ("network", "curves"), ("y", "z", "x", "-y", "-z", "-x")
COURSES = ("completer", "completer_rough", "completer_draws", "diffusion_plain", "transition")
MOST = 6  # motions side by side: more are too small to see
_IN = f"a motion ({READ}), or a folder: of it all {' '.join(WRITTEN)}"
_OUT = f"a file ({' '.join(WRITTEN)}; the format of IN keeps the file's own numbers), or for a folder another folder"
_DRAW = "draw one of the motions that are possible, by the network; none: its one answer, closest on average"
_CUT = {"type": float, "nargs": 2, "metavar": ("FROM", "TO")}


class _Parser(argparse.ArgumentParser):
    """What a command does not know is answered by that command."""

    def parse_args(self, words: Sequence[str] | None = None) -> argparse.Namespace:
        options, unknown = self.parse_known_args(words)
        if unknown:
            self.commands.choices[options.command].error(f"unrecognized arguments: {' '.join(unknown)}")
        return options


def parser() -> argparse.ArgumentParser:
    """Returns what parses a command line."""
    whole = _Parser(prog="motionlab", formatter_class=argparse.RawDescriptionHelpFormatter)
    whole.description = "Draws, converts, mends and makes human motion, and finds it in videos."
    whole.epilog = "example:\n  motionlab show walk.bvh --out walk.mp4\n\n"
    whole.epilog += "motionlab COMMAND --help says what a command takes, with an example of its own."
    whole.commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND", title="commands")
    add = partial(_add, whole.commands)
    _add_motions(add)
    _add_animator(add)
    _add_fit(add)

    _, option = add("doctor", "say what is installed, what is missing, and how to mend it", "", "commands.doctor:run")
    option("--prepare", action="store_true", help="install rendering libraries if root, bake the body")

    text = "list the recordings in a folder: clips, minutes, frame rates, joints"
    command, option = add("data", text, "recordings/", "commands.recordings:data")
    option("folder", nargs="?", help="or one file (default: $MOTIONLAB_DATA)")
    option("--fps", type=float, help="frames per second of OpenPose folders, which do not store it")
    _add_reading(command, rate=("--fps-in",))
    option("--certify", action="store_true", help="say what the 22 standard joints lose of each rig in it")

    text = "make training motion of recordings; say what is cut out and why"
    command, option = add("prepare", text, "recordings/ --out prepared/", "commands.recordings:prepare")
    option("folder", help="of recordings, one sub-folder per source")
    option("--sources", nargs="+", metavar="NAME", help="only these sub-folders")
    option("--out", type=Path, help="where it is kept (default: the user's cache)")
    _add_reading(command)

    add("models", "write the table of the models that ship", "", "training.model_card:run")

    text = "write the completer as an ONNX file that fills gaps, for editors without Python"
    _, option = add("onnx", text, "--out inbetween.onnx", "commands.onnx_export:run")
    option("--model", default="completer", help="a completer that ships, or a path (default: completer)")
    option("--out", type=Path, default=Path("inbetween.onnx"), help="default: inbetween.onnx")

    text = "train a model, and keep its recipe with it"
    _, option = add("train", text, "transition --out prior", "training.courses:run")
    text = "pose and first states; what completes motions, a denoiser and a transition prior, trained until Ctrl-C"
    option("model", choices=("small", *COURSES), help=text)
    option("--steps", type=_count, help="optimiser steps, the whole schedule (default: the recipe's)")
    option("--seed", type=int, default=0, help="default: 0")
    option("--data", default=os.environ.get("MOTIONLAB_DATA"), help="recordings, besides synthetic motion")
    option("--out", type=Path, help="default: the checkpoint that ships; of small, its folder")
    option("--more", action="store_true", help=f"{', '.join(COURSES)}: go on from the kept run, or what ships")
    return whole


def _add(commands, name: str, text: str, example: str, run: str, **more) -> tuple[argparse.ArgumentParser, Callable]:
    """Adds a command: what it does in a line, the words of one example, and the function that runs it, options -> exit
    status, as module:name. Returns it, and what adds its options; more: what else is known of them."""
    command = commands.add_parser(name, help=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.description = f"{text[0].upper()}{text[1:]}."
    command.epilog = f"example:\n  motionlab {name} {example}".rstrip()
    command.set_defaults(run=run, **more)
    return command, command.add_argument


def _add_motions(add: Callable) -> None:
    text = "draw motion files side by side: a film, or a picture of key poses"
    command, option = add("show", text, "walk.bvh --out walk.mp4", "commands.motions:show")
    option("files", nargs="+", type=Path, metavar="IN", help=f"a motion: {READ}; up to {MOST} of them")
    text = "a film (.mp4), or key poses (.png), a row a file"
    option("--out", type=Path, required=True, metavar="FILE", help=text)
    option("--bones", action="store_true", help="a figure of the file's own joints, not a body")
    option("--follow", action="store_true", help="the view moves along with who walks")
    option("--cut", **_CUT, help="only these seconds of every file")
    _add_reading(command)

    text = "write a motion file in another format, told by the endings of the names"
    command, option = add("convert", text, "walk.bvh walk.glb", "commands.motions:convert")
    option("source", metavar="IN", type=Path, help=READ)
    option("target", metavar="OUT", type=Path, help=f"{' '.join(WRITTEN)} (HumanML3D's joints)")
    option("--fps", type=float, help="frames per second of the output (default: those of the input)")
    _add_reading(command, rate=("--fps-in",))
    option("--rest", choices=("t", "a"), help="of a .bvh or bones: a T or an A as the rest pose")
    option("--standard", action="store_true", help="put it on the 22 standard joints (always for .npz)")
    option("--features", action="store_true", help="a .npy of HumanML3D's 263 numbers, not of 22 joints")
    option("--bones", action="store_true", help="a .glb of the file's own joints, no body on the 22")


def _add_animator(add: Callable) -> None:
    """``inbetween``, ``repair``, ``complete``, ``plant``, ``cycle`` and ``retarget`` of a motion file or a folder of
    them, each by a function ``make``; and ``generate``."""

    def edit(name: str, text: str, example: str, seed: str = "", plants: bool = True) -> tuple:
        command, option = add(name, text, example, "commands.animator:run", make=name)
        option("source", metavar="IN", type=Path, help=_IN)
        option("--out", type=Path, required=True, help=_OUT)
        text = "also write a film: what was given beside what was made of it; not of a folder"
        option("--film", type=Path, metavar="FILE.mp4", help=text)
        _add_sharing(command, "of a folder")
        _add_usual(command, seed, plants)
        return command, option

    example = "walk.bvh --keys 0,30,60,90,120-last --out between.bvh --film between.mp4"
    _, option = edit("inbetween", "keep the frames you name, make those between them", example, _DRAW)
    option("--keys", required=True, help="frames that stay, from 0: 0,45,90 or 0-20,60-last")
    option("--joints", type=_words, default=[], help="joints that stay in all frames, as left_wrist,arms")
    option("--method", choices=METHODS, help="default: what is measured best for the longest gap")

    _, option = edit("repair", "take noise and jumps out of a motion", "walk.bvh --out repaired.bvh")
    option("--noise", type=_noise, metavar="auto|DEGREES[,MM]", help="of joints and root (default: auto, as measured)")
    option("--method", choices=METHODS, help="default: network; for jumps as of inbetween")
    option("--drift", action="store_true", help="the path goes by the feet: of a walk seen on a video")

    example = "walk.bvh --hidden legs --out completed.bvh"
    command, option = edit("complete", "make joints that are missing or wrong", example, _DRAW)
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("--hidden", type=_words, help="joints to make: legs, left_arm, right_knee, ...; others stay")
    which.add_argument("--known", type=_words, help="joints whose places alone are known: left_wrist,head, ...")

    edit("plant", "hold feet that stand in place", "walk.bvh --out planted.bvh", plants=False)

    example = "walk.bvh --loop --cut 1.467 2.567 --out loop.bvh"
    _, option = edit("cycle", "make a motion a loop, or let it go nowhere", example)
    option("--loop", action="store_true", help="its last frame is its first again; best cut to one round")
    option("--in-place", action="store_true", help="the root stays above one point of the floor")
    option("--cut", **_CUT, help="only these seconds")
    option("--blend", type=float, default=0.25, metavar="SECONDS", help="in which each end gives in (default: 0.25)")

    text, example = "put the movement of a motion on the rig of another", "walk.bvh --onto rig.bvh --out mine.bvh"
    _, option = edit("retarget", text, example, plants=False)
    option("--onto", type=Path, required=True, metavar="RIG", help=f"its bones, names and rest pose: {READ}")
    option("--onto-names", type=Path, metavar="FILE.json", help="as --names, of RIG")

    text, example = "make new motions, or what may follow on one", "--seconds 4 --count 2 --out made/"
    command, option = add("generate", text, example, "commands.animator:generate")
    option("--seconds", type=float, default=4.0, help="how long each is, or goes on (default 4)")
    option("--count", type=_count, default=1, help="how many, each from its own seed (default 1)")
    option("--start", type=Path, metavar="IN", help="a motion to go on from, which stays as it is")
    option("--out", type=Path, required=True, metavar="FOLDER", help="in the format of --start, or as .bvh")
    option("--film", type=Path, metavar="FILE.mp4", help="also write a film: what was made, side by side")
    _add_usual(command, "of the first (default 0)")


def _add_fit(add: Callable) -> None:
    text = "find the 3-D motion of the people in a video, from 2-D keypoints"
    command, option = add("fit", text, "clip.mp4 --keypoints keypoints/ --out scene/", "commands.footage:run")
    option("video", nargs="?", type=Path, help="a video, or a folder of images; without it: on paper")
    option(
        "--keypoints", type=Path, metavar="PATH",
        help="what a 2-D pose detector wrote, told by content: a file, or a folder with a file per frame "
        "(default: found in the video, needs motionlab[detect])",
    )  # fmt: skip
    option("--out", type=Path, metavar="FOLDER/", help="gets motion, scene, film and report")
    option("--people", action="store_true", help="list who was seen, and stop")
    text = "longest, largest, all, or ids (see --people)"
    option("--person", nargs="+", default=["longest"], metavar="ID", help=text)
    option("--size", type=_size, metavar="WxH", help="of the image, where no file says it, in pixels")
    option("--fps", type=float, help="of the keypoints, where neither they nor the video say it")
    option("--layout", help="of the keypoints, where it is not told: BODY_25, COCO_17, HALPE_26, ...")
    option(
        "--camera", type=Path, metavar="FILE", help="Qualisys XML, Captury .calib, Pose2Sim's TOML, OpenCV's YAML or "
        'XML, EasyMocap, COLMAP, or JSON: "intrinsics" (3x3, px), "width", "height"; if known "distortion" (k1, k2, '
        'p1, p2, k3), "rotation" (3x3) and "translation" from the world, z up, floor z = 0'
    )  # fmt: skip
    option("--camera-name", help="which of the file's cameras (default: by the number in PATH's name)")
    option("--prior", type=Path, metavar="FILE", help="of motion: an official HuMoR .pth, or your own")
    option("--pose-prior", type=Path, metavar="FILE", help="a VPoser snapshot, or your own")
    option("--initial", type=Path, metavar="FILE", help="of first states: official .npz, or your own")
    text = "needed with official files: the pelvis from SMPL's translation, J_0 of the mean body in metres"
    option("--pelvis", type=float, nargs=3, metavar=("X", "Y", "Z"), help=text)
    option("--height", type=_height, metavar="METRES", help="of the person who is fitted, where that is no adult's")
    text = "of a clip of up to 6 s, K other motions that explain as well what was seen, and how far off hidden limbs "
    option("--draws", type=int, default=0, metavar="K", help=f"{text}may be")
    text = "of stage 3; rollout: HuMoR's schedule, in all stages, with its unknowns and weights, a minute or more; "
    option("--solver", choices=("shooting", "rollout"), default="shooting", help=f"{text}up to 6 s in one piece")
    option("--quick", action="store_true", help="few steps, a small film: a first look")
    text = "the two paths are folders of clips, put together by their names: a scene for each, in FOLDER/NAME/"
    option("--each", action="store_true", help=text)
    _add_sharing(command, "with --each")


def _add_sharing(command: argparse.ArgumentParser, what: str) -> None:
    """Adds the options of a command that works on a folder of clips."""
    option = command.add_mutually_exclusive_group().add_argument
    option("--jobs", type=_count, metavar="N", help=f"{what}: so many at once, a process each (default 1)")
    text = f"{what}: on the workers of this Dask scheduler, who share the folders (needs motionlab[cluster])"
    option("--cluster", metavar="tcp://HOST:PORT", help=text)


def _add_usual(command: argparse.ArgumentParser, seed: str, plants: bool = True) -> None:
    if seed:  # of what draws
        command.add_argument("--seed", type=_seed, help=seed)
    if plants:
        command.add_argument("--no-planting", dest="plant", action="store_false", help="leave sliding feet alone")
    _add_reading(command)


def _add_reading(command: argparse.ArgumentParser, rate: tuple[str, ...] = ("--fps-in", "--fps")) -> None:
    """Adds what a motion file does not say of itself, or says wrongly. rate: names of the frame rate's option."""
    text = "what a file does not say, or says wrongly (default: worked out, and noted)"
    group = command.add_argument_group(text)
    option, axis = group.add_argument, group.add_mutually_exclusive_group().add_argument
    option("--unit", type=_metres, help="of lengths: m, cm, mm, inch, ft, or metres")
    text = "the file's axis that points up: y, z, ... (--up=-y)"
    axis("--up", type=lambda axis: axis.lower().removeprefix("+"), choices=UP, metavar="AXIS", help=text)
    axis(
        "--axes", type=_axes, metavar="XYZ", help="instead: the file's axes that become x, y and z, up; as --axes=x-zy"
    )
    option(*rate, dest="fps_in", type=float, metavar="FPS", help="frames per second of the file")
    text = "of bones that change their length: refuse, or keep the mean"
    option("--translations", choices=("strict", "mean"), help=text)
    option("--asf", type=Path, metavar="FILE", help="the skeleton of an .amc (default: beside it)")
    option("--names", type=Path, metavar="FILE.json", help="what its joints are: standard name -> its own")
    option("--person", type=int, metavar="N", help="whom, of a file of several, from 0 (default: 0)")
    option("--animation", metavar="NAME", help="of a .glb: which, by name or number (default: the first)")


# --------------------------------------------------------------------------------------------- what an option's text is
def checked(expected: str) -> Callable:
    """Makes of a function that reads an option's text one that says what was expected, where it fails or gives None."""

    def decorated(read: Callable) -> Callable:
        def checking(text: str):
            with contextlib.suppress(ValueError):
                if (found := read(text)) is not None:
                    return found
            raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}")

        return checking

    return decorated


def _words(text: str) -> list[str]:
    return [word for word in text.split(",") if word.strip()]


@checked("a whole number above 0")
def _count(text: str) -> int | None:
    return int(text) or None if text.isdecimal() else None


@checked("a whole number from 0, of 18 digits at most")
def _seed(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) < 19 else None


@checked("auto or degrees[,millimetres], from 0 to 1000")
def _noise(text: str) -> tuple[float, ...] | None:
    """Degrees and millimetres; none for auto."""
    degrees, _, mm = text.partition(",")
    size = () if text == "auto" else (float(degrees), float(mm or 5 * float(degrees)))
    return size if all(0 <= part < 1000 for part in size) else None  # not a number is neither


@checked("width x height in pixels, such as 1280x720")
def _size(text: str) -> tuple[int, int] | None:
    wide, high = text.lower().split("x")
    return (int(wide), int(high)) if all(s.isdecimal() and 0 < int(s) < 100_000 for s in (wide, high)) else None


@checked("metres, such as 1.10")
def _height(text: str) -> float | None:
    return height if 0.3 <= (height := float(text)) <= 2.5 else None


@checked("metres above zero or one of m, dm, cm, mm, inch, ft")
def _metres(text: str) -> float | None:
    from motionlab.io.judging import unit_named

    metres = unit_named(text) or float(text)
    return metres if 0 < metres < math.inf else None


@checked('a right-handed choice such as "xyz" or "x-zy"')
def _axes(text: str) -> str:
    from motionlab.io.judging import axes_to_matrix

    axes_to_matrix(text)
    return text
