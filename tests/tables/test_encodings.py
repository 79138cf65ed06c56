"""Tables of messages in JSON and protobuf."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.columns.tables import Tables
from hybridlog.schema.text import MAX_DEPTH
from hybridlog_storage.messages import Channel, Schema
from tests.limits import Limit
from tests.query.test_engines import WAYS, only
from tests.tables.conftest import SMALL_CHUNKS
from tests.tables.logs import BASE, write_log

Said = Callable[[int], dict[str, object]]


def record(store: hl.Store, path: Path, values: Sequence[Any], topic: str = "/a") -> None:
    said = [(BASE + n, topic, json.dumps(value).encode()) for n, value in enumerate(values)]
    schema = Schema("any", "jsonschema", b"{}")
    write_log(path / "log.mcap", said, {topic: ("json", schema)})
    store.record(path / "log.mcap", name="log", settings=SMALL_CHUNKS)


def rows(store: hl.Store, topic: str = "/a") -> list[dict[str, Any]] | None:
    (entry,) = store.recordings()
    table = Tables(store.directory.path).of(entry, topic)
    if table is None:
        return None
    return [row for block in table.scan(None) for row in block.records.to_pylist()]


def test_an_empty_message_that_is_missing_at_times(store: hl.Store, tmp_path: Path) -> None:
    record(store, tmp_path, [{"n": 1, "e": {}}, {"n": 2, "e": None}, {"n": 3, "e": {}}])
    found = rows(store)
    assert found is not None
    assert [row["e"] is None for row in found] == [False, True, False]


def few_rows_a_file(limit: Limit) -> None:
    limit(table_pending_bytes=1, table_left_bytes=0, group_bytes=1)


@pytest.mark.parametrize(
    ("later", "wanted"),
    [
        (lambda n: {"a": n, "b": str(n)}, lambda n: {"a": n, "b": None if n < 1000 else str(n)}),
        (lambda n: {"a": str(n)}, lambda n: {"a": str(n) if n < 1000 else f'"{n}"'}),
    ],
    ids=["a field", "a type"],
)
def test_json_that_changes_later(
    store: hl.Store, tmp_path: Path, limit: Limit, later: Said, wanted: Said
) -> None:
    """A file has one type: what comes later goes to another one, and all is one table."""
    few_rows_a_file(limit)
    record(store, tmp_path, [{"a": n} if n < 1000 else later(n) for n in range(2000)])
    assert len(list((store.directory.path / "tables").glob("any~*"))) > 1
    assert rows(store) == [wanted(n) for n in range(2000)]
    assert store.topic("/a").where("a == 7").count() == 1


@pytest.mark.parametrize("large", [7, 2**53 + 1])
def test_json_integers_in_one_file_and_fractions_in_another(
    store: hl.Store, tmp_path: Path, limit: Limit, large: int
) -> None:
    """They are doubles, or the messages answer."""
    few_rows_a_file(limit)
    values = [*range(9), large, *range(10, 1000), *(n / 4 for n in range(1000, 2000))]
    record(store, tmp_path, [{"a": value} for value in values])
    assert len(list((store.directory.path / "tables").glob("any~*"))) > 1
    assert store.topic("/a").where(f"a == {large}").count() == (1 if large > 7 else 2)
    column = store.topic("/a").fields("a").to_pandas()["a"]
    assert (int(column.iloc[9]), float(column.iloc[1001])) == (large, 250.25)
    if large == 7:
        found = rows(store)
        assert found is not None
        assert {type(row["a"]) for row in found} == {float}


def test_a_field_that_breaks_parquet_costs_only_its_topic(store: hl.Store, tmp_path: Path) -> None:
    record(store, tmp_path, [{"a.b": 1, "a": {"b": 2}, "": 3, "ä\0": 4}])
    found = rows(store)
    assert found is None or found[0]["a.b"] == 1
    assert store.topic("/a").count() == 1
    assert store.verify().findings == []


# --- nested deeper than readers of Parquet take

KINDS = {"lists": ("[", "]"), "objects": ('{"a":', "}"), "both": ('[{"a":', "}]")}
DEPTHS = (MAX_DEPTH - 1, MAX_DEPTH, MAX_DEPTH + 1, 60, 99, 300)


def _nested(kind: str, depth: int, value: int) -> str:
    begin, end = KINDS[kind]
    return f'{{"k": {value}, "v": {begin * depth}{value}{end * depth}}}'


@pytest.fixture(scope="module", params=KINDS)
def deep(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    with hl.open(tmp_path_factory.mktemp("deep") / "store", create=True, mongo="none") as opened:
        with opened.start("deep") as recording:
            for depth in DEPTHS:
                for value in range(3):
                    text = _nested(request.param, depth, value).encode()
                    channel = Channel(f"/t{depth}", "json", None)
                    recording.write(channel, text, log_time=1000 + value)
        yield opened, request.param


@pytest.mark.parametrize("state", ["plain", "arrays"])
def test_deep_values(deep: tuple[hl.Store, str], state: str) -> None:
    opened, kind = deep
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
            json.loads(_nested(kind, depth, value)) for value in range(3)
        ]
        rows = opened.sql(f"SELECT k, v FROM t{depth} ORDER BY k").to_arrow()
        assert rows["k"].to_pylist() == [0, 1, 2]
        assert query.to_arrow()["k"].to_pylist() == [0, 1, 2]
    assert not opened.verify().findings
