"""`hybridlog demo`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options


@click.command()
@click.argument(
    "directory",
    type=options.PATH,
    default=Path("hybridlog-demo"),
    metavar="[DIRECTORY]",
    help="Directory for the bag and the store of the demo.",
)
@click.option(
    "--duration",
    type=click.FloatRange(min=5),
    default=60.0,
    metavar="SECONDS",
    help="Seconds of robot time.",
)
@click.option(
    "--seed", type=int, default=1, metavar="N", help="Another number gives another drive."
)
def demo_command(*, directory: Path, duration: float, seed: int) -> int:
    """Take a tour: simulate a robot, record it, query it."""
    from hybridlog.demo import tour

    return tour.run(directory, duration_s=duration, seed=seed)
