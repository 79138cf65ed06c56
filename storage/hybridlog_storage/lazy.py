"""A lazy attribute without a lock: before Python 3.12, the one of functools can outlive a fork."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar, cast

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
