"""The examples of `docs/contributing.md`, added to a copy of the package by the page alone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hybridlog.formats import LOGS, OUTPUTS
from tests.imports import ROOT

TABLES = {"OUTPUTS": "OutputFormat]] = {\n", "LOGS": "LOGS: Final = (\n"}
LINES = '{"log_time_ns": 1000000001, "topic": "/a", "x": 1.5}\nno line\n' + "".join(
    f'{{"log_time_ns": {1_000_000_002 + n}, "topic": "/b", "n": {n}, "s": "p|q"}}\n'
    for n in range(2500)
)


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a copy of the package to which the page was applied."""
    folder = tmp_path_factory.mktemp("extended")
    package = folder / "hybridlog"
    (package / "formats").mkdir(parents=True)
    for below in (".", "formats"):
        for path in (ROOT / "hybridlog" / below).iterdir():
            copy = package / below / path.name
            if path.name == "__init__.py":
                copy.write_bytes(path.read_bytes())
            elif path.name not in {"formats", "__pycache__"}:
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
        touched[name] = touched.get(name, 0) + 1
        path.write_text(text, "utf-8")
    assert len(touched) == 3  # a writer, a reader, and the tables of both
    return folder


def run(folder: Path, *words: str, code: int = 0) -> tuple[str, str]:
    environment = os.environ | {"PYTHONPATH": str(folder), "HYBRIDLOG_MONGO_URI": "none"}
    command = [sys.executable, "-m", "hybridlog", *words]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
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


def test_the_tables_name_what_exists() -> None:
    for log in LOGS:
        module, _, name = log.reader.partition(":")
        assert hasattr(__import__(module, fromlist=[name]), name)
    for output in OUTPUTS.values():
        module, _, name = output.writer.partition(":")
        assert hasattr(__import__(module, fromlist=[name]), name)
    suffixes = [suffix for output in OUTPUTS.values() for suffix in output.suffixes]
    assert len(suffixes) == len(set(suffixes))
    # The page about the command line has a row for each.
    page = (ROOT / "docs" / "cli.md").read_text("utf-8")
    for name in OUTPUTS:
        assert re.search(rf"^\|.*`{name}`.*\|", page, re.MULTILINE), name
