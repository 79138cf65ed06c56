"""The processes that answer SQL for the page."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
import pytest

import hybridlog as hl
from hybridlog.sql.duck import OWN_MEMORY
from hybridlog.view.sql_process import SQL_MEMORY, in_process
from hybridlog_storage.errors import HybridlogError, ResourceError, StoreError
from hybridlog_storage.stopping import GivenUpError, until_given_up
from tests.imports import ROOT
from tests.waiting import wait_for

if TYPE_CHECKING:
    from starlette.testclient import TestClient

START = 400 << 20  # what the process has before its query, and files that it maps

PAGE = """
import sys
import hybridlog as hl
from hybridlog.view.sql_process import in_process
from tests.view.test_sql_process import wait

in_process(hl.open(sys.argv[1]), wait, sys.argv[2])
"""


def peak(_store: object) -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) << 10


def greedy(store: hl.Store) -> int:
    connection = store.sql_engine.connect(SQL_MEMORY)
    with pytest.raises(ResourceError):
        connection.query("select list(range) from range(100000000)").to_arrow()
    return peak(store)


def wait(_store: object, path: str) -> None:
    Path(path).write_text(str(os.getpid()))
    threading.Event().wait()


def end(_store: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(_store: object) -> None:
    raise HybridlogError("no")


def assert_ends(path: Path) -> None:
    number = int(path.read_text())
    wait_for(
        lambda: (
            not psutil.pid_exists(number) or psutil.Process(number).status() == psutil.STATUS_ZOMBIE
        )
    )


def test_a_query_takes_no_more_than_it_may(client: TestClient, demo_store: hl.Store) -> None:
    def rows(text: str) -> Any:
        return client.get("sql", params={"recording": "robot", "text": text}).json()

    before = psutil.Process().memory_info().rss
    for text in ("select unnest(range(100000000))", "select list(range) from range(100000000)"):
        problem = rows(text)["error"]
        assert "needs more than 512 MiB of memory: ask for less at a time" in problem
    assert rows("select count(*) from scan")["rows"] == [
        [str(demo_store.topic("/base/scan").count())]
    ]
    assert in_process(demo_store, greedy) < SQL_MEMORY + OWN_MEMORY + START
    assert psutil.Process().memory_info().rss - before < 200 << 20


def test_what_nobody_waits_for_ends_with_its_process(demo_store: hl.Store, tmp_path: Path) -> None:
    with pytest.raises(HybridlogError, match="no"):
        in_process(demo_store, refuse)
    with pytest.raises(ResourceError, match="ask for less"):
        in_process(demo_store, end)
    path, stopped = tmp_path / "pid", threading.Event()

    def stop() -> None:
        wait_for(lambda: path.exists() and path.read_text())
        stopped.set()

    thread = threading.Thread(target=stop)
    thread.start()
    with pytest.raises(GivenUpError), until_given_up(stopped):
        in_process(demo_store, wait, str(path))
    thread.join()
    assert_ends(path)


def test_it_ends_with_its_page(demo_store: hl.Store, tmp_path: Path) -> None:
    path = tmp_path / "pid"
    words = [sys.executable, "-c", PAGE, str(demo_store.directory.path), str(path)]
    with subprocess.Popen(words, cwd=ROOT) as page:
        wait_for(lambda: path.exists() and path.read_text())
        page.kill()
    assert_ends(path)


def test_a_store_that_cannot_be_opened_is_told(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        (tmp_path / "store").rename(tmp_path / "elsewhere")
        with pytest.raises(StoreError, match="no such directory"):
            in_process(store, peak)
        (tmp_path / "elsewhere").rename(tmp_path / "store")
        assert in_process(store, peak)
