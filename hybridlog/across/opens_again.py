"""Data sets over an open store that other processes can use."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from hybridlog.query.counters import Counters

if TYPE_CHECKING:
    from hybridlog.session import Session


class OpenedStore(Protocol):
    """A store that a process has opened for itself."""

    @property
    def session(self) -> Session:
        """Its state."""


class OpensAgain:
    """A data set that can be pickled: each process opens the store for itself.

    Args:
        session: The open store.
        open_again: Opens it in another process.

    Attributes:
        counters: What reading has cost in this process.
    """

    def __init__(self, session: Session, open_again: Callable[[], OpenedStore]) -> None:
        self.counters = Counters()
        self._open_again = open_again
        self._session: Session | None = session

    def __getstate__(self) -> dict[str, Any]:
        """All but the open store."""
        state = vars(self).copy()
        state.update(_session=None, counters=Counters())
        return state

    def _opened(self) -> Session:
        """The store, opened by this process."""
        if self._session is None:
            self._session = self._open_again().session
        return self._session
