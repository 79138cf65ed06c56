"""Writes a bag of the simulated robot: `python -m hybridlog.demo robot.bag`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from hybridlog.demo.config import DEFAULT_DURATION_S, DEFAULT_SEED
from hybridlog.demo.write import write_bag
from hybridlog_storage.errors import HybridlogError


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m hybridlog.demo", description="Write a bag of a simulated robot."
    )
    parser.add_argument("path", type=Path, help="bag to write (a directory with --ros 2)")
    parser.add_argument("--duration", type=float, default=DEFAULT_DURATION_S, metavar="SECONDS")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--ros", type=int, choices=(1, 2), default=1)
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument("--compression", choices=("none", "lz4", "bz2"), default="none")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="write what is in it as JSON")
    options = parser.parse_args(arguments)

    try:
        summary = write_bag(
            options.path,
            duration_s=options.duration,
            seed=options.seed,
            ros=options.ros,
            storage=options.storage,
            compression=options.compression,
            progress=_bar if sys.stderr.isatty() else None,
        )
    except HybridlogError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    messages = sum(summary.messages.values())
    sys.stdout.write(
        f"{summary.path}: {options.duration:g} s of a robot's life, {messages} messages on"
        f" {len(summary.messages)} topics, {summary.size / 1e6:.1f} MB,"
        f" written in {summary.elapsed_s:.1f} s\n"
    )
    if options.truth is not None:
        options.truth.write_text(json.dumps(dict(summary.truth)) + "\n")
    return 0


def _bar(done: float, total: float) -> None:
    width = 30
    filled = round(width * done / total)
    end = "\r\x1b[K" if done >= total else ""
    sys.stderr.write(f"\r[{'#' * filled}{'.' * (width - filled)}] {done:.0f}/{total:.0f} s{end}")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
