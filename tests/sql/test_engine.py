"""A query reads the views of its store and nothing else, in bounded memory and time."""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import hybridlog as hl
from hybridlog.query.choice import Choice
from hybridlog.sql import engine
from hybridlog_storage.errors import (
    HybridlogError,
    MissingDependencyError,
    ResourceError,
    SegmentError,
    StoreError,
    TimeError,
    TopicError,
    UsageError,
)
from hybridlog_storage.messages import Channel
from tests import places
from tests.sql.conftest import LARGE, SCANS, files_read, scan
from tests.tables.logs import BASE, SECOND
from tests.waiting import wait_for

ENDLESS = "select sum(a.range * b.range) from range(10000000) a, range(1000000) b"


@pytest.fixture
def own(root: Path, tmp_path: Path) -> Iterator[hl.Store]:
    """A copy of the store that a test may damage."""
    shutil.copytree(root, tmp_path / "store", ignore=shutil.ignore_patterns("mongod*"))
    with hl.open(tmp_path / "store", mongo="mongodb://127.0.0.1:1/") as opened:
        yield opened


REFUSED = """
attach '{path}' as other
attach '{path}' as other (type sqlite)
copy (select 1) to '{path}'
copy large to '{path}' (format parquet)
copy (select 1) to stdout
create table x as select * from read_csv('/etc/passwd')
export database '{path}'
import database '{path}'
install httpfs
install '{path}'
load httpfs
load '{path}'
select * from '/etc/passwd'
select * from '{path}.parquet'
select * from glob('/etc/*')
select * from own_variable
select * from read_blob('/etc/passwd')
select * from read_csv('/etc/passwd')
select * from read_csv_auto('http://127.0.0.1/x.csv')
select * from read_json('/etc/passwd')
select * from read_parquet('{path}')
select * from read_parquet('s3://bucket/x')
select * from read_text('/etc/passwd')
select * from sniff_csv('/etc/passwd')
select * from parquet_metadata('{path}')
select * from sqlite_scan('{path}', 'x')
select getenv('HOME')
set enable_external_access = true
set global python_enable_replacements = true
set lock_configuration = false
set memory_limit = '10GB'
set temp_directory = '{path}'
set threads = 1
set extension_directory = '{path}'
set TimeZone = 'Asia/Tokyo'
reset memory_limit
pragma enable_profiling
pragma profiling_output = '{path}'
pragma memory_limit = '10GB'
pragma threads = 9
call enable_logging(storage = 'file', storage_path = '{path}')
create persistent secret s (type s3)
update extensions
"""


@pytest.mark.parametrize("statement", REFUSED.strip().splitlines())
def test_a_query_reaches_nothing_else(store: hl.Store, tmp_path: Path, statement: str) -> None:
    own_variable = pa.table({"secret": [1]})  # noqa: F841
    with pytest.raises(UsageError):
        store.sql(statement.format(path=tmp_path / "reached")).to_arrow()
    assert list(tmp_path.iterdir()) == []


def test_errors_say_what_to_do(store: hl.Store, tmp_path: Path) -> None:
    for query, said in (
        (f"copy (select 1) to '{tmp_path / 'x'}'", "views of this store alone.*Cannot access file"),
        ("select * from scn", "There is no view 'scn'; did you mean scan"),
        ("select * from xyzzy", "There is no view 'xyzzy'; there are Large_2"),
        ("selec 1", 'syntax error at or near "selec"'),
        ("-- nothing", "The query is empty"),
        ("select ranges_sumary from scan", "ranges_sumary"),
    ):
        with pytest.raises(HybridlogError, match=said):
            store.sql(query).rows()
    with pytest.raises(UsageError, match="at least 64 MiB"):
        store.sql("select 1", memory=1 << 20)


def test_memory_is_bounded(store: hl.Store) -> None:
    large = "select a.range, list(b.range) from range(3000) a, range(20000) b group by all"
    with pytest.raises(ResourceError, match=r"more than 64 MiB of memory.*--memory"):
        store.sql(large, memory=64 << 20).rows()
    answer = store.sql("select range from range(30000000)", memory=64 << 20)
    assert sum(batch.num_rows for batch in answer.to_batches()) == 30_000_000


def test_a_timeout_ends_a_query(store: hl.Store) -> None:
    with pytest.raises(HybridlogError, match=r"stopped after 0\.2 s"):
        store.sql(ENDLESS, timeout=0.2).rows()
    assert store.sql("select 1", timeout=60).rows() == [(1,)]


def test_ctrl_c_ends_a_query(store: hl.Store) -> None:
    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        store.sql(ENDLESS).rows()
    assert store.sql("select 1").rows() == [(1,)]


