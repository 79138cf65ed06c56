"""Questions that a page gives up, and those about recordings that go on."""

from __future__ import annotations

import shutil
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import pytest

import hybridlog as hl
from hybridlog.view import context
from hybridlog.view.guard import Admission
from hybridlog.view.routes import ask
from hybridlog.view.server import make_app
from hybridlog_storage.cache import Kind
from tests.limits import Limit
from tests.view.conftest import PORT, TOKEN
from tests.view.test_ask import ENDLESS, asked_for

S = 10**9
WHOLE = {"begin": 0, "end": 20 * S, "pixels": 100}
SCAN = {"recording": "robot", "topic": "/base/scan"}
NEAR = {**SCAN, "where": "ranges.min < 0.8"}
QUESTIONS: dict[str, dict[str, Any]] = {
    "ask": {**NEAR, "where": "ranges[7] < 0.8"},
    "matches": {**NEAR, **WHOLE},
    "episodes": {**NEAR, "at": 0},
    "series": {**SCAN, **WHOLE, "field": "ranges.min"},
    "track": {"recording": "robot", "topic": "/odom", "pixels": 100},
    "rows": {"recording": "robot", "topic": "/rosout", "field": "msg", "at": 0, "after": 9},
    "recordings": {"where": "scan: ranges.min < 0.5"},
    "timeline": {**WHOLE, **SCAN},
    "sql": {
        "recording": "robot",
        "text": ENDLESS,
    },
}


@pytest.mark.parametrize("path", QUESTIONS)
def test_a_question_that_is_given_up_stops(
    demo_store: hl.Store, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """The client leaves when something is about to be read, and nothing more is."""
    assert_stops(demo_store, monkeypatch, path, QUESTIONS[path])


def forget(store: hl.Store) -> None:
    """Other tests may have asked the same."""
    for kind in get_args(Kind):
        store.session.cache.drop(kind)


def assert_stops(
    store: hl.Store,
    monkeypatch: pytest.MonkeyPatch,
    path: str,
    asked: dict[str, Any],
    module: str = "",
) -> None:
    """The client leaves when a module, or any, is about to read."""
    forget(store)
    leaves = threading.Event()

    class Watched(threading.Event):
        def is_set(self) -> bool:
            if module not in sys._getframe(2).f_code.co_filename:
                return super().is_set()
            leaves.set()
            assert self.wait(20)
            return True

    app = make_app(store, Admission(token=TOKEN, port=PORT))
    with monkeypatch.context() as patched:
        patched.setattr(context, "threading", SimpleNamespace(Event=Watched))
        said = asked_for(app, path, asked, leaves_after=leaves)
    assert b"The query was stopped" in said[1]["body"]
    said = asked_for(app, "recordings", {}, leaves_after=20.0)
    assert said[0]["status"] == 200


def test_reading_payloads_is_given_up(
    demo_store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: Limit
) -> None:
    """By threads that read ahead, and from tables with arrays."""
    limit(min_threaded_bytes=0)
    asked = {**SCAN, "where": "ranges[7] < 3 or ranges[7] > 3.1"}
    assert_stops(demo_store, monkeypatch, "ask", asked, "query/chunk_scan")
    shutil.copytree(demo_store.directory.path, tmp_path / "store")
    with hl.open(tmp_path / "store") as store:
        store.index.arrays("scan")
        assert_stops(store, monkeypatch, "ask", asked, "hybridlog/columns/")


def test_a_question_that_is_given_up_waits_for_nothing(demo_store: hl.Store) -> None:
    forget(demo_store)
    app = make_app(demo_store, Admission(token=TOKEN, port=PORT))
    shared: context.Context = app._app.state.context
    with ExitStack() as held:
        for _ in range(context.MAX_WORKING):
            held.enter_context(shared.turns)
        said = asked_for(app, "ask", NEAR, leaves_after=0.1)
        assert b"The query was stopped" in said[1]["body"]
    with ask._matching:
        said = asked_for(app, "matches", QUESTIONS["matches"], leaves_after=0.1)
        assert b"The query was stopped" in said[1]["body"]
    said = asked_for(app, "matches", QUESTIONS["matches"], leaves_after=20.0)
    assert said[0]["status"] == 200
