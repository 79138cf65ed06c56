"""`hybridlog demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from hybridlog.cli.binder import argument, command, option


@dataclass(frozen=True, kw_only=True)
class _Given:
    directory: Path = argument(
        "Directory for the bag and the store of the demo.",
        "[DIRECTORY]",
        default=Path("hybridlog-demo"),
    )
    duration: float = option(
        "Seconds of robot time.", "SECONDS", type=click.FloatRange(min=5), default=60.0
    )
    seed: int = option("Another number gives another drive.", "N", default=1)


@command(_Given)
def demo_command(given: _Given) -> int:
    """Take a tour: simulate a robot, record it, query it."""
    from hybridlog.demo import tour

    return tour.run(given.directory, duration_s=given.duration, seed=given.seed)
