"""How the commands print: tables, and progress bars where somebody watches."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence


def text_table(rows: Sequence[dict[str, object]]) -> str:
    """Returns rows (all with the same keys) as aligned columns."""
    cells = [[f"{v:.1f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    cells = [list(rows[0]), *cells] if rows else [["nothing found"]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells)


def calm_bars() -> None:
    """Makes progress bars write a line every ten seconds at most where stderr is a file or a pipe, not a terminal.

    To be called before tqdm is imported, which reads it then; what the person has set stays.
    """
    if not sys.stderr.isatty():
        for name, seconds in (("TQDM_MININTERVAL", "10"), ("TQDM_DELAY", "10")):
            os.environ.setdefault(name, seconds)
