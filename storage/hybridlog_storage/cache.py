"""A cache of what was read or worked out, bounded in bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Final, Literal, TypeAlias, TypeVar, cast

MAX_BYTES: Final = 224 << 20

Kind: TypeAlias = Literal[
    "chunk", "chunks", "column", "matches", "rebuilt", "table", "times", "videos"
]
Value = TypeVar("Value")


class Cache:
    """Values that can be made again. Thread safe; so must be the values.

    A key is the kind of value and all that the value depends on, such as a digest.
    Those that were not used for longest make room for others.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self.max_bytes = max_bytes
        self._values: OrderedDict[tuple[Hashable, ...], tuple[Any, int]] = OrderedDict()
        self._size = 0
        self._lock = threading.Lock()

    def made(
        self,
        kind: Kind,
        *key: Hashable,
        make: Callable[[], Value],
        size_of: Callable[[Value], int],
    ) -> Value:
        """A value that is made where it is not there; one that is too large is not kept."""
        name = (kind, *key)
        with self._lock:
            if name in self._values:
                self._values.move_to_end(name)
                return cast("Value", self._values[name][0])
        found = make()
        with self._lock:
            self._remove(name)
            self._values[name] = found, size_of(found)
            self._size += self._values[name][1]
            if self._values[name][1] > self.max_bytes:
                self._remove(name)
            while self._size > self.max_bytes:
                self._remove(next(iter(self._values)))
        return found

    def drop(self, kind: Kind, *begin: Hashable) -> None:
        """Forget the values of a kind, or those whose keys begin so."""
        with self._lock:
            wanted = (kind, *begin)
            for key in [key for key in self._values if key[: len(wanted)] == wanted]:
                self._remove(key)

    def _remove(self, key: tuple[Hashable, ...]) -> None:
        if key in self._values:
            self._size -= self._values.pop(key)[1]
