"""The process that answers SQL for the page: its memory is limited, and the page outlives it.

It answers one question at a time. One that nobody waits for any more ends with its process, so
a query that runs away is stopped whatever it does.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import hybridlog
from hybridlog.sql.duck import OWN_MEMORY, limited_memory, private_bytes, shortage_of
from hybridlog_storage.errors import HybridlogError, ResourceError
from hybridlog_storage.stopping import check_wanted, held

if TYPE_CHECKING:
    from hybridlog.store import Store

SQL_MEMORY: Final = 512 << 20
"""Bytes that DuckDB may use."""
_POLL_S: Final = 0.05
_START: Final = (
    "import sys; sys.path[:] = {!r}; from hybridlog.view.sql_process import serve; serve({})"
)
_T = TypeVar("_T")


class SqlProcess:
    """Answers by one process, which starts when it is needed, and again when it has ended.

    It ends with this object, or with the process that has it, and opens the store for itself.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._pipe: Connection[Any, Any] | None = None
        self._child: subprocess.Popen[bytes] | None = None

    def ask(self, work: Callable[..., _T], *arguments: Any) -> _T:
        """Call a function of a module in the process, with its store and further arguments.

        These and the answer are pickled. It is given up when the caller is; a process that ends
        twice is an error.
        """
        with held(self._lock):
            for _ in range(2):
                try:
                    is_answer, found = self._answer_of((work, arguments))
                except (EOFError, ConnectionError):
                    self._end()
                except BaseException:
                    self._end()
                    raise
                else:
                    if is_answer:
                        return cast("_T", found)
                    raise found
        raise ResourceError(
            "The process that answers SQL has ended, likely for want of memory: ask for less at a "
            "time, or ask in `hybridlog sql` with more --memory."
        )

    def _answer_of(self, call: Any) -> Any:
        pipe = self._pipe or self._begin()
        pipe.send(call)
        while not pipe.poll(_POLL_S):
            check_wanted()
        return pipe.recv()

    def _begin(self) -> Connection[Any, Any]:
        self._pipe, theirs = Pipe()
        places = [str(Path(place).absolute()) for place in sys.path]
        with theirs:
            self._child = subprocess.Popen(  # noqa: S603 - our own module
                [sys.executable, "-c", _START.format(places, theirs.fileno())],
                cwd="/",  # nothing in an answer says where this one runs
                stdin=subprocess.PIPE,  # which ends with this one
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C ends the page, which ends this process
            )
        threading.Thread(target=_waited, args=[self._child], daemon=True).start()
        directory = self._store.directory
        mongo = self._store.shared.index.wanted
        self._pipe.send((directory.address, mongo, directory.read_only))
        return self._pipe

    def _end(self) -> None:
        if self._pipe is not None and self._child is not None:
            self._pipe.close()
            self._child.kill()
        self._pipe = None


def _waited(child: subprocess.Popen[bytes]) -> None:
    """Wait for the end of a process: until then its standard input is open."""
    child.wait()
    assert child.stdin is not None
    child.stdin.close()


def _until_alone() -> None:
    """End this process with the other side, whatever a query does."""
    os.read(0, 1)
    os._exit(0)


def serve(handle: int) -> None:
    """Answer until the other side has gone."""
    threading.Thread(target=_until_alone, daemon=True).start()
    with Connection(handle) as caller, suppress(EOFError, ConnectionError):
        path, mongo, read_only = caller.recv()
        try:
            store = hybridlog.open(path, mongo=mongo, read_only=read_only)
            store.sql_engine.connect(SQL_MEMORY).query("select 1").to_arrow()  # loads what it needs
        except HybridlogError as error:
            caller.recv()
            caller.send((False, error))
            return  # the next process may be able to open it
        with limited_memory(SQL_MEMORY) as most:
            while private_bytes() <= most - OWN_MEMORY // 2:  # else a new process has it all
                caller.send(_answer(store, *caller.recv()))


def _answer(store: Store, work: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Whether there is an answer, and that, or the error."""
    try:
        store.refresh()
        return True, work(store.snapshot(), *arguments)
    except HybridlogError as error:
        return False, error
    except Exception as error:
        shortage = shortage_of(error, SQL_MEMORY)
        if shortage is None:
            traceback.print_exc()
        return False, shortage or RuntimeError(repr(error))
