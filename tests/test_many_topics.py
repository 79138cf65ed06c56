"""A store of many topics: few commands, and each topic is looked at once."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.mongo.database import Database
from tests.calls import Calls
from tests.limits import Limit
from tests.many_topics import topic, write_log

pytestmark = pytest.mark.mongo("embedded")


def least(value: int) -> dict[str, object]:
    """A condition that MongoDB answers."""
    return {"data": {"$gte": value}}


def commands_of(calls: Calls) -> Counter[str]:
    """Counts the inserts and the questions sent to MongoDB, by method."""
    sent: Counter[str] = Counter()
    for method in ("_insert_batch", "ensure_collection", "run"):
        calls(Database, method, lambda *_, name=method, **__: sent.update([name]))
    return sent


def test_a_store_of_many_topics(tmp_path: Path, calls: Calls, limit: Limit) -> None:
    limit(short_recording_s=60.0)  # it is followed in this process, whose calls are counted
    log = write_log(tmp_path / "log.mcap", 300)
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        sent = commands_of(calls)
        store.record(log)
        assert sent["_insert_batch"] == sent["ensure_collection"] == 300
        sent.clear()
        assert store.all_topics().where(least(3)).count() == 600
        # A hundred questions a command.
        assert sent["run"] <= 10
        sent.clear()
        assert store.topic(topic(299)).where(least(3)).count() == 2
        assert sent.total() <= 8
