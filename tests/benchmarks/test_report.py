"""The report: its numbers are those of the samples, and it says what was not measured."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import numbers
from benchmarks.backends.registry import BACKENDS
from benchmarks.numbers import Spread
from benchmarks.questions.askers import ASKERS
from benchmarks.report import Report, escaped, write
from benchmarks.samples import DAMAGE, Journal, Sample
from hybridlog_storage.threads import processors
from tests.imports import ROOT

HEADER = {
    "quick": False,
    "seed": 7,
    "settings": {"throughput": {"messages": 500}},
    "command": ["python", "-m", "benchmarks", "all", "--out", "a b"],
    "cpu": "a processor",
    "cores": 2,
    "packages": {"mcap": "1"},
    "mongod": "6",
    "revision": "abc",
    "started": "now",
}


def run_values(share: float = 1.0, mb: float = 10.0, **more: float) -> dict[str, Any]:
    """Values of a run of 10 s and 1000 messages, `mb` MB a second, of which `share` is kept."""
    return {
        "published": 1000,
        "persisted": round(1000 * share),
        "published_bytes": int(mb * 1e7),
        "persisted_bytes": int(mb * 1e7 * share),
        "publish_s": 10.0,
        "due_s": 10.0,
        "wall_s": 10.0,
        "cpu_s": 2.0,
        "server_cpu_s": 1.0,
        "peak_rss": 10**8,
        "server_peak_rss": 2 * 10**7,
        "disk_bytes": int(mb * 1e7),
        "depth_p50": 0,
        "depth_p90": 1,
        "depth_p99": 2,
        "late_ms_p50": 0.1,
        "late_ms_p99": 1.0,
        "spin_ms": 20.0,
        "steal_s": 0.0,
        **more,
    }


def stream(backend: str, share: float, repetition: int = 0, **more: Any) -> Sample:
    case = {"size": more.pop("size", 5000), "rate": more.pop("rate", 64), "topics": 20}
    return Sample("throughput", case, backend, repetition, "ok", run_values(share, **more))


def whole_log(log: str, backend: str, share: float, **more: float) -> Sample:
    return Sample("persistence", {"log": log}, backend, 0, "ok", run_values(share, **more))


def question(name: str, backend: str, ms: float, answer: Any = 3) -> Sample:
    values = {"ms": ms, "cold_ms": 2 * ms, "answer": answer}
    return Sample("queries", {"question": name}, backend, 0, "ok", values)


def trial(backend: str, rate: int, share: float, repetition: int = 0) -> Sample:
    case = {"size": 5000, "rate": rate, "topics": 20, "messages": 500}
    return Sample("ceiling", case, backend, repetition, "ok", run_values(share, mb=rate / 10))


def report(directory: Path, *samples: Sample, **header: Any) -> Report:
    journal = Journal(directory)
    journal.begin({**HEADER, **header})
    for sample in samples:
        journal.add(sample)
    return Report(Journal(directory))


def table(found: Report, heading: str) -> dict[str, dict[str, str]]:
    """Rows of a table by their first cell, cells by their column."""
    text = found.markdown().split(f"### {heading}")[1]
    (lines,) = re.findall(r"\n\n((?:\|.*\n)+)", text.partition("###")[0] + "\n")[:1]
    cells = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines.splitlines()]
    head, _, *rows = [[cell.strip() for cell in row] for row in cells]
    return {row[0]: dict(zip(head[1:], row[1:], strict=True)) for row in rows}


@given(st.lists(st.floats(0, 1e9), min_size=1))
def test_a_spread_is_the_median_between_least_and_greatest(values: list[float]) -> None:
    assert Spread.of(values) == Spread(median(values), min(values), max(values))
    assert Spread.of([None, *values]) == Spread.of(values)
    assert Spread.of([]) is Spread.of([None]) is None


@given(st.floats(1e-6, 1e12))
def test_numbers_keep_three_digits(value: float) -> None:
    shown = float(numbers.number(value).replace(",", ""))
    assert math.isclose(shown, value, rel_tol=5.1e-3)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (0.01234, "0.0123"),
        (1.5, "1.5"),
        (9.999, "10"),
        (12345, "12,300"),
        (999.9, "1,000"),
    ],
)
def test_numbers(value: float, text: str) -> None:
    assert numbers.number(value) == text


@given(st.integers(1, 10**7), st.data())
def test_less_than_all_is_never_shown_as_100_percent(count: int, data: st.DataObject) -> None:
    kept = data.draw(st.integers(0, count))
    assert (numbers.percent(100 * kept / count) == "100") == (kept == count)


def test_a_small_spread_is_left_out() -> None:
    assert numbers.with_spread(Spread(10, 9.96, 10.04)) == "10"
    assert numbers.with_spread(Spread(10, 9, 11)) == "10 (9…11)"
    assert numbers.listed(["a"]) == "a"
    assert numbers.listed(["a", "b", "c"]) == "a, b and c"


def test_every_row_has_a_name_and_ours_comes_first() -> None:
    rows = [*BACKENDS, *(row for rows in ASKERS.values() for row in rows)]
    assert [name for name in rows if name not in numbers.TITLES] == []
    assert numbers.ordered(["zz", "nothing", "sqlite_udf", "hybridlog"]) == [
        "hybridlog",
        "sqlite_udf",
        "nothing",
        "zz",
    ]


def test_throughput_is_bytes_found_over_wall_time(tmp_path: Path) -> None:
    found = report(
        tmp_path,
        *(stream("hybridlog", 1.0, n) for n in range(3)),
        *(stream("mongo_json", share, n) for n, share in enumerate((0.4, 0.5, 0.2))),
    )
    rates = table(found, "Throughput at 64 Hz a topic, MB/s")
    assert rates == {
        "offered": {"5 kB": "10"},
        "hybridlog": {"5 kB": "10"},
        "MongoDB": {"5 kB": "4 (2…5)"},
    }
    shares = table(found, "Persisted at 64 Hz a topic")
    assert shares == {"hybridlog": {"5 kB": "100"}, "MongoDB": {"5 kB": "40 (20…50)"}}
    assert any("2.5 times what the best database kept (MongoDB" in f for f in found.findings)
    assert "of 3 repetitions" in found.markdown()


def test_sizes_and_rates_have_their_own_columns_and_tables(tmp_path: Path) -> None:
    found = report(
        tmp_path,
        stream("hybridlog", 1.0, size=640_000, rate=4, mb=3),
        stream("hybridlog", 1.0, size=5000, rate=4, mb=2),
        stream("mcap", 0.5, size=5000, rate=64, mb=4),
    )
    assert table(found, "Throughput at 4 Hz")["hybridlog"] == {"5 kB": "2", "640 kB": "3"}
    assert table(found, "Throughput at 64 Hz")["plain MCAP"] == {"5 kB": "2"}


def test_cost_is_for_a_gigabyte_that_was_kept(tmp_path: Path) -> None:
    found = report(tmp_path, stream("hybridlog", 0.5), stream("sqlite_udf", 1.0))
    assert table(found, "CPU seconds")["hybridlog"] == {"5 kB": "60"}
    assert table(found, "CPU seconds")["SQLite (Python functions)"] == {"5 kB": "30"}
    assert table(found, "Bytes on the disk")["hybridlog"] == {"5 kB": "2"}
    assert table(found, "Peak memory, MB")["hybridlog"] == {"logger": "100", "servers": "20"}
    assert table(found, "throughput")["hybridlog"]["depth p99"] == "2"


def test_ceilings_are_those_of_the_search(tmp_path: Path) -> None:
    found = report(
        tmp_path,
        *(trial("hybridlog", rate, 1.0) for rate in (64, 128, 256)),
        trial("hybridlog", 512, 0.9),
        trial("mongo_json", 64, 1.0),
        trial("mongo_json", 128, 0.5),
        trial("sqlite_udf", 64, 0.99),
        trial("nothing", 512, 1.0),
    )
    assert {name: row["5 kB"] for name, row in table(found, "Ceiling, MB/s").items()} == {
        "hybridlog": "25.6",
        "MongoDB": "6.4",
        "SQLite (Python functions)": "none",
        "harness alone": "≥ 51.2 (plan)",
    }
    assert table(found, "Ceiling, messages/s")["hybridlog"]["5 kB"] == "5,120"
    assert any("up to 25.6 MB/s, 4 times" in text for text in found.findings)


BOUNDS = {"start": 64.0, "lowest": 1.0, "highest": 16384.0, "halvings": 0}


def test_a_search_that_was_stopped_is_no_ceiling(tmp_path: Path) -> None:
    found = report(
        tmp_path,
        trial("hybridlog", 64, 1.0),
        trial("mongo_json", 64, 0.9),
        *(trial("sqlite_udf", rate, 1.0 if rate < 256 else 0.9) for rate in (64, 128, 256)),
        settings={"ceiling": BOUNDS},
    )
    assert {name: row["5 kB"] for name, row in table(found, "Ceiling, MB/s").items()} == {
        "hybridlog": "≥ 6.4 (stopped)",
        "MongoDB": "none so far (stopped)",
        "SQLite (Python functions)": "12.8",
    }
    assert any("up to 6.4 MB/s or more" in text for text in found.findings)


def test_ceilings_of_several_searches_have_a_spread(tmp_path: Path) -> None:
    trials = [trial("mcap", r, float(r <= 64 << n), n) for n in (0, 1) for r in (64, 128, 256)]
    assert (
        table(report(tmp_path, *trials), "Ceiling, MB/s")["plain MCAP"]["5 kB"] == "9.6 (6.4…12.8)"
    )


def test_speeds_of_several_searches_have_a_spread(tmp_path: Path) -> None:
    def play(backend: str, speed: int, share: float, repetition: int = 0) -> Sample:
        case = {"log": "hcr1", "speed": speed}
        return Sample("speed-up", case, backend, repetition, "ok", run_values(share))

    found = report(
        tmp_path,
        *(play("mcap", s, float(s <= 2 << n), n) for n in (0, 1) for s in (1, 2, 4, 8)),
        play("hybridlog", 64, 1.0),
        play("sqlite_udf", 1, 0.9),
    )
    rows = table(found, "Greatest speed")
    assert {name: row["hcr1"] for name, row in rows.items()} == {
        "hybridlog": "≥ 64",
        "SQLite (Python functions)": "0",
        "plain MCAP": "3 (2…4)",
    }


def test_logs_that_lose_something_are_named(tmp_path: Path) -> None:
    found = report(
        tmp_path,
        whole_log("mit1", "hybridlog", 1.0),
        whole_log("mit1", "sqlite_udf", 0.8),
        whole_log("hcr1", "hybridlog", 1.0),
        whole_log("hcr2", "hybridlog", 1.0, **{DAMAGE: "its tail is gone"}),  # type: ignore[arg-type]
    )
    assert "Of mit1 something was lost by SQLite (Python functions) 80 %." in found.findings
    assert "Of hcr1 and hcr2 every backend that took part kept everything." in found.findings
    assert any("its tail is gone" in text for text in found.findings)
    assert table(found, "Persisted, %")["hybridlog"] == {
        "mit1": "100",
        "hcr1": "100",
        "hcr2": "100",
    }
    assert table(found, "The logs")["mit1"] == {"messages": "1,000", "seconds": "10", "MB/s": "10"}


def test_answers_that_differ_are_told(tmp_path: Path) -> None:
    same = report(tmp_path / "a", question("Q1", "hybridlog", 1.0), question("Q1", "mcap", 9.0))
    assert same.differing == []
    assert table(same, "Table 1")["hybridlog"] == {"Q1": "1"}
    assert table(same, "The first time")["plain MCAP"] == {"Q1": "18"}
    assert table(same, "The paper's Table 1")["MongoDB"]["Q4"] == "2,680"
    other = question("Q1", "mcap", 9.0, answer=4)
    found = report(tmp_path / "b", question("Q1", "hybridlog", 1.0), other)
    assert found.differing == ["Q1"]
    assert "DIFFER" in found.markdown()
    assert "do not agree on Q1" in found.findings[0]


def test_noise_is_told_with_its_figures(tmp_path: Path) -> None:
    quiet = report(tmp_path / "quiet", *(stream("mcap", 1.0, n) for n in range(10)))
    assert not any("quiet" in text or "late" in text for text in quiet.findings)
    loud = [stream("mcap", 1.0, n, spin_ms=20.0 + 5 * n, late_ms_p99=30.0) for n in range(10)]
    found = report(tmp_path / "loud", *loud).findings
    assert any("took 25 ms" in text and "65 ms" in text for text in found)
    assert "The publisher was more than 20 ms late in 10 of 10 runs." in found


def test_a_share_that_the_machine_may_have_cost_is_marked(tmp_path: Path) -> None:
    stolen = 10.0 * processors() * 0.2
    found = report(tmp_path, stream("mcap", 0.9, steal_s=stolen), stream("hybridlog", 1.0))
    shares = table(found, "Persisted at 64 Hz")
    assert (shares["plain MCAP"]["5 kB"], shares["hybridlog"]["5 kB"]) == ("90†", "100")
    assert "† The host of this machine" in found.markdown()


def test_missing_and_failed_are_named(tmp_path: Path) -> None:
    case = {"size": 5000, "rate": 4}
    found = report(
        tmp_path,
        Sample("throughput", case, "postgres_tuned", 0, "missing", {}, "install it"),
        Sample("throughput", case, "mongo_json", 0, "failed", {}, "it crashed | badly"),
    )
    text = found.markdown()
    assert "| missing | throughput | PostgreSQL (tuned) |  | install it |" in text
    assert "| failed | throughput | MongoDB | size 5000, rate 4 | it crashed \\| badly |" in text
    assert [one.backend for one in found.failed] == ["mongo_json"]


def test_runs_are_listed_and_quick_ones_marked(tmp_path: Path) -> None:
    found = report(tmp_path, stream("mcap", 1.0), quick=True)
    text = found.markdown()
    assert found.quick
    assert "quick run" in text.splitlines()[0]
    assert "| now | abc | a processor, 2, ?, ? | mcap 1, MongoDB 6 |" in text
    assert "`python -m benchmarks all --out 'a b'`" in text


def test_an_empty_journal_makes_a_report(tmp_path: Path) -> None:
    found = Report(Journal(tmp_path))
    assert "Nothing yet." in found.markdown()
    assert (found.failed, found.missing, found.differing, found.findings) == ([], [], [], [])


def test_names_and_messages_are_not_obeyed(tmp_path: Path) -> None:
    evil = "a|b\n# <script>\x1b[31m`x"
    text = report(tmp_path, whole_log(evil, "mcap", 0.5)).markdown()
    assert "<script>" not in text.replace("\\<script\\>", "")
    assert "\x1b" not in text
    assert "\n# \\<" not in text
    assert escaped("a `b|c_d` e_f") == "a `b\\|c_d` e\\_f"


def test_tables_are_rectangles_and_figures_are_drawn(tmp_path: Path) -> None:
    samples = [
        *(stream(b, 0.5, size=s) for b in BACKENDS for s in (5000, 10_000)),
        *(trial("hybridlog", rate, 1.0) for rate in (64, 128)),
        whole_log("a_real_log", "mcap", 0.5),
        question("Q1", "hybridlog", 1.0),
        Sample("reading", {"task": "a second"}, "mcap", 0, "ok", {"ms": 1.0, "first_ms": 2.0}),
    ]
    report(tmp_path, *samples)
    _, path = write(Journal(tmp_path), tmp_path)
    text = path.read_text("utf-8")
    places = re.findall(r"!\[[^\]]+\]\((figures/[\w-]+\.svg)\)", text)
    assert len(places) == len(set(places)) == 6
    for place in places:
        assert ET.parse(tmp_path / place).getroot().tag.endswith("svg")
    before = {place: (tmp_path / place).read_bytes() for place in places}
    write(Journal(tmp_path), tmp_path)
    assert {place: (tmp_path / place).read_bytes() for place in places} == before
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        widths = {len(re.split(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(widths) == 1, block
    assert not list(tmp_path.glob("*.new"))


def test_without_matplotlib_there_are_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    report(tmp_path, stream("mcap", 1.0))
    text = write(Journal(tmp_path), tmp_path)[1].read_text("utf-8")
    assert "figures need matplotlib" in text
    assert "| plain MCAP | 10 |" in text


def test_the_published_journal_is_read() -> None:
    """The published report and the journal beside it say the same."""
    directory = ROOT / "docs" / "benchmarks-results"
    found = Report(Journal(directory))
    published = (directory / "report.md").read_text("utf-8")
    assert found.differing == []
    for heading, name in (
        ("Throughput at 64 Hz a topic, MB/s", "hybridlog"),
        ("Persisted at 64 Hz a topic", "SQLite (JSON1)"),
        ("Ceiling", "MongoDB (batched)"),
        ("Table 1", "PostgreSQL (tuned)"),
        ("Greatest speed", "ROS bag"),
    ):
        row = table(found, heading)[name]
        shown = [cell.replace("≥ ", "") for cell in list(row.values())[:4]]
        lines = [line for line in published.splitlines() if line.startswith(f"| {name} |")]
        assert any(all(cell in re.sub(r"x\b", "", line) for cell in shown) for line in lines), (
            heading,
            row,
        )
