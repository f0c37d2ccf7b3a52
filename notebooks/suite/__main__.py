"""The command line: in a checkout, ``PYTHONPATH=notebooks python -m suite COMMAND``; ``--help`` lists the commands."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from motionlab.commands.doctor import ROOT
from motionlab.errors import DataError, MissingData
from suite import execute, pages


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 if all notebooks ran, 1 if some failed, 2 if something is missing."""
    options = _parser().parse_args(arguments)
    if folder := os.environ.get("MOTIONLAB_DATA"):  # notebooks run in their own folder, not in the caller's
        os.environ["MOTIONLAB_DATA"] = str(Path(folder).expanduser().resolve())
    try:
        return int(any(run.error for run in options.run(options)))
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        return 130
    except (DataError, MissingData) as error:
        print(f"suite: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m suite", description="Run the notebooks.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    some = argparse.ArgumentParser(add_help=False)
    some.add_argument("notebooks", nargs="*", help='only these, such as "02"')
    made = commands.add_parser("report", parents=[some], help="the notebooks as pages, checked by running them")
    made.set_defaults(run=_report)
    made.add_argument("--out", type=Path, default=ROOT / "report")
    usual = os.environ.get("MOTIONLAB_PROFILE") or "smoke"
    made.add_argument("--profile", choices=("smoke", "full"), default=usual)
    made.add_argument("--no-run", action="store_true", help="only the pages, which then say: not checked today")
    made = commands.add_parser("regenerate", parents=[some], help="run the notebooks in place, in full, as committed")
    made.set_defaults(run=_regenerate)
    made.add_argument("--fingerprints", action="store_true", help="only what smoke runs measure, into the records")
    made.add_argument("--again", action="store_true", help="with --fingerprints: also where the recorded one differs")
    made = commands.add_parser("pages", help="docs/scoreboard.md and README's findings, from the records")
    made.set_defaults(run=lambda _: pages.update(ROOT) or ())
    return parser


def _report(options: argparse.Namespace) -> list[execute.Run]:
    from suite import report  # takes seconds to load

    runs = report.write_report(options.out, options.profile, options.notebooks, run=not options.no_run)
    print(f"{'not run' if options.no_run else _summary(runs)}; report: {options.out / 'index.html'}")
    return runs


def _regenerate(options: argparse.Namespace) -> list[execute.Run]:
    if options.fingerprints:
        paths = execute.find_notebooks(options.notebooks)
        runs = [execute.take_fingerprint(path, again=options.again) for path in paths]
    else:
        runs = execute.regenerate(options.notebooks)
    print(_summary(runs))  # first: the pages cannot be written where an answer lacks its finding
    if not options.fingerprints:
        pages.update(ROOT)
    return runs


def _summary(runs: Sequence[execute.Run]) -> str:
    """How many notebooks ran, and why the others did not."""
    failed = [f"-- {run.notebook} {run.status}: {run.error.splitlines()[0]}" for run in runs if run.error]
    return "\n".join([*failed, f"{len(runs) - len(failed)} of {len(runs)} notebooks ran"])


if __name__ == "__main__":
    sys.exit(main())
