"""The exit codes of the command line, with their meanings."""

from __future__ import annotations

from typing import Final

from hybridlog_storage.errors import NO_SPACE, DiskFullError, HybridlogError

INTERNAL: Final = 70

EXIT_CODES: Final = {
    0: "done",
    1: "verify found something, or an error that has no code of its own",
    2: "wrong usage: an option, a topic, a time or a predicate",
    3: "a log that cannot be read, or a robot that was never reached",
    4: "a damaged log, or lost messages: the rest is stored",
    5: "the store is missing, read-only, damaged, or of a newer format",
    6: "MongoDB does not answer, or died",
    7: "no space left on the disk, or too few file handles or too little memory",
    8: "this content is in the store already",
    9: "an optional package is missing",
    10: "no fields: the message definition does not give them",
    11: "--strict: messages of the asked range are lost, or not written yet",
    INTERNAL: "an error in hybridlog itself",
    130: "interrupted (Ctrl-C): undone, or finished by a later command",
    143: "ended (SIGTERM): undone, or finished by a later command",
}


def of_os_error(error: OSError) -> int:
    """The code for an operating system error that the library has not mapped."""
    return DiskFullError.exit_code if error.errno in NO_SPACE else HybridlogError.exit_code


def as_text() -> str:
    """The table for help texts, one code a line."""
    return "\n".join(f"  {code:>3}  {meaning}" for code, meaning in EXIT_CODES.items())
