"""Views hold what the messages say, and read no more than a query is about."""

from __future__ import annotations

import weakref

import duckdb
import pytest

import hybridlog as hl
from hybridlog.schema.arrow_types import plain_values
from hybridlog.sql.engine import SqlEngine
from hybridlog.sql.views import ViewRows
from hybridlog_storage.errors import UsageError
from tests.sql.conftest import LARGE, SCANS, files_read
from tests.tables.logs import BASE, SECOND, decoded, same

LATER = BASE + 3600 * SECOND


NAMES = ("header", "i8", "u64", "f64", "took", "name", "many", "nine", "covariance", "words")
FIELDS = {name: name for name in (*NAMES, "points")}
FIELDS |= {"t_": "t", "Name_2": "Name", "state_": "state"}  # as ours, or but for case
EVERYTHING = """
select * replace (list_transform(points, lambda p: {{'x': p.x, 'data': p.data}}) as points)
from "{}" where recording = 'first' order by t, seq
"""


@pytest.mark.parametrize("topic", ["/large", "/mixed", "/order", "/recordings"])
def test_a_view_holds_what_messages_say(store: hl.Store, topic: str) -> None:
    ((view,),) = store.sql("select distinct view from topics where topic = ?", [topic]).rows()
    fields = {**FIELDS}
    if topic == "/mixed":  # numbers in one recording and texts in the other are JSON text
        kinds = dict(store.sql(f'select column_name, column_type from (describe "{view}")').rows())
        assert (kinds[fields.pop("f64")], kinds["i8"]) == ("VARCHAR", "DOUBLE")
        texts = store.sql(f'select f64 from "{view}" order by t desc limit 2').rows()
        assert texts == [('"3.5"',), ('"2.5"',)]
    found = store.sql(EVERYTHING.format(view)).to_arrow().to_struct_array().combine_chunks()
    messages = decoded(store, "first", topic)
    assert len(messages) > 0
    for row, message in zip(plain_values(found), messages, strict=True):
        value = message.value
        assert (row["t"], row["seq"], row["pub"]) == (message.t, message.seq, message.pub)
        assert (row["log_time"], row["stamp"]) == (message.t // 1000, row["header"]["stamp"])
        assert (row["yes"], row["many_summary"]["n"]) == (bool(value.yes), len(value.many))
        assert row["covariance_summary"] == {"n": 36, "min": 0.25, "max": 0.25, "mean": 0.25}
        for column, name in fields.items():
            assert same(row[column], getattr(value, name)), (column, row)


def test_decoded_chunks_say_the_same(store: hl.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic without a table is answered from its chunks, with the same columns."""
    queries = [
        "select t, seq, pub, stamp, state, tags, i8, u64, f64, took, name, header, nothing, "
        "nine, many_summary, covariance_summary from large order by t, seq",
        "select angle, ranges_summary, echo.kind, echo.far_summary from scan order by t, seq",
    ]
    with_tables = [store.sql(query) for query in queries]
    tables = [answer.to_arrow() for answer in with_tables]
    monkeypatch.setattr(ViewRows, "tabled", lambda self, part: None)
    engine = SqlEngine(store.session)
    store.session.cache.drop("chunk")
    for query, table in zip(queries, tables, strict=True):
        answer = engine.query(query)
        found = answer.to_arrow()
        assert found.schema == table.schema
        assert str(found.to_pylist()) == str(table.to_pylist())  # NaN is not equal to itself
        assert len(answer.reading.groups) == 0
        assert answer.reading.counters.chunks_read > 0
    assert all(len(answer.reading.groups) for answer in with_tables)


PREDICATES = """
t < 1700000000300000000 | t >= 1700000000300000000 and t < 1700000000301000000 | t % 7 = 3
log_time < timestamptz '2023-11-14 22:13:20.25Z' | log_time = timestamptz '2023-11-14 22:13:21Z'
log_time > timestamptz '2023-11-14 22:13:20.25Z' | t <> 1700000000000000000 | t is null | not t < 5
recording = 'second' | recording in ('first', 'x') | recording > 'first' | recording like 'f%'
recording = 'second' and f64 > 3 or t < 1700000000010000000 | recording <> 'first'
recording = 'first' and recording = 'second' | recording = 'first' and t < 1700000000010000000
recording = 'nothing' | t > 9223372036854775806 | t >= -9223372036854775807 | t = 5
t in (1700000000000000000, 5) | t between 1700000000000000000 and 1700000000003000003 and i8 > 0
f64 = 'nan'::double | f64 < 1 or f64 > 100 | u64 > 9223372036854775807 | tags['site'] = 'hall'
"""


@pytest.fixture(scope="module")
def plain(store: hl.Store) -> duckdb.DuckDBPyConnection:
    """The same rows in a table of DuckDB's own."""
    connection = duckdb.connect(config={"python_enable_replacements": False})
    connection.execute("set TimeZone = 'UTC'")
    connection.register("arrow", store.sql("select * from large").to_arrow())
    connection.execute("create table large as select * from arrow")
    return connection


@pytest.mark.parametrize("line", PREDICATES.strip().splitlines())
def test_pushed_filters_mean_what_duckdb_means(
    store: hl.Store, plain: duckdb.DuckDBPyConnection, line: str
) -> None:
    for predicate in line.split(" | "):
        query = f"select t, seq, recording from large where {predicate} order by all"
        assert store.sql(query).rows() == plain.execute(query).fetchall(), predicate


def test_time_and_recording_choose_what_is_read(store: hl.Store) -> None:
    every = store.sql("select sum(i8) from large")
    assert every.rows() == [(sum(n % 5 - 2 for n in range(LARGE)) + 200,)]
    assert (files_read(every), len(every.reading.groups)) == (2, LARGE // 300 + 1)
    middle = BASE + 450 * 1_000_001
    for where, files, groups in (
        (f"t = {middle}", 1, 1),
        (f"t = {BASE + 299 * 1_000_001}", 1, 1),
        (f"t = {BASE + 300 * 1_000_001}", 1, 1),
        (f"t = {BASE + 299 * 1_000_001 + 1}", 0, 0),
        (f"t between {middle} and {middle + 1_000}", 1, 1),
        (f"log_time >= make_timestamptz({middle // 1000}) and t < {middle + SECOND // 10}", 1, 1),
        ("recording = 'second'", 1, 1),
        ("recording = 'first'", 1, 4),
        (f"t > {LATER + 100 * SECOND}", 0, 0),
        ("recording = 'third'", 0, 0),
    ):
        answer = store.sql(f"select count(i8) from large where {where}")
        ((count,),) = answer.rows()
        assert (count > 0) == (groups > 0), where
        assert (files_read(answer), len(answer.reading.groups)) == (files, groups), where
        assert answer.reading.counters.payload_bytes == 0


def test_arrays_come_from_payloads_only_when_they_are_named(store: hl.Store) -> None:
    size = 4 + 4 + 400 + 1 + 4 + 50 + 160
    for query, messages in (
        ("select angle, ranges_summary.min, echo.kind, echo.far_summary.n from scan", 0),
        ("select count(*) from scan where ranges_summary.min < 10", 0),
        ("select s.echo.kind from scan s join large l on l.t = s.t", 0),
        (f"select ranges[3] from scan where t < {BASE + 20_000_000}", 10),
        (f"select s from scan s where t < {BASE + 4_000_000}", 2),
        ("select count(*) from scan where ranges is not null", SCANS),
    ):
        answer = store.sql(query)
        answer.rows()
        assert answer.reading.counters.payload_bytes == messages * size, query
    found = store.sql(
        "select ranges[3], list_min(ranges[41:60]), echo.far[1], echo.data[50], len(echo.data), "
        "echo.kind, ranges_summary.max, echo.data_summary.n from scan order by t"
    ).rows()
    expected = [(n + 2.0, n + 40.0, n / 4, n % 256, 50, n % 7, n + 99.0, 50) for n in range(SCANS)]
    assert found == expected
    nested = "select sum(echo.far[1]) from scan"  # no other field of the struct is read
    assert store.sql(nested).rows() == [(sum(n / 4 for n in range(SCANS)),)]
    near = "select count(*) from scan where list_min(ranges[41:60]) < 50"
    language = store.topic("scan").where("ranges[40:60] < 50").count()
    assert store.sql(near).rows() == [(language,)] == [(10,)]


def test_names(store: hl.Store) -> None:
    topics = store.sql("select distinct topic, view, short from topics order by topic").rows()
    assert [(t, s) for t, _, s in topics if s] == [("/base/scan", "scan")]
    views = {topic: view for topic, view, _ in topics}
    assert views["/recordings"] == "recordings_"  # ours is reserved, theirs stays
    assert (views["/large"], views["/Large"]) == ("large", "Large_2")
    assert views["/a b"].startswith("a_b~")
    for topic, view in views.items():
        ((count,),) = store.sql(f'select count(*) from "{view}"').rows()
        assert count == store.topic(topic).count(), topic
    assert store.sql("select count(*) from SCAN").rows() == [(SCANS,)]
    assert store.sql("select count(*) from base__scan").rows() == [(SCANS,)]
    shown = {name for (name,) in store.sql("show tables").rows()}
    assert shown == {*views.values(), "scan", "recordings", "topics", "losses", "marks"}


def test_forms_of_an_answer(store: hl.Store) -> None:
    query = "select recording, i8, f64, name, header.stamp from large order by t, seq"
    table = store.sql(query).to_arrow()
    assert store.sql(query).to_polars().to_arrow().num_rows == table.num_rows
    assert store.sql(query).to_pandas().i8.tolist() == table.column("i8").to_pylist()
    assert sum(batch.num_rows for batch in store.sql(query).to_batches()) == table.num_rows
    nothing = list(store.sql(f"{query} limit 0").to_batches())
    assert [(batch.num_rows, batch.schema.names) for batch in nothing] == [(0, table.column_names)]
    few = store.sql("select i8 from large limit 3")
    assert len(few.rows()) == 3
    assert len(few.reading.groups) < 3  # the rest is not read


def test_parameters_and_several_statements(store: hl.Store) -> None:
    assert store.sql("select count(*) from large where i8 = ?", [5]).rows() == [(40,)]
    counted = store.sql("select count(*) from large where i8 = $n", {"n": 5})
    assert counted.rows() == [(40,)]
    for params in (5, "5"):
        with pytest.raises(UsageError, match="a list"):
            store.sql("select count(*) from large where i8 = ?", params)  # type: ignore[arg-type]
    for _ in range(2):  # what it creates is its own
        made = store.sql("create table few as select * from scan limit 7; select count(*) from few")
        assert made.rows() == [(7,)]
    gone = weakref.ref(made)
    del made
    assert gone() is None  # with its connection
    # What a view of the user reads is not in the text of the next query.
    own = "create view v as select echo from scan where angle < 1; select max(v.echo.far[1]) from v"
    assert store.sql(own).rows() == [(0.25,)]
    macro = "create macro m() as (select max(echo.far[1]) from scan); select m()"
    assert store.sql(macro).rows() == [((SCANS - 1) / 4,)]
    assert store.sql("create table x (a int)").rows() == []
