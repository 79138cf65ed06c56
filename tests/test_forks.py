"""A store that was opened before a fork is refused in the child, and never hangs there."""

from __future__ import annotations

import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")

SECONDS = 60
COUNT = 20


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
def held(lock: Any) -> Iterator[None]:
    """A lock that another thread holds."""
    begun, over = threading.Event(), threading.Event()

    def hold() -> None:
        with lock:
            begun.set()
            over.wait(SECONDS)

    thread = threading.Thread(target=hold)
    thread.start()
    try:
        assert begun.wait(SECONDS)
        yield
    finally:
        over.set()
        thread.join()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    path = tmp_path_factory.mktemp("forks") / "store"
    with hl.open(path, create=True, mongo="none") as store:
        with store.start("run") as recording:
            for topic in ("/a", "/b"):
                schema = Schema("std_msgs/Header", "ros1msg", b"uint32 seq\ntime stamp\n")
                channel = Channel(topic, "ros1", schema)
                for n in range(COUNT):
                    body = n.to_bytes(4, "little") + bytes(8)
                    recording.write(channel, body, log_time=1 + n * 10**6)
        yield store


def test_a_child_is_told_to_open_the_store(store: hl.Store) -> None:
    query = store.topic("/a").where("seq < 5")
    recordings = store.recordings()
    synced = store.sync(["/a", "/b"], clock="log")
    assert query.count() == len(query.to_pandas()) == 5
    assert store.sql('select count(*) from a where "seq" < 5').rows() == [(5,)]
    assert len(synced) == COUNT

    def refused() -> None:
        for use in (
            query.count,
            query.to_pandas,
            lambda: list(query),
            lambda: store.topic("/b"),
            lambda: store.sql("select 1").rows(),
            lambda: store.align("/a", ["/b"], clock="log").to_pandas(),
            store.recordings,
            lambda: recordings[0],
            store.refresh,
            lambda: store.edit("run", note="x"),
            lambda: store.remove("run"),
            lambda: store.start("another"),
            lambda: store.keep(dry_run=True),
            store.verify,
        ):
            with pytest.raises(UsageError, match=r"before this process was forked: open it here"):
                use()
        store.close()

    def opened() -> None:
        with hl.open(store.directory.path, mongo="none") as own:
            assert own.topic("/a").where("seq < 5").count() == 5
        assert [m.decode().seq for m in synced[7]] == [7, 7]

    in_child(opened)
    with held(store.shared.following):
        in_child(refused)
    assert query.count() == 5


def test_a_child_leaves_the_recording_of_its_parent_alone(store: hl.Store) -> None:
    channel = Channel("/own", "json", None)
    with store.start("own") as recording:
        recording.write(channel, b"{}")

        def refused() -> None:
            for use in (lambda: recording.write(channel, b"{}"), recording.close, recording.abort):
                with pytest.raises(UsageError, match="made by the parent of this process"):
                    use()
            recording.__exit__()

        in_child(refused)
        recording.write(channel, b"{}")
    assert store.topic("/own").count() == 2
