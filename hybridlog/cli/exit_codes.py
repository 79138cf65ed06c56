"""What the exit code of the command line means."""

from __future__ import annotations

from typing import Final

from hybridlog_storage.errors import NO_SPACE, DiskFullError, HybridlogError

INTERNAL: Final = 70

EXIT_CODES: Final = {
    0: "done",
    1: "verify found something, or an error that has no code of its own",
    2: "the question is wrong: an option, a topic, a time, a predicate",
    3: "a log that cannot be read at all, or a robot that was never reached",
    4: "a damaged log, or messages that could not be kept: what could be read is stored",
    5: "the store: missing, read-only, damaged, of a newer format",
    6: "MongoDB does not answer, or died",
    7: "no space left on the disk",
    8: "this content is in the store already",
    9: "an optional package is missing",
    10: "fields are asked for that a message definition does not give",
    INTERNAL: "a mistake in hybridlog itself",
    130: "interrupted (Ctrl-C): taken back, or finished by a later command",
    143: "ended (SIGTERM): taken back, or finished by a later command",
}


def of_os_error(error: OSError) -> int:
    """The code for an error of the system's that the library has not mapped."""
    return DiskFullError.exit_code if error.errno in NO_SPACE else HybridlogError.exit_code


def as_text() -> str:
    """The table for help texts, one code a line."""
    return "\n".join(f"  {code:>3}  {meaning}" for code, meaning in EXIT_CODES.items())