def test_without_duckdb(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        if name == "duckdb":
            raise ImportError(name)
        return importlib.import_module(name)

    with hl.open(root, mongo="mongodb://127.0.0.1:1/") as opened:
        monkeypatch.setattr(engine, "import_module", missing)
        with pytest.raises(MissingDependencyError, match=r"pip install 'hybridlog\[sql\]'"):
            opened.sql("select 1")


def test_an_answer_that_is_computed_again_ends_what_was_read_of_it(store: hl.Store) -> None:
    answer = store.sql("select i8 from large")
    first = answer.to_batches()
    next(first)
    assert answer.to_arrow().num_rows == len(store.sql("select i8 from large").rows())
    assert list(first) == []


def test_a_choice_of_recordings_and_a_time(store: hl.Store) -> None:
    """Views and tables show these alone, and only files of them are read."""
    count = "select count(*) from large"
    some = store.sql(count, recordings=["second"])
    assert (some.rows(), files_read(some)) == ([(40,)], 1)
    chosen = store.recordings(tag="site=hall")
    assert store.sql(count, recordings=chosen).rows() == [(LARGE,)]
    known = ("recording from recordings", "distinct recording from topics")
    for names in known:
        assert store.sql(f"select {names}", recordings=["second"]).rows() == [("second",)]
    with pytest.raises(TopicError, match="There is no view 'scan'"):
        store.sql("select * from scan", recordings=["second"])
    # 300 rows a row group, a message a millisecond
    part = store.sql(f"{count} where i8 > -999", between=("+310ms", "+0.4s"))
    whole = f"t >= {BASE + 310_000_000} and t < {BASE + 400_000_000}"
    assert part.rows() == store.sql(f"{count} where {whole}").rows() == [(90,)]
    assert len(part.reading.groups) == 1  # the other recording has no row in the range
    first = store.sql(count, between=(BASE, BASE + SECOND))
    assert (first.rows(), files_read(first)) == ([(1000,)], 1)
    assert [*first.reading.recordings] == [store.entry("first").id]
    # A view has all its columns, and no row of a recording that lies outside.
    none = store.sql("select angle from scan", between=(BASE + 3600 * SECOND, None))
    assert (none.rows(), files_read(none)) == ([], 0)
    arrays = store.sql("select max(ranges[1]), count(*) from scan", between=("start", "+21ms"))
    assert arrays.rows() == [(10.0, 11)]
    assert arrays.reading.counters.payload_bytes == 11 * len(scan(0))
    assert store.sql(count, recordings="second").rows() == [(40,)]
    with pytest.raises(TimeError, match="A range takes two times"):
        store.sql(count, between="now")  # type: ignore[arg-type]
    with pytest.raises(TimeError, match="Nothing was recorded between"):
        store.sql(count, between=("2001-01-01", "2001-01-02"))
    with pytest.raises(TopicError, match="There is no recording with the tag site=park"):
        store.sql(count, recordings=Choice.of(tag="site=park"))


def test_a_damaged_chunk_is_an_error(own: hl.Store) -> None:
    entry = own.entry("first")
    channels = [c.id for c in entry.channels if c.topic == "/base/scan"]
    chunk = own.session.chunks(entry, channels)[3]
    path = places.segment(own.directory.path, "first")
    with path.open("r+b") as file:
        file.seek(chunk.place.offset + 100)
        file.write(b"\xff\x00\xff")
    assert own.sql("select max(angle) from scan").rows() == [((SCANS - 1) / 2,)]
    with pytest.raises(SegmentError, match="damaged"):
        own.sql("select max(ranges[1]) from scan").rows()


def test_fields_that_no_definition_fixes(tmp_path: Path) -> None:
    """Keys of a map of protobuf, and of JSON; types come from the messages."""
    cases = Path(__file__).parents[1] / "cases"
    with hl.open(tmp_path / "store", create=True) as opened:
        for name in ("pb_std_imports_missing", "json_optional_keys", "json_int64_missing"):
            opened.record(cases / f"{name}.mcap", name=name)
        found = opened.sql("select info.fields.k.number_value, info.fields.l from c").rows()
        assert found[0][0] == 3.0
        assert found[0][1]["list_value"]["values"][0]["string_value"] == "z"
        for topic, view in opened.sql("select topic, view from topics").rows():
            table = opened.sql(f'select * from "{view}" order by t, seq').to_arrow()
            frame = opened.topic(topic).to_arrow()
            assert table.num_rows == frame.num_rows > 0
            for name in set(frame.column_names) & set(table.column_names) - {"log_time"}:
                if not pa.types.is_timestamp(frame.schema.field(name).type):
                    assert table.column(name).to_pylist() == frame.column(name).to_pylist()


def test_refreshing_sees_new_recordings(own: hl.Store) -> None:
    query = "select count(*) from large where recording = 'first'"
    before = own.sql(query)
    assert before.rows() == [(LARGE,)]
    with hl.open(own.directory.path) as other:
        other.edit("first", name="renamed")
    own.refresh()
    assert own.sql(query).rows() == [(0,)]
    assert own.sql("select distinct recording from large order by 1").rows() == [
        ("renamed",),
        ("second",),
    ]
    own.close()
    with pytest.raises((UsageError, StoreError)):
        before.rows()


def test_a_query_sees_what_a_running_recording_has_flushed(tmp_path: Path) -> None:
    """From chunks alone; a topic that is new, too."""
    with hl.open(tmp_path / "store", create=True) as opened:
        with opened.start("live", flush_interval_s=0.05) as recording:
            recording.write(Channel("/old", "json", None), b'{"a": 1}', log_time=BASE)
            wait_for(lambda: opened.sql("select * from topics").rows())
            for n in range(2):
                recording.write(Channel("/note", "json", None), b'{"n": 1}', log_time=BASE + n)
                count = f"select 1 from topics where topic = '/note' and messages = {n + 1}"
                wait_for(lambda count=count: opened.sql(count).rows())
                opened.session.cache.drop("chunk")
                answer = opened.sql("select sum(n) from note")
                assert answer.rows() == [(n + 1,)]
                assert not answer.reading.groups
                assert answer.reading.counters.chunks_read > 0


def test_threads_ask_at_once(store: hl.Store) -> None:
    query = "select count(*), max(ranges[1]) from scan"
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda _: store.sql(query).rows(), range(6)))
    assert found == [[(SCANS, SCANS - 1)]] * 6
