"""Measures how a notebook reads: its cells, its words, its figures with a reading."""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Sequence
from pathlib import Path

from suite.staleness import number_of

_CODE = re.compile(r"```.*?```|\$\$.*?\$\$|\$[^$]*\$|`[^`]*`", re.DOTALL)
_SENTENCE = re.compile(r"[^.!?:]+[.!?:](?=\s|$)")
_TABLE = re.compile(r"^\s*\|.*$", re.MULTILINE)


def measure(notebook: Path) -> dict[str, object]:
    """Computes the shape of a notebook, as ``shared/writing.md`` asks for it.

    Code cells with their median and longest number of lines; words of prose; the share of cells with a figure that have
    a reading, printed or written, before the next figure; words per sentence (mean) and the share of sentences of more
    than 25 words.
    """
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    code = ["".join(c["source"]) for c in cells if c["cell_type"] == "code"]
    lines = [len(text.strip().splitlines()) for text in code]
    prose = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    prose = _TABLE.sub("", _CODE.sub("x", prose))
    sentences = [len(s.split()) for part in re.split(r"\n\s*\n|\n[-*#]|\n\d+\.", prose) for s in _split(part)]
    drawn = [i for i, c in enumerate(cells) if c["cell_type"] == "code" and "lab.figure(" in "".join(c["source"])]
    read = [i for i, after in zip(drawn, [*drawn, len(cells)][1:], strict=True) if _is_read(cells[i:after])]
    return {
        "notebook": number_of(notebook.stem),
        "code cells": len(lines),
        "median lines": int(statistics.median(lines)),
        "longest": max(lines),
        "words": len(prose.split()),
        "figures with a reading, %": round(100 * len(read) / max(len(drawn), 1)),
        "words per sentence": round(statistics.mean(sentences), 1),
        "longer than 25 words, %": round(100 * sum(n > 25 for n in sentences) / len(sentences)),
        "MB": round(notebook.stat().st_size / 1e6, 2),
    }


def _is_read(cells: Sequence[dict]) -> bool:
    """Whether a reading stands among the outputs of cells, or in the text after the first of them."""
    printed = ["".join(out.get("data", {}).get("text/markdown", "")) for c in cells for out in c.get("outputs", ())]
    written = ["".join(c["source"]) for c in cells[1:] if c["cell_type"] == "markdown"]
    return any("**Reading" in text for text in printed + written)


def _split(part: str) -> list[str]:
    return [s.strip() for s in _SENTENCE.findall(part.strip() + ".") if len(s.split()) > 2]
