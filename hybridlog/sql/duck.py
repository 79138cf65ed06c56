"""DuckDB as SQL on a store needs it: bounded, interruptible, without access to anything else."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from importlib import import_module
from math import inf
from pathlib import Path
from typing import Any, Final, TypeVar

from hybridlog_storage.errors import (
    HybridlogError,
    ResourceError,
    UsageError,
    extra,
)
from hybridlog_storage.stopping import at_safe_points, safe_point
from hybridlog_storage.threads import processors

MEMORY: Final = 1 << 30
"""Default limit of DuckDB's memory, bytes."""
MIN_MEMORY: Final = 64 << 20
"""Least limit of DuckDB's memory, bytes."""
_POLL_S: Final = 0.05
_SETTINGS: Final = {
    "allow_community_extensions": False,
    "allow_persistent_secrets": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "enable_external_access": False,
    "extension_directory": "none",
    "python_enable_replacements": False,
    "secret_directory": "none",
    "temp_directory": "",
}
_SHORTAGES: Final = ("Out of Memory", "Cannot allocate memory", "start new thread")
_T = TypeVar("_T")

OWN_MEMORY: Final = 512 << 20
"""Bytes that hybridlog may take beside DuckDB, on top of what the process has at the start."""


# What Arrow reserves would count as taken; it reads this when it is loaded.
os.environ.setdefault("MIMALLOC_ARENA_EAGER_COMMIT", "0")


def duckdb() -> Any:
    """The package, or a `MissingDependencyError`."""
    with extra("sql", "SQL needs DuckDB"):
        return import_module("duckdb")


def open_duckdb(memory: int) -> Any:
    """DuckDB in memory (at most so many bytes), which reads nothing but what is registered.

    Files, extensions, other databases and variables of Python are out of its reach, and no query
    can change its settings.
    """
    if memory < MIN_MEMORY:
        raise UsageError(f"SQL needs at least {MIN_MEMORY >> 20} MiB of memory.")
    settings = {**_SETTINGS, "memory_limit": f"{memory}B", "threads": processors()}
    base = duckdb().connect(":memory:", config=settings)
    base.execute("set global TimeZone = 'UTC'")
    base.execute("set global lock_configuration = true")
    return base


@contextmanager
def explained(memory: int, first: Callable[[], Exception | None] = lambda: None) -> Iterator[None]:
    """Turn errors of DuckDB into ours, or into the `first` of what it reads, which caused them.

    `memory` is its limit, bytes.
    """
    package = duckdb()
    try:
        yield
    except Exception as error:
        cause = first() if isinstance(error, package.Error) else None
        if isinstance(cause, HybridlogError):
            raise cause from None
        if isinstance(error, package.PermissionException):
            text = str(error).strip().partition("\n")[0]
            raise UsageError(
                "SQL reads the views of this store alone; files, extensions and other databases "
                f"are off. {text}"
            ) from error
        shortage = shortage_of(cause or error, memory)
        if shortage is not None:
            raise shortage from error
        if isinstance(error, package.Error):
            raise UsageError(str(cause or error).strip()) from error
        raise


def shortage_of(error: Exception, memory: int) -> ResourceError | None:
    """The error to raise for one of DuckDB, Arrow or the system that means too little memory.

    `memory` is the limit of DuckDB's memory, bytes.
    """
    is_short = isinstance(error, MemoryError | duckdb().OutOfMemoryException)
    if not is_short and not any(text in str(error) for text in _SHORTAGES):
        return None
    return ResourceError(
        f"The query needs more than {memory >> 20} MiB of memory: ask for less at a time, or "
        "allow more (`hybridlog sql --memory`)."
    )


class Worker:
    """Runs calls of one connection in a thread, so that Ctrl-C and timeouts interrupt them.

    The timeout is seconds for all calls, None for no limit.
    """

    def __init__(self, cursor: Any, timeout: float | None) -> None:
        self._cursor = cursor
        self._timeout = timeout
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="hybridlog-sql")
        self._until = time.monotonic() + (inf if timeout is None else timeout)

    def run(self, call: Callable[[], _T]) -> _T:
        """The result of a call; an error when the time is over, or it was stopped."""
        with at_safe_points():
            future: Future[_T] = self._pool.submit(call)
            try:
                while not wait([future], _POLL_S).done:
                    safe_point()  # Ctrl-C
                    if time.monotonic() >= self._until:
                        raise HybridlogError(
                            f"The query was stopped after {self._timeout:g} s: narrow it down, or "
                            "allow more."
                        )
            except BaseException:
                # A call that has not reached DuckDB yet does not notice.
                while not future.done():
                    with suppress(KeyboardInterrupt):  # pressed again
                        self._cursor.interrupt()
                        wait([future], _POLL_S)
                raise
            return future.result()

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(cancel_futures=True)


def private_bytes() -> int:
    """Bytes of private memory of this process, reserved ones included; 0 where it is unknown."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:"))


@contextmanager
def limited_memory(memory: int) -> Iterator[int]:
    """Limit what this process takes from now on, where the system can; yields the limit, bytes.

    `OWN_MEMORY` is on top of DuckDB's memory.
    """
    before, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = private_bytes() + memory + OWN_MEMORY
    most = wanted if before == resource.RLIM_INFINITY else min(wanted, before)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    try:
        yield most
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (before, hard))
