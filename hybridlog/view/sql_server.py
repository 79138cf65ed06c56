"""The process that answers SQL for the page."""

from __future__ import annotations

import threading
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle
from typing import Any

import hybridlog
from hybridlog.sql.duck import OWN_MEMORY, limited_memory, private_bytes, shortage_of
from hybridlog.view.context import SQL_MEMORY, Context
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.stopping import GivenUpError, until_given_up


class _GivenUp(threading.Event):
    """Is set once the other side has closed the connection."""

    def __init__(self, caller: Connection[Any, Any]) -> None:
        super().__init__()
        self._caller = caller

    def is_set(self) -> bool:
        return self._caller.poll()


def serve(handle: int) -> None:
    """Answer until the other side has gone."""
    with Connection(handle) as control, suppress(EOFError):
        path, mongo, read_only = control.recv()
        context = _opened(path, mongo, read_only=read_only)
        with limited_memory(SQL_MEMORY) as most:
            while True:
                caller = Connection(recv_handle(control))
                if private_bytes() > most - OWN_MEMORY // 2:
                    break  # free memory may stay reserved: a new process has it all
                threading.Thread(target=_answer, args=(context, caller)).start()
                if isinstance(context, HybridlogError):
                    break  # the next process may be able to open it


def _opened(path: str, mongo: str | None, *, read_only: bool) -> Context | HybridlogError:
    """The open store with all that a query loads, or why there is none."""
    try:
        store = hybridlog.open(path, mongo=mongo, read_only=read_only)
        store.sql_engine.connect(SQL_MEMORY).query("select 1").to_arrow()
    except HybridlogError as error:
        return error
    return Context(store)


def _answer(context: Context | HybridlogError, caller: Connection[Any, Any]) -> None:
    with caller, suppress(EOFError, ConnectionError, GivenUpError):
        work, arguments = caller.recv()
        if isinstance(context, HybridlogError):
            caller.send((False, context))
            return
        try:
            context.refresh(0.0)
            with until_given_up(_GivenUp(caller)):
                answer = True, work(context, *arguments)
        except HybridlogError as error:
            answer = False, error
        except Exception as error:
            shortage = shortage_of(error, SQL_MEMORY)
            if shortage is None:
                traceback.print_exc()
            answer = False, shortage or RuntimeError(repr(error))
        caller.send(answer)
