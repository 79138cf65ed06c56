"""Entry point: runs the application, turns errors into messages and exit codes."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

EXIT_CODES = {
    0: "done",
    1: "verify found something, or an error that has no code of its own",
    2: "the question is wrong: an option, a topic, a time, a predicate",
    3: "a log that cannot be read at all",
    4: "a damaged log: what could be read is stored",
    5: "the store: missing, read-only, damaged, of a newer format",
    6: "MongoDB does not answer, or died",
    7: "no space left on the disk",
    8: "this content is in the store already",
    9: "an optional package is missing",
    130: "interrupted",
}


def main() -> NoReturn:
    """Run the command line and exit."""
    from hybridlog_storage.errors import HybridlogError

    from hybridlog.cli.app import app

    try:
        app()
    except HybridlogError as error:
        print(f"hybridlog: {error}", file=sys.stderr)  # noqa: T201
        sys.exit(error.exit_code)
    except BrokenPipeError:
        # The reader of our output has gone, as `head` does: nothing is wrong.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(0)
