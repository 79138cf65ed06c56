"""A process for each question in SQL of the page: its memory is limited, and the page outlives it.

One that nobody waits for any more ends, so a query that runs away is stopped whatever it does.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import hybridlog
from hybridlog.sql.duck import limited_memory, shortage_of
from hybridlog_storage.errors import HybridlogError, ResourceError
from hybridlog_storage.stopping import check_wanted

if TYPE_CHECKING:
    from hybridlog.sql.views import Reading
    from hybridlog.store import Store

SQL_MEMORY: Final = 512 << 20
"""Bytes that DuckDB may use."""
SQL_ROWS: Final = 1000
_SQL_BYTES: Final = 32 << 20
SQL_COLUMNS: Final = 200
_MICROSECOND: Final = 1000  # ns
_POLL_S: Final = 0.05
_START: Final = (
    "import sys; sys.path[:] = {!r}; from hybridlog.view.sql_process import answer; answer({})"
)
_T = TypeVar("_T")


def in_process(store: Store, work: Callable[..., _T], *arguments: Any) -> _T:
    """Call a function of a module in a process, with the store and further arguments.

    These and the answer are pickled. It is given up when the caller is.
    """
    directory = store.directory
    place = directory.address, store.shared.index.wanted, directory.read_only
    paths = [str(Path(path).absolute()) for path in sys.path]
    with (
        TemporaryFile() as found,
        subprocess.Popen(  # noqa: S603 - our own module
            [sys.executable, "-c", _START.format(paths, found.fileno())],
            cwd="/",  # nothing in an answer says where this one runs
            stdin=subprocess.PIPE,  # which ends with this one
            stdout=subprocess.DEVNULL,
            pass_fds=[found.fileno()],
            start_new_session=True,  # Ctrl-C ends the page, which ends this process
        ) as child,
    ):
        assert child.stdin is not None
        try:
            with suppress(BrokenPipeError):
                child.stdin.write(pickle.dumps((place, work, arguments)))
                child.stdin.flush()
            while child.poll() is None:
                check_wanted()
                with suppress(subprocess.TimeoutExpired):
                    child.wait(_POLL_S)
        finally:
            child.kill()
        found.seek(0)
        try:
            is_answer, made = pickle.load(found)  # noqa: S301 - our own process wrote it
        except EOFError:
            raise ResourceError(
                "The process that answers SQL has ended, likely for want of memory: ask for less "
                "at a time, or ask in `hybridlog sql` with more --memory."
            ) from None
    if not is_answer:
        raise made
    return cast("_T", made)


def answer(handle: int) -> None:
    """Answer what comes on standard input into an open file."""
    place, work, arguments = pickle.load(sys.stdin.buffer)  # noqa: S301 - the page wrote it
    threading.Thread(target=_until_alone, daemon=True).start()
    found = _answer(place, work, arguments)
    with os.fdopen(handle, "wb") as file:
        file.write(pickle.dumps(found))
    os._exit(0)


def _until_alone() -> None:
    """End this process with the other side, whatever a query does."""
    os.read(0, 1)
    os._exit(0)


def _answer(place: Any, work: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Whether there is an answer, and that, or the error."""
    path, mongo, read_only = place
    try:
        with hybridlog.open(path, mongo=mongo, read_only=read_only) as store:
            store.sql_engine.connect(SQL_MEMORY).query("select 1").to_arrow()  # loads what it needs
            with limited_memory(SQL_MEMORY):
                return True, work(store.snapshot(), *arguments)
    except HybridlogError as error:
        return False, error
    except Exception as error:
        shortage = shortage_of(error, SQL_MEMORY)
        if shortage is None:
            traceback.print_exc()
        return False, shortage or RuntimeError(repr(error))


# What is asked.


def sql_answer(store: Store, text: str, seconds: float) -> dict[str, Any]:
    """The first rows of a query, worked out in the process for SQL."""
    from hybridlog.frames.lines import shown

    with closing(store.sql_engine.connect(SQL_MEMORY, only_reads=True)) as connection:
        answer = connection.query(text, timeout=seconds)
        table, is_cut = answer.first(SQL_ROWS, _SQL_BYTES)
        body = f"    print(store.sql({text!r}).to_pandas())\n"
        found = shown(table, SQL_COLUMNS)
        found["at"], found["recordings"] = _moments(
            store, found.pop("times"), found["recordings"], answer.reading
        )
        return found | {
            "more": is_cut,
            "remarks": answer.sentences(),
            "python": program(store, body),
        }


def _moments(
    store: Store, times: Sequence[int | None], names: Sequence[str | None], read: Reading
) -> tuple[list[str | None], list[str | None]]:
    """The time since the start of its recording, ns, as text, and the recording of each row.

    Without a column `recording`, the recording is known if a single one was read. A row that
    lies in no recording has neither.
    """
    if not times:
        return [], []
    known = [entry.name for entry in read.recordings.values()]
    named = names or [known[0] if len(known) == 1 else None] * len(times)
    spans = {}
    for name in {*named} - {None}:
        with suppress(HybridlogError):  # there is no such recording, or it is damaged
            spans[name] = store.entry(str(name)).span
    found: list[str | None] = []
    for time, name in zip(times, named, strict=True):
        first, last = spans.get(name) or (0, -1)
        is_inside = time is not None and first <= time < last + _MICROSECOND
        found.append(str(min(time or 0, last) - first) if is_inside else None)
    return found, [name if at else None for name, at in zip(named, found, strict=True)]


def program(store: Store, body: str) -> str:
    """A program that opens a store; `body` is indented."""
    path = store.directory.place
    return f"import hybridlog as hl\n\nwith hl.open({path!r}) as store:\n{body}"
