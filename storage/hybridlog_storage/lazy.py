"""Objects made at their first use: attributes, types of rows, and the import of numpy.

The attribute has no lock: before Python 3.12, the one of functools is one for all objects.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from threading import RLock
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar, cast

if TYPE_CHECKING:
    import numpy as np

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
