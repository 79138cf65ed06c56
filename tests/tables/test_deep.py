"""JSON that is nested deeper than readers of Parquet take."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

import hybridlog as hl
from hybridlog.schema.text import MAX_DEPTH
from hybridlog_storage.messages import Channel
from tests.query.test_engines import WAYS, only

KINDS = {"lists": ("[", "]"), "objects": ('{"a":', "}"), "both": ('[{"a":', "}]")}
DEPTHS = (MAX_DEPTH - 1, MAX_DEPTH, MAX_DEPTH + 1, 60, 99, 300)


def _text(kind: str, depth: int, value: int) -> str:
    begin, end = KINDS[kind]
    return f'{{"k": {value}, "v": {begin * depth}{value}{end * depth}}}'


@pytest.fixture(scope="module", params=KINDS)
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    with hl.open(tmp_path_factory.mktemp("deep") / "store", create=True) as opened:
        with opened.start("deep") as recording:
            for depth in DEPTHS:
                for value in range(3):
                    text = _text(request.param, depth, value).encode()
                    channel = Channel(f"/t{depth}", "json", None)
                    recording.write(channel, text, log_time=1000 + value)
        yield opened, request.param


@pytest.mark.parametrize("state", ["plain", "arrays"])
def test_deep_values(store: tuple[hl.Store, str], state: str) -> None:
    opened, kind = store
    if state != "plain":
        opened.index.arrays("/t*")
    assert not opened.verify().findings
    for depth in DEPTHS:
        query = opened.topic(f"/t{depth}")
        conditions = {"k >= 1": 2, "v exists": 3}
        if kind == "lists":
            conditions |= {"v >= 1": 2, "not (v == 1)": 2}
        for way in WAYS:
            with only(way):
                for condition, wanted in conditions.items():
                    assert query.where(condition).count() == wanted, (depth, way, condition)
        assert [json.loads(m.raw) for m in query] == [
            json.loads(_text(kind, depth, value)) for value in range(3)
        ]
        rows = opened.sql(f"SELECT k, v FROM t{depth} ORDER BY k").to_arrow()
        assert rows["k"].to_pylist() == [0, 1, 2]
        deep = query.to_arrow()
        assert deep["k"].to_pylist() == [0, 1, 2]
    assert not opened.verify().findings
