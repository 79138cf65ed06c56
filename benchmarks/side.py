"""One side of a comparison, in a process of its own.

`run_side` starts `python -m benchmarks.side MODULE:FUNCTION`, gives the arguments on
standard input and takes the result from standard output, both as JSON. The process has
its own peak memory and its own caches, and ends with all that it has started.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

Values = dict[str, Any]
"""What a side takes and gives: numbers, strings, lists and dicts of them."""

LINGER_S = 0.1
"""Seconds for which a mongod stays after its last user."""

_WARM_BLOCK = 1 << 20
_ROOT = Path(__file__).parents[1]


class SideError(Exception):
    """A side has failed; the message ends with what it wrote to standard error."""


def run_side(function: str, arguments: Mapping[str, object], warm: Sequence[Path] = ()) -> Values:
    """Run one side and wait for it.

    Args:
        function: `module:name`; called with `arguments` as keywords, returns `Values`.
        arguments: Values that JSON can hold.
        warm: Files and directories to read into the file cache before.

    Returns:
        What the function returned, and `peak_rss`, bytes.

    Raises:
        SideError: The process failed.
    """
    warm_cache(warm)
    environment = {**os.environ, "HYBRIDLOG_MONGOD_LINGER_S": str(LINGER_S)}
    for name in ("HYBRIDLOG_STORE", "HYBRIDLOG_MONGO_URI"):
        environment.pop(name, None)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.side", function],
        input=json.dumps(dict(arguments)),
        capture_output=True,
        text=True,
        cwd=_ROOT,
        env=environment,
        check=False,
    )
    if done.returncode:
        raise SideError(f"{function} failed:\n{done.stderr[-4000:].strip()}")
    result: Values = json.loads(done.stdout.splitlines()[-1])
    return result


def warm_cache(places: Sequence[Path]) -> None:
    """Read files, and all files of directories, so that they are in the file cache."""
    buffer = bytearray(_WARM_BLOCK)
    for place in places:
        for file in [place] if place.is_file() else sorted(place.rglob("*")):
            if file.is_file():
                with file.open("rb", buffering=0) as stream:
                    while stream.readinto(buffer):
                        pass


def _main() -> None:
    from benchmarks.usage import own_peak

    module, _, name = sys.argv[1].partition(":")
    result: Values = getattr(import_module(module), name)(**json.load(sys.stdin))
    print(json.dumps({**result, "peak_rss": own_peak()}))


if __name__ == "__main__":
    _main()
