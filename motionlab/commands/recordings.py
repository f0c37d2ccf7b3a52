"""``data`` and ``prepare``: what a folder of recordings holds, and training motion of it."""

import argparse
import os
import sys
from pathlib import Path

from motionlab import corpus, parallel, retarget
from motionlab.commands.motions import reading, say_note, text_table, with_roles
from motionlab.errors import DataError, MissingData
from motionlab.io import recordings
from motionlab.motion import Motion


def prepare(options: argparse.Namespace) -> int:
    """Makes training motion of recordings."""
    how = {"kept": options.out, "workers": parallel.cores(), "reading": reading(options)}
    made = corpus.assemble(options.folder, options.sources, **how)
    print(f"{made.report()}\nkept in {options.out or corpus.cache_folder()}")
    return 0


def data(options: argparse.Namespace) -> int:
    """Lists recordings, and what cannot be read; or says what the 22 joints lose of them."""
    folder = options.folder or os.environ.get("MOTIONLAB_DATA")
    if not folder:
        raise MissingData("the folder of recordings", "Name it, or set MOTIONLAB_DATA to it.")
    if options.certify:
        return _certify(Path(folder), options)
    rows = recordings.inventory(Path(folder), video_fps=options.fps, reading=reading(options))
    for row in rows:
        for guess in row.guessed:
            say_note(f"{row.source}, {row.kind}: {guess}")
    shown = [{"source": row.source, "kind": row.kind, "clips": row.clips, "minutes": row.minutes, "fps": _span(row.fps),
              "joints": _span(row.points), "seen %": 100 * row.seen} for row in rows]  # fmt: skip
    print(text_table(shown))
    print(f"{sum(row.clips for row in rows)} clips, {sum(row.minutes for row in rows):.1f} minutes")
    for line in recordings.passed_over(folder):
        print(f"passed over: {line}")
    return _failed("cannot be read", [error for row in rows for error in row.unread])


def _certify(place: Path, options: argparse.Namespace) -> int:
    """Sends every motion of a folder, or one file, to the 22 standard joints and back; says what that costs."""
    found, failed, noted = [], [], {}
    for _, path, load in recordings.recordings(place, reading=reading(options)):
        try:
            motion = load(path)
            if isinstance(motion, Motion):  # what holds positions alone has no rig
                noted[path] = motion.notes
                found.append(retarget.certify(with_roles(motion, options)))
        except DataError as error:
            failed.append(error)
    rows = retarget.by_rig(found)
    for guess in recordings.guesses(noted.items()):
        say_note(guess)
    shown = [{"first": row.file, "files": row.files, "joints": f"{row.joints} of 22", "rest pose": row.source,
              "cm": 100 * row.place, "degrees": row.angle, "lost": ", ".join(row.lost) or "-",
              "holds": "yes" if row.holds else "NO"} for row in rows]  # fmt: skip
    most = f"at most {100 * retarget.PLACE:g} cm, {retarget.ANGLE:g} degrees"
    print(f"{text_table(shown)}\nthere and back, at the 95th percentile: {most}")
    return _failed("not certified", failed) or int(not all(row.holds for row in rows))


def _failed(what: str, errors: list[DataError]) -> int:
    for error in errors:
        print(f"{what}: {error}", file=sys.stderr)
    return int(bool(errors))


def _span(ends: tuple[float, float]) -> str:
    return "-".join(dict.fromkeys(f"{end:.4g}" for end in ends))
