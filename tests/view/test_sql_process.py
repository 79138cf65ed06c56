"""The process that answers SQL for the page."""

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
from hybridlog.view.sql_process import SQL_MEMORY, SqlProcess
from hybridlog_storage.errors import HybridlogError, ResourceError, StoreError
from hybridlog_storage.stopping import GivenUpError, until_given_up
from tests.imports import ROOT
from tests.waiting import wait_for

if TYPE_CHECKING:
    from starlette.testclient import TestClient

START = 400 << 20  # what the process has before its first query, and files that it maps

PAGE = """
import sys
import hybridlog as hl
from hybridlog.view.sql_process import SqlProcess
from tests.view.test_sql_process import pid, wait

if __name__ == "__main__":
    process = SqlProcess(hl.open(sys.argv[1]))
    print(process.ask(pid), flush=True)
    process.ask(wait)
"""


def pid(_store: object) -> int:
    return os.getpid()


def peak(_store: object) -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) << 10


def wait(_store: object) -> None:
    threading.Event().wait()


def end(_store: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(_store: object) -> None:
    raise HybridlogError("no")


@pytest.fixture
def process(demo_store: hl.Store) -> SqlProcess:
    return SqlProcess(demo_store)


def assert_ends(number: int) -> None:
    wait_for(
        lambda: (
            not psutil.pid_exists(number) or psutil.Process(number).status() == psutil.STATUS_ZOMBIE
        )
    )


def process_of(client: TestClient) -> SqlProcess:
    guard: Any = client.app
    found: SqlProcess = guard._app.state.context.sql
    return found


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
    assert process_of(client).ask(peak) < SQL_MEMORY + OWN_MEMORY + START
    assert psutil.Process().memory_info().rss - before < 200 << 20


def test_what_nobody_waits_for_ends_with_its_process(process: SqlProcess) -> None:
    number = process.ask(pid)
    with pytest.raises(HybridlogError, match="no"):
        process.ask(refuse)
    assert process.ask(pid) == number != os.getpid()
    stopped = threading.Event()
    timer = threading.Timer(0.2, stopped.set)
    timer.start()
    with pytest.raises(GivenUpError), until_given_up(stopped):
        process.ask(wait)
    timer.join()
    assert_ends(number)
    assert process.ask(pid) != number


def test_a_process_that_has_ended_is_started_again(process: SqlProcess) -> None:
    number = process.ask(pid)
    os.kill(number, signal.SIGKILL)
    again = process.ask(pid)
    assert again != number
    with pytest.raises(ResourceError, match="ask for less"):
        process.ask(end)
    assert process.ask(pid) not in {number, again}


def test_it_ends_with_its_page(demo_store: hl.Store) -> None:
    process = SqlProcess(demo_store)
    number = process.ask(pid)
    del process
    assert_ends(number)
    page = subprocess.Popen(
        [sys.executable, "-c", PAGE, str(demo_store.directory.path)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    with page:
        assert page.stdout is not None
        number = int(page.stdout.readline())
        page.kill()
    assert_ends(number)


def test_a_store_that_cannot_be_opened_is_told(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        process = SqlProcess(store)
        (tmp_path / "store").rename(tmp_path / "elsewhere")
        with pytest.raises(StoreError, match="no such directory"):
            process.ask(pid)
        (tmp_path / "elsewhere").rename(tmp_path / "store")
        assert process.ask(pid) != os.getpid()
