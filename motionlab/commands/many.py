"""What the commands on many clips share: ``--jobs`` and ``--cluster``, and what is said at the end."""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from operator import itemgetter
from pathlib import Path

Job = tuple[str, Path | None, Path | None, Path]  # name, what it is read from (one or two paths), and where it goes


def add_sharing(command: argparse.ArgumentParser, what: str) -> None:
    """Adds the options of a command that works on a folder of clips."""
    command.add_argument("--jobs", type=int, metavar="N", help=f"{what}: so many at once, a process each (default 1)")
    text = f"{what}: on the workers of this Dask scheduler, who share the folders (needs motionlab[cluster])"
    command.add_argument("--cluster", metavar="tcp://HOST:PORT", help=text)


def run_clips(
    function: Callable[[Job], Sequence[str]],
    clips: Sequence[Job],
    finished: Callable[[Job], bool],
    options: argparse.Namespace,
    compared: bool = False,
) -> int:
    """Runs a command on every clip that is not finished; prints what was done, and every note once.

    function: of a clip, to its notes; a module's function or a partial of one. compared: whether ``finished`` asks for
    the same options. Returns 1 where a clip failed, else 0.

    Raises:
        DataError: --jobs below 1 or with --cluster, or no cluster. MissingData: the package that speaks to one.
    """
    from motionlab.commands import batch

    clips = [(name, *(path and path.resolve() for path in paths)) for name, *paths in clips]  # for other machines
    jobs = 1 if options.jobs is None else options.jobs
    how = {"jobs_at_once": jobs, "cluster": options.cluster, "name": itemgetter(0)}
    found = batch.run_many(function, clips, finished=finished, **how)
    said = defaultdict(list)
    for k, notes in sorted(found.results.items()):
        for note in notes:
            said[note].append(found.names[k])
    for note, names in said.items():
        print(f"note: {note} ({names[0] if len(names) == 1 else f'{len(names)} clips'})")
    print(found.lines()[0])
    if found.skipped:
        how = "" if compared else ", perhaps made with other options"
        print(f"note: clips that were finished before{how}, stay as they are; to make one again, delete what it wrote")
    if found.failed:  # why was said when it happened
        print(f"failed: {', '.join(found.names[k] for k in sorted(found.failed))}", file=sys.stderr)
    return 1 if found.failed else 0
