"""Writes a bag of the simulated robot: `python -m benchmarks.simulator robot.bag`."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from benchmarks.simulator.write import DEFAULT_DURATION_S, DEFAULT_SEED, write_bag, write_demo


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser("python -m benchmarks.simulator", description=__doc__)
    parser.add_argument("path", type=Path, help="bag to write")
    parser.add_argument("--duration", type=float, default=DEFAULT_DURATION_S, metavar="SECONDS")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument(
        "--demo",
        action="store_true",
        help="write the bag that is in the package, and its counts as JSON; no other option counts",
    )
    options = vars(parser.parse_args())
    is_demo, path, duration_s = (options.pop(name) for name in ("demo", "path", "duration"))
    began = time.monotonic()
    summary = write_demo(path) if is_demo else write_bag(path, duration_s=duration_s, **options)
    sys.stdout.write(
        f"{summary.path}: {sum(summary.messages.values())} messages on"
        f" {len(summary.messages)} topics, {summary.size / 1e6:.1f} MB,"
        f" written in {time.monotonic() - began:.1f} s\n"
    )


if __name__ == "__main__":
    main()
