"""The command line: ``motionlab COMMAND``, or ``python -m motionlab COMMAND``; ``--help`` lists the commands."""

import sys
from collections.abc import Sequence
from importlib import import_module

from motionlab.commands.options import parser
from motionlab.errors import DataError, MissingData, ShapeError


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns 0 if all is well, 1 if something is missing or failed, 2 for unusable input."""
    options = parser().parse_args(arguments)
    module, _, name = options.run.partition(":")
    try:
        return getattr(import_module(f"motionlab.{module}"), name)(options)
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        return 130
    except (DataError, MissingData, ShapeError) as error:
        print(f"motionlab: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
