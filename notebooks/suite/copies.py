"""Copies of the notebooks to play with, as JupyterLab saves what it shows: ``python -m suite.copies FOLDER`` makes the
folder, or brings it up to date; tracked files stay as they are."""

import json
import shutil
import sys
from pathlib import Path

NOTEBOOKS = Path(__file__).resolve().parents[1]


def refresh(folder: Path, notebooks: Path = NOTEBOOKS) -> list[str]:
    """Copies into a folder what is missing there or has changed since, unless a person has edited their copy.

    What was copied last is kept in ``folder/.copied``. To run a notebook is not to edit it: only cells' text counts.

    Returns:
        names of notebooks that changed both here and there: the person's are kept.
    """
    copied, kept = folder / ".copied", []
    copied.mkdir(parents=True, exist_ok=True)
    for name in ("claims.toml", "results"):  # what notebooks read from where they lie
        if not (folder / name).is_symlink() and (notebooks / name).exists():
            (folder / name).symlink_to((notebooks / name).resolve())
    for source in sorted(notebooks.glob("*.ipynb")):
        mine, last = folder / source.name, copied / source.name
        old = mine.exists() and last.exists() and last.read_bytes() == source.read_bytes()
        if not old and mine.exists() and _text(mine) not in (_text(source), _text(last)):
            kept.append(source.name)
        elif not old:
            shutil.copyfile(shutil.copyfile(source, mine), last)
    return kept


def _text(path: Path) -> list[str] | None:
    """What a person writes in a notebook; None where there is none that can be read."""
    try:
        return ["".join(cell["source"]) for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None


if __name__ == "__main__":
    for name in refresh(folder := Path(sys.argv[1])):
        print(f"{folder / name}: you edited it, and there is a new version. Yours is kept: rename it to get that one")
