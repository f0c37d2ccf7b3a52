"""``data`` and ``prepare``: what a folder of recordings holds, and training motion of it."""

import argparse
import os
import sys
from pathlib import Path

from motionlab import corpus, parallel
from motionlab.commands.motions import reading, say_note, text_table
from motionlab.errors import MissingData
from motionlab.io import recordings


def prepare(options: argparse.Namespace) -> int:
    """Makes training motion of recordings."""
    how = {"kept": options.out, "workers": parallel.cores(), "reading": reading(options)}
    print(corpus.assemble(options.folder, options.sources, **how).report())
    print(f"kept in {options.out or corpus.cache_folder()}")
    return 0


def data(options: argparse.Namespace) -> int:
    """Lists recordings, and what cannot be read."""
    folder = options.folder or os.environ.get("MOTIONLAB_DATA")
    if not folder:
        raise MissingData("the folder of recordings", "Name it, or set MOTIONLAB_DATA to it.")
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
    unread = [error for row in rows for error in row.unread]
    for error in unread:
        print(f"cannot be read: {error}", file=sys.stderr)
    return int(bool(unread))


def _span(ends: tuple[float, float]) -> str:
    low, high = (f"{end:.4g}" for end in ends)
    return low if low == high else f"{low}-{high}"
