"""A function in a process of its own, and the end of all that the process has started.

`run_side` starts `python -m benchmarks.side MODULE:FUNCTION`, gives the arguments on
standard input and takes the result from standard output, both as JSON. The process has its
own peak memory and its own caches.

It runs in a session of its own, so that Ctrl-C in a terminal reaches only whoever waits for
it. That one then asks the side to end, which ends its backend's servers; what is left after a
while is ended by force. Servers leave the session, so they are found by the run's directory,
which stands in the environment of all that a run starts.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.usage import marked

Values = dict[str, Any]
"""What a side takes and gives: numbers, strings, lists and dicts of them."""

LINGER_S = 0.1
"""Seconds for which a mongod stays after its last user."""
_WARM_BLOCK = 1 << 20

MARK = "HYBRIDLOG_BENCHMARK_RUN"
"""Environment variable of all processes of a run: its directory."""

_GRACE_S = 20.0
_LEAVE_S = 60.0
_LEAVE_CRASHED_S = 10.0
_LOOK_S = 0.05
_ROOT = Path(__file__).parents[1]


class SideError(Exception):
    """A side has crashed or taken too long; the message says how it ended."""


def run_side(
    function: str, arguments: Mapping[str, object], directory: Path, timeout_s: float
) -> Values:
    """Run a side to its end; see that nothing which it has started stays behind."""
    output, errors = directory / "side.out", directory / "side.err"
    environment = {
        **os.environ,
        MARK: str(directory),
        "HYBRIDLOG_MONGOD_LINGER_S": str(LINGER_S),
    }
    for name in ("HYBRIDLOG_STORE", "HYBRIDLOG_MONGO_URI"):
        environment.pop(name, None)
    # Files, no pipes: a server that inherits them and stays would keep a pipe open.
    with output.open("wb") as out, errors.open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.side", function],
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=err,
            cwd=_ROOT,
            env=environment,
            start_new_session=True,
        )
        try:
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin as stream:
                stream.write(json.dumps(dict(arguments)).encode())
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            _end(process)
            raise SideError(f"it was ended after {timeout_s:.0f} s") from None
        finally:
            _end(process)
            _end_left(str(directory), _LEAVE_S if process.returncode == 0 else _LEAVE_CRASHED_S)
    text = output.read_bytes().decode(errors="replace").splitlines()
    if process.returncode or not text:
        raise SideError(_how_it_ended(process.returncode, errors))
    try:
        values: Values = json.loads(text[-1])
    except ValueError:
        raise SideError(f"its last line is no result: {text[-1][:200]!r}") from None
    return values


def _end_left(mark: str, patience_s: float) -> None:
    """Wait until no process of a run is left; end those that stay longer than they may."""
    if _all_gone(mark, patience_s):
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        for pid in marked(MARK, mark):
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, number)
        if _all_gone(mark, _GRACE_S):
            return


def _all_gone(mark: str, patience_s: float) -> bool:
    deadline = time.monotonic() + patience_s
    while marked(MARK, mark):
        if time.monotonic() > deadline:
            return False
        time.sleep(_LOOK_S)
    return True


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask a side to end, then make it and all of its session end."""
    try:
        if process.poll() is None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(_GRACE_S)
    finally:
        # Also when a second Ctrl-C finds that the first one takes too long.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _how_it_ended(code: int, errors: Path) -> str:
    said = errors.read_bytes()[-4000:].decode(errors="replace").strip()
    if code < 0:
        with suppress(ValueError):
            return f"it was killed by {signal.Signals(-code).name}. {said[-500:]}".strip()
    # Of a traceback the last line says what, the lines before it where.
    return f"it crashed: {said[-1500:] or f'exit code {code}'}"


def warm_cache(file: Path) -> None:
    """Read a file, so that it is in the file cache."""
    buffer = bytearray(_WARM_BLOCK)
    with file.open("rb", buffering=0) as stream:
        while stream.readinto(buffer):
            pass


def spelled(kind: type) -> str:
    """A class as `module:class`, for another process."""
    return f"{kind.__module__}:{kind.__qualname__}"


def named(name: str) -> Any:
    """What is called `module:name`."""
    module, _, name = name.partition(":")
    return getattr(import_module(module), name)


def _main() -> None:
    from benchmarks.usage import own_peak

    result: Values = named(sys.argv[1])(**json.load(sys.stdin))
    print(json.dumps({**result, "peak_rss": own_peak()}))


if __name__ == "__main__":
    _main()
