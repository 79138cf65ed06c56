"""The loop of `record --watch`, `copy --watch` and `index watch`."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterable
from typing import Final

from hybridlog.cli import output
from hybridlog.cli.signals import Stopped
from hybridlog_storage.errors import (
    BucketError,
    DatabaseError,
    HybridlogError,
    ResourceError,
    StoreError,
)
from hybridlog_storage.stopping import at_safe_points, pause, safe_point

_AWAY: Final = (BucketError, DatabaseError, ResourceError, StoreError)
"""What may be over at a later look."""
_LONGER: Final = 5
"""Pause after such an error, as a multiple of the usual one."""


def watch(
    place: object,
    look: Callable[[], Iterable[HybridlogError]],
    *,
    pause_s: float = 2.0,
    report: Callable[[HybridlogError], None] = lambda error: output.note(str(error)),
) -> None:
    """Call `look`, which acts and yields problems, again and again; a signal ends this normally.

    A problem is reported once, as long as it lasts. While a place or a database is away, the pause
    is longer.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file and a pipe show each line at once
        sys.stdout.reconfigure(line_buffering=True)
    told: set[str] = set()  # problems that last
    try:
        with at_safe_points():
            output.remarks([f"Watching {place}. Ctrl-C ends it."])
            while True:
                met, wait_s = set[str](), pause_s
                try:
                    for problem in look():
                        met.add(str(problem))
                        if str(problem) not in told:
                            report(problem)
                except _AWAY as error:
                    safe_point()  # Ctrl-C may have ended a program that the other side needs
                    wait_s = _LONGER * pause_s
                    if str(error) not in told:
                        report(error)
                        output.note(f"The next try is in {wait_s:g} s.")
                    met |= {*told, str(error)}
                told = met
                pause(wait_s)
    except Stopped as stopped:
        output.notes(filter(None, [stopped.consequence]))
