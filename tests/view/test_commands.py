"""The processes of commands that answer for the page and for assistants."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import psutil
import pytest

import hybridlog as hl
from hybridlog.view import commands
from hybridlog_storage.errors import ResourceError, UsageError
from hybridlog_storage.stopping import GivenUpError, until_given_up
from tests.waiting import wait_for

if TYPE_CHECKING:
    from starlette.testclient import TestClient

ENDLESS = "select sum(a.range * b.range) from range(10000000) a, range(1000000) b"


def test_a_query_takes_no_more_than_it_may(client: TestClient, demo_store: hl.Store) -> None:
    def rows(text: str) -> Any:
        return client.get("sql", params={"recording": "robot", "text": text}).json()

    before = psutil.Process().memory_info().rss
    for text in ("select unnest(range(100000000))", "select list(range) from range(100000000)"):
        assert "ask for less at a time" in rows(text)["error"]
    assert rows("select count(*) from scan")["rows"] == [
        [str(demo_store.topic("/base/scan").count())]
    ]
    assert psutil.Process().memory_info().rss - before < 200 << 20


def own() -> list[psutil.Process]:
    return psutil.Process().children()


def test_what_nobody_waits_for_ends_with_its_process(demo_store: hl.Store) -> None:
    known, place, stopped = own(), demo_store.directory.address, threading.Event()

    def stop() -> None:
        wait_for(lambda: len(own()) > len(known))
        stopped.set()

    thread = threading.Thread(target=stop)
    thread.start()
    with pytest.raises(GivenUpError), until_given_up(stopped):
        commands.run(place, "sql", [], ENDLESS, seconds=60)
    thread.join()
    assert own() == known
    with pytest.raises(ResourceError, match="took longer"):
        commands.run(place, "sql", [], ENDLESS, seconds=0.2)
    assert own() == known


def test_one_that_ends_is_told(demo_store: hl.Store) -> None:
    place, known = demo_store.directory.address, own()

    def kill() -> None:
        wait_for(lambda: len(own()) > len(known))
        [one.kill() for one in own() if one not in known]

    thread = threading.Thread(target=kill)
    thread.start()
    with pytest.raises(ResourceError, match="ask for less"):
        commands.run(place, "sql", [], ENDLESS, seconds=60)
    thread.join()
    with pytest.raises(UsageError, match="no such directory"):
        commands.run(f"{place}/elsewhere", "ls", [], seconds=60)
