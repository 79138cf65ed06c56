"""Workers that are forked while other threads of this process read: they never hang."""

from __future__ import annotations

import ast
import importlib
import os
import signal
import sys
import textwrap
import threading
import traceback
import types
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.schema import ros_codec
from hybridlog_storage.buffers import buffers
from hybridlog_storage.lazy import lazy
from hybridlog_storage.messages import Channel, Schema
from tests.imports import modules

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")

SECONDS = 60
COUNT = 200
LOCKS = (type(threading.Lock()), type(threading.RLock()))


def in_child(work: Callable[[], Any]) -> None:
    """Do something in a forked process, which a signal ends if it hangs."""
    child = os.fork()
    if not child:
        signal.alarm(SECONDS)
        try:
            work()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status == 0, "it hangs" if status == -signal.SIGALRM else status


@contextmanager
def beside(work: Callable[[threading.Event, threading.Event], Any]) -> Iterator[None]:
    """Work of another thread, from its first event until the block ends."""
    begun, over = threading.Event(), threading.Event()
    thread = threading.Thread(target=work, args=(begun, over))
    thread.start()
    try:
        assert begun.wait(SECONDS)
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def held(*locks: Any) -> Iterator[None]:
    """Locks that another thread holds."""

    def hold(begun: threading.Event, over: threading.Event) -> None:
        with ExitStack() as stack:
            for lock in locks:
                stack.enter_context(lock)
            begun.set()
            over.wait(SECONDS)

    with beside(hold):
        yield


def locks_of(thing: object, seen: dict[int, object]) -> Iterator[Any]:
    """All locks that an object of this project has, directly or in what it has."""
    if id(thing) in seen:
        return
    seen[id(thing)] = thing
    if isinstance(thing, LOCKS):
        yield thing
    elif isinstance(thing, dict):
        for one in list(thing.values()):
            yield from locks_of(one, seen)
    elif isinstance(thing, list | tuple | set):
        for one in list(thing):
            yield from locks_of(one, seen)
    elif type(thing).__module__.startswith("hybridlog") and not isinstance(thing, type):
        names = [n for kind in type(thing).__mro__ for n in vars(kind).get("__slots__", ())]
        for name in [*getattr(thing, "__dict__", ()), *names]:
            yield from locks_of(getattr(thing, name, None), seen)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("forks") / "store", create=True) as store:
        with store.start("run") as recording:
            for topic in ("/a", "/b"):
                schema = Schema("std_msgs/Header", "ros1msg", b"uint32 seq\ntime stamp\n")
                channel = Channel(topic, "ros1", schema)
                for n in range(COUNT):
                    body = n.to_bytes(4, "little") + bytes(8)
                    recording.write(channel, body, log_time=1 + n * 10**6)
        yield store


def read(store: hl.Store, synced: Any) -> None:
    """All ways to read in a worker."""
    query = store.topic("/a").where("seq < 50")
    assert query.count() == len(query.to_pandas()) == 50
    assert [m.decode().seq for m in query] == list(range(50))
    assert store.topic("/a").at(10**6 + 1).decode().seq == 1
    assert len(synced) == COUNT
    assert [m.decode().seq for m in synced[7]] == [7, 7]
    assert len(store.align("/a", ["/b"], clock="log").to_pandas()) == COUNT
    assert store.sql('select count(*) from a where "seq" < 50').rows() == [(50,)]


def test_a_worker_reads_while_threads_hold_every_lock_of_the_store(store: hl.Store) -> None:
    synced = store.sync(["/a", "/b"], clock="log")
    read(store, synced)
    seen: dict[int, object] = {}
    # Those that a fork waits for are held for a moment only: see the next test.
    short = {id(store.catalog._lock)}
    locks = [lock for lock in locks_of(store, seen) if id(lock) not in short]
    assert len(locks) >= 6
    with held(*locks):
        in_child(lambda: read(store, synced))
    read(store, synced)


@pytest.mark.parametrize("name", ["catalog", "buffers", "classes"])
def test_a_fork_waits_for_what_its_child_shares(store: hl.Store, name: str) -> None:
    lock = {
        "catalog": store.catalog._lock,
        "buffers": buffers._lock,
        "classes": ros_codec._REGISTERING,
    }[name]
    free = threading.Event()

    def hold(begun: threading.Event, _: threading.Event) -> None:
        with lock:
            begun.set()
            # The fork waits meanwhile.
            threading.Event().wait(0.3)
            free.set()

    def check() -> None:
        assert free.is_set()
        assert lock.acquire(blocking=False)

    with beside(hold):
        in_child(check)
    assert lock.acquire(blocking=False)
    lock.release()


class Slow:
    """Has an attribute that another thread computes for long."""

    begun, over = threading.Event(), threading.Event()

    @lazy
    def value(self) -> int:
        """A number."""
        if threading.current_thread() is not threading.main_thread():
            self.begun.set()
            self.over.wait(SECONDS)
        return 3


def test_a_worker_computes_the_attribute_that_a_thread_was_computing() -> None:
    slow = Slow()
    thread = threading.Thread(target=lambda: slow.value)
    thread.start()
    try:
        assert slow.begun.wait(SECONDS)
        in_child(lambda: slow.value)
        assert Slow().value == slow.value == 3
    finally:
        slow.over.set()
        thread.join()


def test_threads_get_one_value_of_a_lazy_attribute() -> None:
    both = threading.Barrier(2)

    class Made:
        @lazy
        def value(self) -> object:
            """Another object each time."""
            both.wait(SECONDS)
            return object()

    made, found = Made(), []
    threads = [threading.Thread(target=lambda: found.append(made.value)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [made.value] * 2
    assert Made.value.__doc__ == "Another object each time."


def test_a_worker_imports_what_a_thread_was_importing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: hl.Store
) -> None:
    assert store.catalog is not None
    about = types.SimpleNamespace(begun=threading.Event())
    monkeypatch.setitem(sys.modules, "about_the_fork", about)
    text = "import time, about_the_fork\nabout_the_fork.begun.set()\ntime.sleep(0.3)\nvalue = 3\n"
    (tmp_path / "slowly_made.py").write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(tmp_path)
    thread = threading.Thread(target=importlib.import_module, args=("slowly_made",))
    thread.start()
    try:
        assert about.begun.wait(SECONDS)
        in_child(lambda: importlib.import_module("slowly_made").value)
    finally:
        thread.join()
        sys.modules.pop("slowly_made", None)


def test_no_attribute_has_a_lock_for_all_objects() -> None:
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            used = {getattr(node, kind, "") for kind in ("id", "attr", "name")}
            assert "cached_property" not in used, f"{name} must use `lazy` instead"
