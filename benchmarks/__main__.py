"""`python -m benchmarks COMMAND …`: the studies and their report."""

from __future__ import annotations

import sys
from importlib import import_module

_WITH_OPTIONS_OF_THEIR_OWN = ("live",)


def main(arguments: list[str], program: str = "python -m benchmarks") -> int:
    """Run the command that the arguments name.

    Args:
        arguments: Without the program's name.
        program: How it was called, for messages.

    Returns:
        The exit code: 0; 1 when a run failed or answers differ; 2 for wrong usage; 130
        after Ctrl-C; and those of `hybridlog` for what its parts raise.
    """
    if arguments and arguments[0] in _WITH_OPTIONS_OF_THEIR_OWN:
        module = import_module(f"benchmarks.{arguments[0]}.command")
        return int(module.main(arguments[1:]))
    from benchmarks.command import main as command

    return command(arguments, program)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
