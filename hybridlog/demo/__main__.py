"""Writes a bag of the simulated robot: `python -m hybridlog.demo robot.bag`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from hybridlog.demo.tour import DEFAULT_DURATION_S, DEFAULT_SEED
from hybridlog.demo.write import write_bag
from hybridlog_storage.errors import HybridlogError


def main() -> int:
    """Run the command; returns the exit code."""
    parser = argparse.ArgumentParser("python -m hybridlog.demo", description=__doc__)
    parser.add_argument("path", type=Path, help="bag to write (a directory with --ros 2)")
    parser.add_argument("--duration", type=float, default=DEFAULT_DURATION_S, metavar="SECONDS")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--ros", type=int, choices=(1, 2), default=1)
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument("--compression", choices=("none", "lz4", "bz2"), default="none")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="write facts about it as JSON")
    options = vars(parser.parse_args())
    duration_s, truth = options.pop("duration"), options.pop("truth")
    began = time.monotonic()
    try:
        summary = write_bag(duration_s=duration_s, **options)
    except HybridlogError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    messages = sum(summary.messages.values())
    sys.stdout.write(
        f"{summary.path}: {duration_s:g} s of a robot's life, {messages} messages on"
        f" {len(summary.messages)} topics, {summary.size / 1e6:.1f} MB,"
        f" written in {time.monotonic() - began:.1f} s\n"
    )
    if truth is not None:
        truth.write_text(json.dumps(summary.truth) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
