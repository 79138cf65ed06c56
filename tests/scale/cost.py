"""What work costs, counted: the same on every machine."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.disk import files
from tests.servers.commands import commands


@dataclass
class Cost:
    """The cost of one piece of work.

    Attributes:
        commands: Commands that MongoDB got.
        written: Bytes written to files of the store.
        opened: Files and folders opened or listed, below the store.
        bytes_read: Bytes read from files of the store.
        looks: Files whose status was asked for.
        root: The store.
    """

    root: str
    commands: list[str] = field(default_factory=list)
    written: int = 0
    opened: list[str] = field(default_factory=list)
    bytes_read: int = 0
    looks: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """How many of each."""
        return {
            "commands": len(self.commands),
            "opened": len(self.opened),
        }


_heard: list[Cost] = []


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if _heard and event in {"open", "os.listdir", "os.scandir"}:
        path, cost = str(arguments[0]), _heard[-1]
        # A path without a folder is relative to one of the store's. Python's own files and the
        # socket and log of mongod, which is polled while it starts, are no cost of the work.
        if not path.startswith("/") or path.startswith(cost.root):
            cost.opened.append(path)


sys.addaudithook(_hear)


@contextmanager
def _counting_reads(cost: Cost) -> Iterator[None]:
    """Count what the calls return that segments, tables and manifests are read with."""
    status = os.stat

    def looked(*arguments: Any, **options: Any) -> Any:
        cost.looks += 1
        return status(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "stat", looked)
        for name in ("pread", "preadv", "read"):
            patch.setattr(os, name, _counted(getattr(os, name), cost))
        patch.setattr(files, "system", _CountedSystem(cost))
        yield


class _CountedSystem(files.System):
    """Counts the bytes that are written."""

    def __init__(self, cost: Cost) -> None:
        self._cost = cost

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        done = super().writev(fd, parts)
        self._cost.written += done
        return done


def _counted(read: Callable[..., Any], cost: Cost) -> Callable[..., Any]:
    def counted(*arguments: Any) -> Any:
        found = read(*arguments)
        cost.bytes_read += found if isinstance(found, int) else len(found)
        return found

    return counted


def cost_of(store: hl.Store, work: Callable[[], object]) -> Cost:
    """The cost of some work on an open store whose index is connected with `commands` heard."""
    cost = Cost(str(store.directory.path))
    with commands() as sent:
        _heard.append(cost)
        try:
            with _counting_reads(cost):
                work()
        finally:
            _heard.pop()
    cost.commands = [one.name for one in sent]
    return cost
