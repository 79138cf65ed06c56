"""Values that are computed or imported at first use, and a cache of them, bounded in bytes."""

from __future__ import annotations

import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from importlib import import_module
from importlib.util import find_spec
from threading import RLock
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, Generic, Literal, TypeAlias, TypeVar, cast

if TYPE_CHECKING:
    import numpy as np


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


_T = TypeVar("_T")


class lazy(Generic[_T]):  # noqa: N801 - a decorator
    """Computes an attribute at its first use; threads may compute it twice, and keep one value."""

    def __init__(self, compute: Callable[[Any], _T]) -> None:
        self._compute = compute
        self._name = compute.__name__
        self.__doc__ = compute.__doc__

    def __get__(self, owner: Any, kind: type) -> _T:
        """The value, from now on in the object itself."""
        if owner is None:
            return cast("_T", self)
        return cast("_T", vars(owner).setdefault(self._name, self._compute(owner)))


class RowType:
    """The type of rows with named numbers, which numpy takes as a `dtype`."""

    def __init__(self, *fields: tuple[str, str]) -> None:
        self._fields = fields
        self.names: Sequence[str] = [name for name, _ in fields]
        self.itemsize = sum(int(kind[-1]) for _, kind in fields)

    @lazy
    def dtype(self) -> np.dtype[np.void]:
        """The type of numpy."""
        import numpy as np

        return np.dtype([*self._fields])


_NUMPY: Final = "numpy"
_LOCK: Final = RLock()


class _LateNumpy(ModuleType):
    """Stands for numpy until something of it is used."""

    def __getattr__(self, name: str) -> Any:
        """Import it, and be like it from now on."""
        with _LOCK:
            if sys.modules.get(_NUMPY) is self:
                del sys.modules[_NUMPY]
            vars(self).update(vars(import_module(_NUMPY)))
            self.__class__ = ModuleType  # type: ignore[assignment]
        return getattr(self, name)


def import_numpy_late() -> None:
    """Import numpy in this process when something of it is used: it takes 0.1 s."""
    if _NUMPY not in sys.modules and (spec := find_spec(_NUMPY)) is not None:
        sys.modules[_NUMPY] = _LateNumpy(_NUMPY)
        sys.modules[_NUMPY].__spec__ = spec
