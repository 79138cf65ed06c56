"""The page and the README's table, from a small set of results."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import page
from benchmarks.machine import describe
from benchmarks.questions.base import QUESTIONS
from benchmarks.samples import Journal, Sample
from benchmarks.studies import record

SYSTEMS = {"hybridlog": 400.0, "mongo": 60.0, "sqlite": 80.0, "bagfile": 900.0}
"""MB/s that each keeps of the model."""


def values(kept: float, offered: float) -> dict[str, float]:
    """Those of a trial in which a system keeps so many MB of those offered in a second."""
    share = min(kept / offered, 1.0)
    return {
        "published": 1000,
        "persisted": round(1000 * share),
        "published_bytes": offered * 1e6,
        "persisted_bytes": offered * 1e6 * share,
        "disk_bytes": offered * 5e5 * share,
        "publish_s": 1.0,
        "due_s": 1.0,
        "cpu_s": 2.0,
        "server_cpu_s": 1.0,
        "peak_rss": 5e7,
        "server_peak_rss": 1e7,
        "spin_ms": 10.0,
    }


def samples() -> list[Sample]:
    found = []
    for name, kept in SYSTEMS.items():
        for bytes_ in record.SIZES:
            for rate in (64.0, 128.0):
                case = {"size": bytes_, "rate": rate}
                offered = values(kept, bytes_ * 20 * rate / 1e6)
                found.append(Sample("record", case, name, 0, values=offered))
        case = {"seconds": 20, "speed": 2}
        found.append(Sample("logs", case, name, 0, values=values(kept, 10.0)))
    asked = {"hybridlog": 1.0, "mongo_indexed": 30.0, "postgres_indexed": 2.5, "bagfile": 400.0}
    for name, ms in asked.items():
        for question in QUESTIONS:
            case = {"question": question, "sessions": 4, "minutes": 10.0}
            for repetition in range(3):
                times = {"ms": ms + repetition, "cold_ms": 2 * ms}
                found.append(Sample("queries", case, name, repetition, values=times))
        found += [
            Sample("reading", {"task": task}, name, 0, values={"ms": ms})
            for task in ("1 s of scans", "scan at a time", "IMU to pandas")
        ]
    timed = {"ms": 1.5, "low": 1.4, "high": 1.6, "cpu_ms": 1.0}
    groups = {
        "commands": {
            "rows": {"`info`": {**timed, "peak_mb": 40.0}},
            "log_bytes": 10**8,
            "disk_bytes": 2 * 10**8,
            "segment_bytes": 10**8,
        },
        "sql": {"rows": {"count": {**timed, "duckdb_ms": 1.1}}},
        "many": {"rows": {"`ls`": timed}},
        "page": {"rows": {"zoom": timed}, "memory_mb": 100.0},
        "remote": {"rows": [{"step": "open", "requests": 3, "received": 5000, "sent": 0}]},
    }
    for name, measured in groups.items():
        case = {"group": name, "seconds": 600, "recordings": 1000}
        found.append(Sample("tasks", case, "hybridlog", 0, values=measured))
    rows = [{"case": "small", "recorder": "hybridlog", "text": "all of it"}]
    found.append(Sample("live", {"case": "small"}, "hybridlog", 0, values={"rows": rows}))
    return found


def journal(directory: Path, found: list[Sample], scale: str = "full") -> Journal:
    made = Journal(directory, {"scale": scale, "seed": 1, "command": [], **describe(directory)})
    for sample in found:
        made.add(sample)
    return made


def table_of(text: str, words: str) -> list[list[str]]:
    """The rows of the table whose head has these words."""
    lines = text.splitlines()
    begin = next(n for n, line in enumerate(lines) if line.startswith("|") and words in line)
    rows = []
    for line in lines[begin:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split(" | ")])
    return [rows[0], *rows[2:]]


def test_the_page_has_every_part_within_three_screens(tmp_path: Path) -> None:
    text = page.page(journal(tmp_path, samples()))
    assert len(text.splitlines()) < 150
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert len(tables) == 10
    for table in tables:
        assert len({line.count(" | ") for line in table.splitlines()}) == 1, table
    assert "A short run" not in text
    head, *rows = table_of(text, "kept of 819 MB/s")
    found = {row[0]: row[1:] for row in rows}
    assert head[1:] == ["5 kB", "40 kB", "640 kB", "a robot's log, times", "kept of 819 MB/s"]
    assert found["hybridlog"] == ["≥ 12.8", "≥ 102", "0", "≥ 2", "48.8 %"]
    assert found["MongoDB"] == ["≥ 12.8", "51.2", "0", "≥ 2", "7.3 %"]
    assert found["ROS bag"] == ["≥ 12.8", "≥ 102", "819", "≥ 2", "100 %"]
    asked = {row[0]: row[1:] for row in table_of(text, "| ms | hybridlog | MongoDB")[1:]}
    assert asked["Q1"] == ["2 / 2", "60 / 31", "5 / 3.5", "800 / 401"]
    assert set(QUESTIONS) == set(asked)


def test_the_readme_names_the_strongest_rival_and_where_a_bag_is_ahead(tmp_path: Path) -> None:
    text = page.readme(journal(tmp_path, samples()))
    assert text.startswith(page.BEGIN)
    assert text.endswith(page.END)
    rows = {row[0]: row[1:] for row in table_of(text, "the best database")}
    assert len(rows) == 11
    assert rows["20 topics of 640 kB at 64 Hz, 819 MB/s: kept"] == [
        *("48.8 %", "9.8 % (SQLite)", "100 %"),
    ]
    assert rows["the same, messages of 40 kB"] == ["≥ 102", "51.2 (MongoDB)", "≥ 102"]
    assert rows["a topic of an IMU as a frame, in ms"] == ["1", "2.5 (PostgreSQL)", "400"]
    assert "A ROS bag is ahead in 819 MB/s and the load of 640 kB." in text
    assert "`python -m benchmarks` makes them again" in text


@pytest.mark.parametrize(("scale", "words"), [("quick", "A short run"), ("tiny", "mean nothing")])
def test_what_is_not_to_be_cited_says_so(tmp_path: Path, scale: str, words: str) -> None:
    made = journal(tmp_path, samples(), scale)
    assert words in page.page(made)
    assert f"`python -m benchmarks --{scale}` makes them again" in page.readme(made)
