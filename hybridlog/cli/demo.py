"""`hybridlog demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.options import PATH


@dataclass(frozen=True, kw_only=True)
class _Given:
    directory: Path = argument(
        type=PATH,
        default=Path("hybridlog-demo"),
        metavar="[DIRECTORY]",
        help="Directory for the bag and the store of the demo.",
    )
    duration: float = option(
        "--duration",
        type=click.FloatRange(min=5),
        default=60.0,
        metavar="SECONDS",
        help="Seconds of robot time.",
    )
    seed: int = option(
        "--seed", type=int, default=1, metavar="N", help="Another number gives another drive."
    )


@command(_Given)
def demo_command(given: _Given) -> int:
    """Take a tour: simulate a robot, record it, query it."""
    from hybridlog.demo import tour

    return tour.run(given.directory, duration_s=given.duration, seed=given.seed)
