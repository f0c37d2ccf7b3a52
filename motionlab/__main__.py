"""The command line: ``motionlab COMMAND``, or ``python -m motionlab COMMAND``; ``--help`` lists the commands."""

import gc
import sys
from collections.abc import Sequence
from pkgutil import resolve_name

from motionlab.commands.options import parser
from motionlab.errors import DataError, MissingData, ShapeError


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns 0 if all is well, 1 if something is missing or failed, 2 for unusable input."""
    gc.set_threshold(50_000)  # imports make many objects and hardly any garbage: half a second
    options = parser().parse_args(arguments)
    try:
        return resolve_name(f"motionlab.{options.run}")(options)
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        return 130
    except (DataError, MissingData, ShapeError) as error:
        print(f"motionlab: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
