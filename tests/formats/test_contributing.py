"""The examples of `docs/contributing.md`, added to a copy of the package by the page alone."""

from __future__ import annotations

import json
import os
import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hybridlog.formats import LOGS, OUTPUTS
from hybridlog_storage.messages import Channel, Schema
from tests.imports import ROOT
from tests.independent import write_mcap

TABLES = {
    "OUTPUTS": "OutputFormat]] = {\n",
    "LOGS": "LOGS: Final = (\n",
    "DTYPES": "DTYPES: Final = {\n",
    "GROUPS": "GROUPS: Final = {\n",
}
"""Where rows of a table begin."""
LINES = '{"log_time_ns": 1000000001, "topic": "/a", "x": 1.5}\nno line\n' + "".join(
    f'{{"log_time_ns": {1_000_000_002 + n}, "topic": "/b", "n": {n}, "s": "p|q"}}\n'
    for n in range(2500)
)

HALF = """
import json, sys
import hybridlog as hl
from tests.every_output import written
from tests.independent import write_mcap
from hybridlog_storage.messages import Channel, Schema

with hl.open(sys.argv[1], create=True) as store:
    store.record(sys.argv[2])
    half = store.topic("/half")
    where = half.where("r.max > 24 and x >= 49").count()
    ((x, r),) = store.sql("select max(x), sum(list_sum(r)) from half").rows()
    (asof,) = half.resample("1s").to_arrow()["x"].to_pylist()
    print(json.dumps({"where": where, "x": x, "r": r, "asof": asof}))
    print(written(half.limit(2), "jsonl").decode().splitlines()[1])
"""


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a copy of the package to which the page was applied."""
    folder = tmp_path_factory.mktemp("extended")
    package = ROOT / "hybridlog"
    for path in package.rglob("*"):
        copy = folder / path.relative_to(ROOT)
        if path.is_dir():
            copy.mkdir(parents=True, exist_ok=True)
        elif path.suffix != ".pyc":
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.symlink_to(path)
    page = (ROOT / "docs" / "contributing.md").read_text("utf-8")
    blocks = re.findall(
        r"^```(?:python|text) (\S+) ?(\w*)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE
    )
    touched: dict[str, int] = {}
    for name, table, text in blocks:
        path = folder / name
        if table:
            before, start, after = path.read_text("utf-8").partition(TABLES[table])
            assert start
            text = f"{before}{start}{text}{after}"
            path.unlink()
        touched[name] = touched.get(name, 0) + 1
        path.write_text(text, "utf-8")
    # A writer, a reader and the tables of both; a type of number; a command and its name.
    assert len(touched) == 6
    return folder


def run(folder: Path, *words: str, code: int = 0) -> tuple[str, str]:
    return execute(folder, "-m", "hybridlog", *words, code=code)


def execute(folder: Path, *words: str, code: int = 0) -> tuple[str, str]:
    environment = os.environ | {"PYTHONPATH": str(folder), "HYBRIDLOG_MONGO_URI": "none"}
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr
    return done.stdout, done.stderr


def test_the_examples(extended: Path) -> None:
    (extended / "log.jsonl").write_text(LINES)
    run(extended, "record", "log.jsonl", code=4)  # a line is damaged
    assert run(extended, "fetch", "-t", "/b", "--count", "-q")[0] == "2500\n"
    assert "a line that is no message" in run(extended, "info", "--losses")[0]
    first = ("-n", "1", "-q")
    lines = run(extended, "fetch", "-t", "/b", *first, "-F", "markdown")[0].splitlines()
    assert lines == [
        "| log_time | n | s |",
        "| --- | --- | --- |",
        "| 1970-01-01T00:00:01.000000002Z | 0 | p\\|q |",
    ]
    run(extended, "fetch", "-t", "/b", *first, "-o", "out.md")
    assert (extended / "out.md").read_text().splitlines() == lines
    assert run(extended, "sql", "select 1 as one", "-q", "-F", "markdown")[0] == (
        "| one |\n| --- |\n| 1 |\n"
    )
    run(extended, "export", "tables", "-F", "markdown", "-q")
    assert sorted(path.name for path in (extended / "tables").iterdir()) == ["a.md", "b.md"]
    assert "markdown" in run(extended, "align", "--help")[0]
    run(extended, "tag", "log", "a=b", "-q")
    assert run(extended, "tags")[0].splitlines() == ["recording  tags", "log.jsonl  a=b"]
    assert json.loads(run(extended, "tags", "--json")[0]) == [
        {"recording": "log.jsonl", "tags": {"a": "b"}}
    ]


def test_a_field_type(extended: Path, tmp_path: Path) -> None:
    log = tmp_path / "half.mcap"
    schema = Schema("demo/Half", "ros2msg", b"float16 x\nfloat16[] r\n")
    channel, said = Channel("/half", "cdr", schema), []
    for n in range(100):
        r = np.arange(n, dtype=np.float16) / 4
        head = b"\0\1\0\0" + np.float16(n / 2).tobytes() + b"\0\0"
        said.append((channel, 10**9 + n, head + struct.pack("<I", n) + r.tobytes()))
    write_mcap(log, said)
    found = execute(extended, "-c", HALF, str(tmp_path / "store"), str(log))[0]
    assert list(map(json.loads, found.splitlines())) == [
        {"where": 2, "x": 49.5, "r": sum(n * (n - 1) / 8 for n in range(100)), "asof": 0.0},
        {"log_time_ns": 1_000_000_001, "topic": "/half", "x": 0.5, "r": [0]},
    ]


def test_the_tables_name_what_exists() -> None:
    for log in LOGS:
        module, _, name = log.reader.partition(":")
        assert hasattr(__import__(module, fromlist=[name]), name)
    for output in OUTPUTS.values():
        module, _, name = output.writer.partition(":")
        assert hasattr(__import__(module, fromlist=[name]), name)
    suffixes = [suffix for output in OUTPUTS.values() for suffix in output.suffixes]
    assert len(suffixes) == len(set(suffixes))
    text = (ROOT / "docs" / "contributing.md").read_text("utf-8")
    for place in re.findall(r"`(hybridlog/[\w./]+)`", text):
        assert (ROOT / place).exists() or f"python {place}" in text, place
    # The page about the command line has a row for each.
    page = (ROOT / "docs" / "cli.md").read_text("utf-8")
    for name in OUTPUTS:
        assert re.search(rf"^\|.*`{name}`.*\|", page, re.MULTILINE), name
