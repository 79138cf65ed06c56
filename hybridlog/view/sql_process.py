"""The process that answers SQL for the page: its memory is limited, and the page outlives it."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.reduction import send_handle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

from hybridlog_storage.errors import ResourceError
from hybridlog_storage.stopping import check_wanted

if TYPE_CHECKING:
    from hybridlog.store import Store

_POLL_S: Final = 0.05
_START: Final = (
    "import sys; sys.path[:] = {!r}; from hybridlog.view.sql_server import serve; serve({})"
)
_T = TypeVar("_T")


class SqlProcess:
    """Answers by one process, which starts when it is needed, and again when it has ended.

    It ends with this object, or with the process that has it, and opens the store for itself.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._control: Connection[Any, Any] | None = None

    def ask(self, work: Callable[..., _T], *arguments: Any) -> _T:
        """Call a function of a module in the process, with a `Context` of it and further arguments.

        These and the answer are pickled. It is given up when the caller is; a process that ends
        twice is an error.
        """
        for _ in range(2):
            with suppress(EOFError, ConnectionError):
                is_answer, found = self._answer_of((work, arguments))
                if is_answer:
                    return cast("_T", found)
                raise found
        raise ResourceError(
            "The process that answers SQL has ended, likely for want of memory: ask for less at a "
            "time, or ask in `hybridlog sql` with more --memory."
        )

    def _answer_of(self, call: Any) -> Any:
        ours, theirs = Pipe()
        with ours:
            with theirs, self._lock:
                try:
                    self._send(theirs)
                except ConnectionError:  # it has ended
                    self._control = None
                    self._send(theirs)
            ours.send(call)
            while not ours.poll(_POLL_S):
                check_wanted()
            return ours.recv()

    def _send(self, theirs: Connection[Any, Any]) -> None:
        if self._control is None:
            self._control, control = Pipe()
            places = [str(Path(place).absolute()) for place in sys.path]
            with control:
                child = subprocess.Popen(  # noqa: S603 - our own module
                    [sys.executable, "-c", _START.format(places, control.fileno())],
                    cwd="/",  # nothing in an answer says where this one runs
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=[control.fileno()],
                    start_new_session=True,  # Ctrl-C ends the page, which ends this process
                )
            threading.Thread(target=child.wait, daemon=True).start()
            mongo = self._store.shared.index.wanted
            directory = self._store.directory
            self._control.send((directory.address, mongo, directory.read_only))
        send_handle(self._control, theirs.fileno(), None)
