"""What all commands share: how they say what they are, tables, and whether somebody watches."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence


def add_command(commands, name: str, text: str, example: str, run: Callable | None = None) -> argparse.ArgumentParser:
    """Adds a command: what it does in a line, the words of one example, and what runs it, options -> exit status."""
    command = commands.add_parser(name, help=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.description = f"{text[0].upper()}{text[1:]}."
    command.epilog = f"example:\n  motionlab {name} {example}".rstrip()
    command.set_defaults(run=run)
    return command


def add_sharing(command: argparse.ArgumentParser, what: str) -> None:
    """Adds the options of a command that works on a folder of clips."""
    command.add_argument("--jobs", type=int, metavar="N", help=f"{what}: so many at once, a process each (default 1)")
    text = f"{what}: on the workers of this Dask scheduler, who share the folders (needs motionlab[cluster])"
    command.add_argument("--cluster", metavar="tcp://HOST:PORT", help=text)


def text_table(rows: Sequence[dict[str, object]]) -> str:
    """Returns rows (all with the same keys) as aligned columns."""
    cells = [[f"{v:.1f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    cells = [list(rows[0]), *cells] if rows else [["nothing found"]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells)


def is_watched() -> bool:
    """Says whether somebody watches: progress bars fill a file or a pipe with a line for every step."""
    return sys.stderr.isatty()
