"""`hybridlog demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hybridlog.cli.binder import argument, command


@dataclass(frozen=True, kw_only=True)
class _Given:
    directory: Path = argument(
        "Directory for the bag and the store of the demo.",
        "[DIRECTORY]",
        default=Path("hybridlog-demo"),
    )


@command(_Given)
def demo_command(given: _Given) -> int:
    """Take a tour: record the log of a simulated robot, query it."""
    from hybridlog.demo import tour

    return tour.run(given.directory)
