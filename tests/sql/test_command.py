"""`hybridlog sql`: outputs, standard input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from click.testing import CliRunner, Result

import hybridlog as hl
from hybridlog.cli.app import app
from hybridlog_storage.errors import (
    IncompleteError,
    UsageError,
)
from tests import places
from tests.sql.conftest import LARGE
from tests.tables.logs import BASE, SECOND, payload, write_log

NESTED = (
    "select t, header, many, tags, 1.5::decimal(4, 2) as d, date '2020-01-02' as day, "
    "interval 3 day as i, time '10:00:01' as clock, null as nothing, "
    "map {1: 'a'} as numbered from large order by t, seq limit 2"
)


def run(root: Path, *arguments: object, stdin: str | None = None, code: int = 0) -> Result:
    given = ["sql", "--store", str(root), *map(str, arguments)]
    done = CliRunner().invoke(app, given, input=stdin)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == code, done.output
    return done


def test_json_lines(root: Path) -> None:
    first, second = map(json.loads, run(root, NESTED).stdout.splitlines())
    assert first["header"]["frame_id"] == "map"
    assert first["header"]["stamp"] == second["header"]["stamp"] - 1
    assert (first["many"], first["tags"], first["d"]) == ([], {"site": "hall"}, 1.5)
    assert second["many"] == ["Infinity"]
    assert (first["day"], first["clock"], first["nothing"]) == ("2020-01-02", "10:00:01", None)
    assert first["i"] == {"months": 0, "days": 3, "nanoseconds": 0}
    assert first["numbered"] == {"1": "a"}


@pytest.mark.parametrize("odd", ["'infinity'::date", "'-infinity'::timestamp"])
def test_a_time_that_python_lacks(root: Path, odd: str) -> None:
    for form in ("jsonl", "table"):
        with pytest.raises(UsageError, match="::varchar"):
            run(root, f"select {odd} as far", "-F", form)
    assert "infinity" in run(root, f"select ({odd})::varchar as far", "-F", "jsonl").stdout


def test_files(root: Path, tmp_path: Path) -> None:
    query = "select t, name, header, tags, words, 1.5::decimal(4, 2) as d from large order by t"
    path = tmp_path / "answer.parquet"
    run(root, query, "-o", path)
    with pytest.raises(UsageError, match="exists; --force overwrites it"):
        run(root, query, "-o", path)
    assert pa.parquet.read_table(tmp_path / "answer.parquet").num_rows == LARGE + 40


@pytest.mark.parametrize("form", ["jsonl", "csv", "parquet"])
def test_two_columns_of_one_name_are_refused(root: Path, tmp_path: Path, form: str) -> None:
    query = "select a.t, b.t from large a join large b using (t) order by a.t limit 1"
    with pytest.raises(UsageError, match="two columns 't': name one with `as`"):
        run(root, query, "-F", form, "-o", tmp_path / "answer")
    assert not (tmp_path / "answer").exists()
    assert run(root, query, "-F", "table").stdout.split()[:2] == ["t", "t"]
    with hl.open(root, mongo="none") as store:
        answer = store.sql(query)
        assert len(answer.rows()[0]) == answer.to_arrow().num_columns == 2
        with pytest.raises(UsageError, match="two columns"):
            answer.to_pandas()


def test_tables_and_notes(root: Path) -> None:
    shown = run(root, "select t, tags from large", "-F", "table")
    assert "{site: hall}" in shown.stdout
    assert "The first 20 rows." in shown.stderr
    times = run(root, "select log_time, header from large order by t limit 1", "-F", "table")
    assert "2023-11-14T22:13:20Z  {seq: 0, stamp: 2023-11-14T22:13:19Z" in times.stdout
    assert "No row." in run(root, "select t from large limit 0", "-F", "table").stderr
    # Many pieces have one heading, and columns of one width.
    done = run(root, "select recording, t from large", "-F", "table", "-n", LARGE + 40)
    first, *lines = done.stdout.splitlines()
    assert first.split() == ["recording", "t"]
    assert (len(lines), len({len(line) for line in lines})) == (LARGE + 40, 1)


def test_standard_input(root: Path) -> None:
    done = run(root, stdin="create table a as select 1 as x; select x + 1 as y from a;")
    assert done.stdout == '{"y": 2}\n'
    with pytest.raises(UsageError, match="The query is empty"):
        run(root, stdin="")


def test_unreadable_messages_are_told(tmp_path: Path) -> None:
    said = [(BASE + n, "/large", payload(n)[: 40 if n == 3 else None]) for n in range(6)]
    with hl.open(tmp_path / "store", create=True) as opened:
        opened.record(write_log(tmp_path / "log.mcap", said), name="odd")
        answer = opened.sql("select t, i8, error, state from large where i8 is null")
        ((time, _, error, state),) = answer.rows()
        assert (time, state) == (BASE + 3, "unreadable")
        assert "does not fit" in error
        assert answer.reading.absent == {("/large", "unreadable"): 1}
    done = run(tmp_path / "store", "select count(*) from large", "-F", "csv")
    assert done.stdout.splitlines()[1] == "6"
    assert "/large: 1 message does not fit its definition; the fields are null" in done.stderr


def test_losses_are_told(root: Path, tmp_path: Path) -> None:
    shutil.copytree(root, tmp_path / "store", ignore=shutil.ignore_patterns("mongod*"))
    places.segment(tmp_path / "store", "second").unlink()
    done = run(tmp_path / "store", "select count(*) from large", "-F", "csv")
    assert done.stdout.splitlines()[1] == str(LARGE)
    lost = run(
        tmp_path / "store", "select topic, sum(messages)::int from losses group by all", "-F", "csv"
    )
    assert '"/large",40' in lost.stdout.splitlines()
    with pytest.raises(IncompleteError, match="lost"):
        run(tmp_path / "store", "select count(*) from large", "--strict")
    assert run(tmp_path / "store", "select count(*) from scan", "--strict", "-F", "csv").stdout
    # What is asked about has lost nothing.
    for scope in (["-r", "first"], ["--between", BASE, BASE + SECOND]):
        done = run(tmp_path / "store", "select count(*) from large", "--strict", *scope)
        assert (json.loads(done.stdout)["count_star()"], done.stderr) in {(LARGE, ""), (1000, "")}
