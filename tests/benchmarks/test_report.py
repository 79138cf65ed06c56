"""The report: numbers against a model, pages against independent parsers, honest words."""

from __future__ import annotations

import math
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.backends.registry import BACKENDS
from benchmarks.questions.askers import ASKERS
from benchmarks.report import figures, numbers
from benchmarks.report.book import Book
from benchmarks.report.build import report
from benchmarks.report.look import look, ordered
from benchmarks.report.markdown import escaped, markdown
from benchmarks.report.model import Line, Panel, Report, Section, Table, Value
from benchmarks.report.page import page
from benchmarks.report.terminal import show
from benchmarks.report.write import write
from benchmarks.samples import DAMAGE, Journal, Sample
from hybridlog.processors import processors

HEADER = {
    "quick": False,
    "seed": 7,
    "settings": {"throughput": {"messages": 500}},
    "backends": {"hybridlog": {"kind": "hybrid", "about": "both"}},
    "command": ["python", "-m", "benchmarks", "all", "--out", "a b"],
    "cpu": "a processor",
    "cores": 2,
    "memory_gib": 1.0,
    "system": "Linux",
    "python": "3",
    "packages": {"mcap": "1"},
    "mongod": "6",
    "revision": "abc",
    "started": "now",
    "load_1min": 0.0,
}
VOID = {"meta", "br", "img", "link", "hr", "input"}


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
        "server_peak_rss": 0,
        "disk_bytes": int(mb * 1e7),
        "depth_p50": 0,
        "depth_p90": 1,
        "depth_p99": 2,
        "depth_max": 3,
        "late_ms_p50": 0.1,
        "late_ms_p99": 1.0,
        "late_ms_max": 2.0,
        "spin_ms": 20.0,
        "steal_s": 0.0,
        "other_cpu_s": 0.0,
        **more,
    }


def stream(backend: str, share: float, repetition: int = 0, **more: float) -> Sample:
    case = {"size": 5000, "rate": 64, "topics": 20, "messages": 500}
    return Sample("throughput", case, backend, repetition, "ok", run_values(share, **more))


def whole_log(log: str, backend: str, share: float, **more: float) -> Sample:
    return Sample("persistence", {"log": log}, backend, 0, "ok", run_values(share, **more))


def question(name: str, backend: str, ms: float, answer: Any = 3) -> Sample:
    return Sample("queries", {"question": name}, backend, 0, "ok", {"ms": ms, "answer": answer})


def journal(directory: Path, *samples: Sample, **header: Any) -> Journal:
    found = Journal(directory)
    found.begin({**HEADER, **header})
    for sample in samples:
        found.add(sample)
    return Journal(directory)


def section(found: Report, key: str) -> Section:
    (one,) = [s for s in found.sections if s.key == key]
    return one


def table(found: Report, title: str) -> Table:
    (one,) = [t for s in found.sections for t in s.tables if title in t.title]
    return one


def all_text(found: Report) -> str:
    return markdown(found, {})


def test_what_was_not_measured_is_told(tmp_path: Path) -> None:
    other = replace(stream("mcap", 1.0), case={"size": 10_000, "rate": 64})
    failed = replace(stream("bagfile", 1.0), status="failed", reason="full")
    found = report(
        journal(
            tmp_path,
            *(stream(name, 1.0) for name in BACKENDS if name not in {"nothing", "bagfile"}),
            other,
            failed,
            *(question("Q1", row, 1.0) for rows in ASKERS.values() for row in rows),
        )
    )
    rows = {str(row[0]): str(row[1]) for row in table(found, "What was not measured").rows}
    absent = {"ceilings", "logs", "logs, faster", "reading back"}
    assert rows.keys() == {"throughput", *absent}
    assert rows["ceilings"] == rows["reading back"] == "all of it"
    assert rows["throughput"].startswith("harness alone, ROS bag, MongoDB (1 of 2 streams were)")
    assert "plain MCAP" not in rows["throughput"]
    assert rows["throughput"].count("(1 of 2 streams were)") == len(BACKENDS) - 3


# --- numbers --------------------------------------------------------------------------


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=9))
def test_a_value_is_the_median_between_least_and_greatest(values: list[float]) -> None:
    found = Value.of(values)
    assert found is not None
    assert (found.median, found.low, found.high, found.count) == (
        median(values),
        min(values),
        max(values),
        len(values),
    )


def test_nothing_measured_has_no_value() -> None:
    assert Value.of([]) is None
    assert numbers.cell(None) == "—"


@given(st.floats(1e-6, 1e12))
def test_numbers_keep_three_digits(value: float) -> None:
    shown = float(numbers.number(value).replace(",", ""))
    assert math.isclose(shown, value, rel_tol=0.00501)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (9.999, "10"),
        (12.34, "12.3"),
        (0.01234, "0.0123"),
        (12345, "12,300"),
        (99.96, "100"),
        (1.5, "1.5"),
        (-2.345, "-2.35"),
        (100.0, "100"),
        (1000.4, "1,000"),
    ],
)
def test_numbers(value: float, text: str) -> None:
    assert numbers.number(value) == text


@given(st.integers(1, 10**7), st.data())
def test_less_than_all_is_never_shown_as_100_percent(count: int, data: st.DataObject) -> None:
    kept = data.draw(st.integers(0, count))
    shown = numbers.percent(100 * kept / count)
    assert (shown == "100") == (kept == count)
    assert abs(float(shown) - 100 * kept / count) <= 0.0501


def test_a_small_spread_is_left_out() -> None:
    assert numbers.with_spread(Value(10.0, 9.96, 10.04, 3)) == "10"
    assert numbers.with_spread(Value(10.0, 9.0, 10.04, 3)) == "10 (9…10)"


def test_ours_comes_first_and_strangers_last() -> None:
    assert ordered(["zebra", "mcap", "mongo_json", "hybridlog", "aardvark"]) == [
        "hybridlog",
        "mongo_json",
        "mcap",
        "aardvark",
        "zebra",
    ]
    assert look("zebra") == look("zebra")
    assert look("zebra").title == "zebra"


# --- what the samples say -------------------------------------------------------------


def test_throughput_is_bytes_found_over_wall_time(tmp_path: Path) -> None:
    found = report(
        journal(
            tmp_path,
            *(stream("hybridlog", 1.0, n) for n in range(3)),
            *(stream("mongo_json", share, n) for n, share in enumerate((0.4, 0.5, 0.2))),
        )
    )
    rows = {row[0]: row[1] for row in table(found, "Throughput at 64 Hz").rows}
    assert rows["hybridlog"] == Value(10.0, 10.0, 10.0, 3)
    assert rows["MongoDB"] == Value(4.0, 2.0, 5.0, 3)
    assert {row[0]: row[1] for row in table(found, "Persisted at 64 Hz").rows} == {
        "hybridlog": "100",
        "MongoDB": "40 (20…50)",
    }
    (graph,) = section(found, "throughput").graphs
    assert graph.panels[0].offered == ((5000.0, 10.0),)
    assert any("2.5 times what the best database kept" in text for text in found.findings)
    assert any("hybridlog 1 of 1 and MongoDB 0 of 1" in text for text in found.findings)
    assert found.warnings == ()


def test_cost_is_for_a_gigabyte_that_was_kept(tmp_path: Path) -> None:
    found = report(journal(tmp_path, stream("hybridlog", 0.5), stream("sqlite_udf", 1.0)))
    rows = {row[0]: row[1:] for row in table(found, "CPU seconds").rows}
    assert rows["hybridlog"] == (Value(40.0, 40.0, 40.0, 1), Value(20.0, 20.0, 20.0, 1))
    disk = {row[0]: row[1] for row in table(found, "Bytes on the disk").rows}
    assert disk["hybridlog"] == Value(2.0, 2.0, 2.0, 1)


def test_cost_is_compared_at_the_same_rate(tmp_path: Path) -> None:
    def at(backend: str, rate: float, cpu_s: float) -> Sample:
        one = stream(backend, 1.0)
        values = {**one.values, "cpu_s": cpu_s, "server_cpu_s": 0.0}
        return replace(one, case={**one.case, "rate": rate}, values=values)

    ours = (at("hybridlog", rate, cpu_s) for rate, cpu_s in ((4, 9.0), (16, 6.0), (64, 1.0)))
    theirs = (at("sqlite_udf", 16, 3.0), at("sqlite_udf", 64, 2.0), at("mcap", 4, 1.0))
    found = report(journal(tmp_path, *ours, *theirs)).findings
    told = [text for text in found if "of CPU time" in text]
    assert [re.findall(r"([0-9]+) Hz|([0-9.]+) times", text) for text in told] == [
        [("16", ""), ("", "0.5")],
        [("64", ""), ("", "2")],
    ]


def test_cost_is_compared_in_runs_of_both(tmp_path: Path) -> None:
    def cost(backend: str, repetition: int, cpu_s: float) -> Sample:
        return stream(backend, 1.0, repetition, cpu_s=cpu_s, server_cpu_s=0.0)

    def told() -> str:
        (one,) = (text for text in report(Journal(tmp_path)).findings if "of CPU time" in text)
        return one

    journal(tmp_path, cost("sqlite_udf", 0, 1.0), cost("sqlite_udf", 1, 1.0))
    journal(tmp_path, cost("hybridlog", 0, 4.0), cpu="slow")
    assert "takes 10 s (0.25 times as much)" in told()
    journal(tmp_path, cost("hybridlog", 1, 4.0), cost("sqlite_udf", 2, 5.0), cpu="slow")
    assert "takes 50 s in the same runs (1.25 times as much)" in told()


def ceiling_trial(backend: str, rate: int, share: float, repetition: int = 0) -> Sample:
    case = {"size": 5000, "rate": rate, "topics": 20, "messages": 500}
    return Sample("ceiling", case, backend, repetition, "ok", run_values(share, mb=rate / 10))


def test_ceilings_are_those_of_the_search(tmp_path: Path) -> None:
    trial = ceiling_trial
    found = report(
        journal(
            tmp_path,
            *(trial("hybridlog", rate, 1.0) for rate in (64, 128, 256)),
            trial("hybridlog", 512, 0.9),
            trial("mongo_json", 64, 1.0),
            trial("mongo_json", 128, 0.5),
            trial("sqlite_udf", 64, 0.99),
            trial("nothing", 512, 1.0),
        )
    )
    rows = {row[0]: row[1] for row in table(found, "Ceiling: offered load").rows}
    assert rows == {
        "hybridlog": "25.6",
        "MongoDB": "6.4",
        "SQLite (Python functions)": "none",
        "harness alone": "≥ 51.2 (plan)",
    }
    assert {row[0]: row[1] for row in table(found, "messages/s").rows}["hybridlog"] == "5,120"
    assert table(found, "over the best database's").rows[0] == ("ratio", "4")


BOUNDS = {"start": 64.0, "lowest": 1.0, "highest": 16384.0, "halvings": 0}


def test_a_search_that_was_stopped_is_no_ceiling(tmp_path: Path) -> None:
    found = report(
        journal(
            tmp_path,
            ceiling_trial("hybridlog", 64, 1.0),
            ceiling_trial("mongo_json", 64, 0.9),
            *(ceiling_trial("sqlite_udf", rate, 1.0 if rate < 256 else 0.9) for rate in (64, 256)),
            ceiling_trial("sqlite_udf", 128, 1.0),
            settings={"ceiling": {**BOUNDS, "sizes": [5000, 640_000]}},
        )
    )
    assert {row[0]: row[1] for row in table(found, "Ceiling: offered load").rows} == {
        "hybridlog": "≥ 6.4 (stopped)",
        "MongoDB": "none so far (stopped)",
        "SQLite (Python functions)": "12.8",
    }
    missing = {str(row[0]): str(row[1]) for row in table(found, "What was not measured").rows}
    assert "hybridlog (1 of 2 sizes were)" in missing["ceilings"]


def test_a_stopped_search_for_a_speed_is_told(tmp_path: Path) -> None:
    trial = Sample(
        "speed-up", {"log": "hcr1", "seconds": 20, "speed": 4}, "mcap", 0, "ok", run_values()
    )
    bounds = {**BOUNDS, "start": 1.0, "highest": 256.0}
    found = report(journal(tmp_path, trial, settings={"speed-up": bounds}))
    assert table(found, "Greatest speed").rows[0][1] == "4x or more (stopped)"


def test_how_much_of_a_log_was_published_is_told(tmp_path: Path) -> None:
    one = replace(whole_log("mit1", "mcap", 1.0), case={"log": "mit1", "seconds": 60})
    assert "the first 60 s of each if it is longer" in all_text(report(journal(tmp_path, one)))


def test_speeds_of_several_searches_have_a_spread(tmp_path: Path) -> None:
    def trial(backend: str, speed: int, repetition: int, share: float = 1.0) -> Sample:
        case = {"log": "hcr1", "seconds": 20, "speed": speed}
        return Sample("speed-up", case, backend, repetition, "ok", run_values(share))

    found = report(
        journal(
            tmp_path,
            *(trial("hybridlog", speed, n) for n in range(2) for speed in (1, 2)),
            trial("hybridlog", 4, 1),
            trial("hybridlog", 4, 0, 0.9),
            trial("mongo_json", 1, 0),
            trial("mongo_json", 2, 0, 0.9),
            trial("mongo_json", 1, 1, 0.9),
            trial("sqlite_udf", 1, 0, 0.9),
        )
    )
    assert {row[0]: row[1] for row in table(found, "Greatest speed").rows} == {
        "hybridlog": "3x (2…4) or more",  # the second search came to its end
        "MongoDB": "below 1x to 1x",
        "SQLite (Python functions)": "below 1x",
    }


def test_ceilings_are_compared_in_runs_of_both_too(tmp_path: Path) -> None:
    def search(backend: str, kept: int, repetition: int) -> list[Sample]:
        return [
            ceiling_trial(backend, kept, 1.0, repetition),
            ceiling_trial(backend, 2 * kept, 0.5, repetition),
        ]

    def told() -> str:
        found = report(Journal(tmp_path)).findings
        (one,) = (text for text in found if "keeps everything up to" in text)
        return one

    def ratios() -> tuple[tuple[object, ...], ...]:
        return table(report(Journal(tmp_path)), "over the best database's").rows

    journal(tmp_path, *search("hybridlog", 400, 0), *search("sqlite_udf", 200, 0))
    assert ratios() == (("ratio", "2"), ("best database", "SQLite (Python functions)"))
    assert "2 times what the best database does" in told()
    assert "In the runs of both" not in told()
    journal(tmp_path, *search("sqlite_udf", 400, 1), *search("sqlite_udf", 400, 2), cpu="fast")
    assert "1 times what the best database does" in told()
    assert told().endswith(" In the runs of both: 40 and 20 MB/s, 2 times.")
    assert ratios()[:2] == (("ratio", "1"), ("in the runs of both", "2"))


def test_ceilings_of_several_searches_have_a_spread(tmp_path: Path) -> None:
    trial = ceiling_trial
    found = report(
        journal(
            tmp_path,
            *(trial("hybridlog", rate, 1.0, n) for n in range(3) for rate in (64, 128)),
            trial("hybridlog", 256, 1.0, 2),
            *(trial("hybridlog", 512 >> (n < 2), 0.9, n) for n in range(3)),
            trial("mongo_json", 64, 1.0),
            trial("mongo_json", 128, 0.5),
            trial("mongo_json", 64, 0.9, 1),
            trial("sqlite_udf", 64, 0.99),
            trial("sqlite_udf", 64, 0.99, 1),
        )
    )
    offered = table(found, "Ceiling: offered load")
    assert {row[0]: row[1] for row in offered.rows} == {
        "hybridlog": "12.8 (12.8…25.6)",
        "MongoDB": "3.2 (0…6.4)",  # the second search found none
        "SQLite (Python functions)": "none",
    }
    assert offered.note.startswith("Median (least…greatest) of 2 to 3 searches.")
    assert table(found, "over the best database's").rows[0] == ("ratio", "4")
    assert any("12.8 (12.8…25.6) MB/s" in text for text in found.findings)
    (graph,) = (one for of in found.sections for one in of.graphs if one.key == "ceilings")
    (ours,) = (line for line in graph.panels[0].lines if line.backend == "hybridlog")
    assert ours.points == ((5000.0, Value(12.8, 12.8, 25.6, 3)),)


@pytest.mark.parametrize(
    ("share", "y_range", "words"),
    [(0.95, (80.0, 100.0), "begins at 80 %"), (0.5, (0.0, 100.0), "begins at 0")],
)
def test_the_axis_of_figure_5_says_where_it_begins(
    tmp_path: Path, share: float, y_range: tuple[float, float], words: str
) -> None:
    found = report(
        journal(
            tmp_path, whole_log("mit1", "hybridlog", 1.0), whole_log("mit1", "sqlite_udf", share)
        )
    )
    (graph,) = section(found, "persistence").graphs
    assert graph.y_range == y_range
    assert words in graph.caption


def test_the_paper_is_held_against_what_was_found(tmp_path: Path) -> None:
    backends = ("mongo_json", "postgres_tuned", "sqlite_udf")
    samples = [whole_log("hcr1", name, 1.0) for name in backends]
    samples += [whole_log("mit1", name, 0.9) for name in backends[:2]]
    (tmp_path / "a").mkdir()
    holds = report(journal(tmp_path / "a", *samples, whole_log("mit1", "sqlite_udf", 0.8)))
    said = {str(row[0]): str(row[1]) for row in table(holds, "What the paper found").rows}
    assert said["All three databases persisted 100 % of HCR."].startswith("It holds: ")
    (mit,) = [text for paper, text in said.items() if "MIT" in paper]
    assert mit.startswith("That none keeps all holds, that SQLite keeps least does: ")
    (tmp_path / "b").mkdir()
    fails = report(journal(tmp_path / "b", *samples, whole_log("mit1", "sqlite_udf", 1.0)))
    (mit,) = [
        str(row[1]) for row in table(fails, "What the paper found").rows if "MIT" in str(row[0])
    ]
    assert mit.startswith("That none keeps all does not hold, that SQLite keeps least does not: ")


def test_answers_that_differ_are_told(tmp_path: Path) -> None:
    same = [question("Q1", "hybridlog", 1.0), question("Q1", "mongo_json", 2.0)]
    (tmp_path / "a").mkdir()
    assert report(journal(tmp_path / "a", *same)).differing == ()
    (tmp_path / "b").mkdir()
    found = report(journal(tmp_path / "b", *same, question("Q1", "sqlite_udf", 1.0, answer=4)))
    assert found.differing == ("Q1",)
    assert any("do not agree on Q1" in text for text in found.findings)
    assert any("DIFFER" in text for text in section(found, "queries").text)


def test_table_1_stands_beside_the_papers(tmp_path: Path) -> None:
    found = report(
        journal(
            tmp_path,
            question("Q1", "hybridlog", 2.0),
            question("Q1", "mongo_json", 6.0),
            question("closed minutes", "mongo_json", 9.0),
        )
    )
    assert table(found, "Table 1: milliseconds").columns == ("backend", "Q1")
    rows = {row[0]: row[1:] for row in table(found, "The paper's Table 1").rows}
    assert rows["SQLite (Python functions)"] == ("1.20", "2,414.52", "1,547.70", "485,000")
    assert table(found, "names besides").rows[0][1] is None
    assert any("Q1 2 ms (3 times as fast as MongoDB, 6 ms)" in text for text in found.findings)


def test_an_empty_journal_makes_a_report(tmp_path: Path) -> None:
    found = report(Journal(tmp_path))
    assert found.findings == ()
    assert "What we could not run" in all_text(found)


# --- honesty --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([{"spin_ms": 20.0 + 10 * (n > 5)} for n in range(10)], "1.5 times"),
        ([{"steal_s": 1.0}], "5.0 % of the processors' time"),
        ([{"late_ms_p99": 80.0}, {}], "late in 1 of 2 runs"),
    ],
)
def test_noise_is_told_with_its_figures(
    tmp_path: Path, values: list[dict[str, float]], words: str
) -> None:
    samples = [stream("hybridlog", 1.0, n, **more) for n, more in enumerate(values)]
    (warning,) = report(journal(tmp_path, *samples)).warnings
    assert warning.startswith("This machine was not quiet")
    assert words in warning


def test_quick_runs_are_marked_everywhere(tmp_path: Path) -> None:
    found = report(journal(tmp_path, stream("hybridlog", 1.0), quick=True))
    assert "quick" in found.title
    assert "quick run" in found.warnings[0]
    html = page(found, {})
    assert html.count('<span class="quick">') == len(found.sections) + len(found.graphs)


def test_a_share_that_the_machine_may_have_cost_is_marked(tmp_path: Path) -> None:
    taken = 5.0 * processors()  # half of the processors' time
    found = report(
        journal(
            tmp_path,
            whole_log("mit1", "hybridlog", 1.0, steal_s=taken),
            whole_log("mit1", "mongo_json", 0.9, steal_s=taken),
            whole_log("mit1", "mcap", 0.9),
            stream("hybridlog", 1.0, steal_s=taken),
            stream("mongo_json", 0.5, steal_s=taken),
        )
    )
    for name in ("Persisted, % of the messages", "Persisted at 64 Hz"):
        shares = table(found, name)
        rows = {row[0]: row[1] for row in shares.rows}
        assert rows["hybridlog"] == "100"
        assert rows["MongoDB"] in {"90†", "50†"}
        assert rows.get("plain MCAP", "90") == "90"
        assert "† The host" in shares.note
    text = " ".join(found.findings)
    assert "MongoDB 90† % and plain MCAP 90 %" in text
    assert text.count("† The host") == 1
    quiet = report(journal(tmp_path / "quiet", whole_log("mit1", "mongo_json", 0.9)))
    assert "†" not in all_text(quiet)


def test_missing_failed_and_lost_are_all_named(tmp_path: Path) -> None:
    case = {"size": 5000, "rate": 4, "topics": 20, "messages": 500}
    found = report(
        journal(
            tmp_path,
            stream("hybridlog", 1.0, lost=3, errors=2),
            Sample("throughput", case, "mongo_json", 0, "missing", {}, "install a server"),
            Sample("throughput", case, "mongo_json", 1, "missing", {}, "install a server"),
            Sample("throughput", case, "sqlite_udf", 0, "failed", {"published": 9}, "disk full"),
        )
    )
    assert table(found, "missing in this run").rows == (("mongo_json", "install a server", "2"),)
    assert table(found, "Runs that failed").rows[0][1:] == ("sqlite_udf", "disk full")
    assert found.failed == 1
    text = " ".join(found.findings)
    assert "hybridlog 3" in text
    assert "hybridlog 2" in text
    assert "Not measured, because they cannot run here: MongoDB" in text
    assert "1 run failed (SQLite (Python functions))" in text
    for name in ("Cassandra", "MIT Stata", "HCR", "i7-4770", "VoltDB"):
        assert name in all_text(found)


def test_runs_of_other_machines_are_noted(tmp_path: Path) -> None:
    journal(tmp_path, stream("hybridlog", 1.0))
    found = report(journal(tmp_path, started="later"))
    assert found.warnings == ()
    assert len(table(found, "Machine, versions").columns) == 2
    assert "To run it again: `python -m benchmarks all --out 'a b'`" in all_text(found)
    found = report(journal(tmp_path, cpu="another"))
    assert any("processor" in text and "not alike" in text for text in found.warnings)
    assert "processor" not in dict(table(found, "Machine, versions").rows)
    runs = table(found, "The runs")
    place = runs.columns.index("processor")
    assert [row[place] for row in runs.rows] == ["a processor", "another"]
    assert "python -m benchmarks all --out 'a b'" in all_text(found)


def test_it_says_which_run_each_figure_was_taken_in(tmp_path: Path) -> None:
    second = {"started": "2026-11-25T20:00:00+00:00", "command": ["benchmarks", "again"]}
    journal(tmp_path, stream("hybridlog", 1.0), started="2026-11-24T10:00:00+00:00")
    journal(tmp_path, stream("mongo_json", 0.5), started="2026-11-25T10:00:00+00:00")
    journal(tmp_path, stream("hybridlog", 0.9, 1), stream("mcap", 1.0, 1), **second)
    found = report(journal(tmp_path, question("Q1", "hybridlog", 3.0), cpu="another"))
    taken = table(found, "What is of which run")
    assert taken.columns == ("", "streams, 64 Hz", "questions")
    first, again = "2026-11-24: 1", "2026-11-25: 2"
    assert taken.rows == (
        ("hybridlog", f"{first}; {again}", f"{HEADER['started']}: 3"),
        ("MongoDB", "2026-11-25: 1", None),
        ("plain MCAP", again, None),
    )
    # The run that was taken up again is one, the one with another command is not.
    assert len(table(found, "The runs").rows) == 3


def test_a_journal_with_what_is_not_known_is_reported(tmp_path: Path) -> None:
    stray, whole = Journal(tmp_path), tmp_path / "samples.jsonl"
    stray.add(stream("hybridlog", 1.0))  # of no run
    journal(tmp_path, Sample("tomorrow's", {}, "mcap", 0, "ok", {"ms": 1.0}))
    found = report(journal(tmp_path, stream("mongo_json", 0.5), cpu="another"))
    assert whole.read_bytes().startswith(b'{"kind": "sample"')
    taken = table(found, "What is of which run")
    assert taken.rows == (("MongoDB", f"{HEADER['started']}: 2"),)


def test_what_runs_share_is_said_once(tmp_path: Path) -> None:
    journal(tmp_path, stream("hybridlog", 1.0), packages={"mcap": "1", "numpy": "2"})
    found = report(journal(tmp_path, packages={"mcap": "1", "numpy": "3"}, python="3.99"))
    assert dict(table(found, "Machine, versions").rows)["packages"] == "mcap 1"
    runs = table(found, "The runs")
    rows = [dict(zip(runs.columns, row, strict=True)) for row in runs.rows]
    assert [row["packages"] for row in rows] == ["numpy 2", "numpy 3"]
    assert rows[1]["Python"] == "3.99"
    assert "seed" not in rows[0]


# --- the files ------------------------------------------------------------------------


class Checker(HTMLParser):
    """Notes what a page opens, closes and refers to."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.uses: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        self._note(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self._note(attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def _note(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in {"href", "src", "xlink:href"}:
                self.uses.append(value or "")
            self.uses += [f"#{one}" for one in re.findall(r"url\(#([^)]+)\)", value or "")]


def full(directory: Path) -> Report:
    samples: list[Sample] = []
    for backend in ("hybridlog", "mongo_json", "postgres_autocommit", "postgres_tuned", "zebra"):
        samples += [
            stream(backend, 0.9),
            whole_log("mit1", backend, 0.9),
            whole_log("real_log", backend, 1.0),
        ]
        samples += [question(f"Q{n}", backend, float(n)) for n in range(1, 5)]
        samples.append(Sample("reading", {"task": "a slice"}, backend, 0, "ok", {"ms": 3.0}))
        samples.append(Sample("ceiling", samples[0].case, backend, 0, "ok", run_values()))
        case = {"log": "mit1", "speed": 2}
        samples.append(Sample("speed-up", case, backend, 0, "ok", run_values()))
    return report(journal(directory, *samples))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report")
    assert write(full(out), out).note == ""
    return out


def test_the_page_is_one_whole_file(written: Path) -> None:
    checker = Checker()
    text = (written / "report.html").read_text("utf-8")
    checker.feed(text)
    checker.close()
    assert checker.open == []
    assert len(checker.ids) == len(set(checker.ids))
    assert [use for use in checker.uses if not use.startswith("#")] == []
    assert {use[1:] for use in checker.uses} <= set(checker.ids)
    assert not checker.tags & {"script", "img", "link", "iframe"}
    assert "http" not in re.sub(r'xmlns(:\w+)?="[^"]+"', "", text)
    assert text.count("<svg") == 8
    assert "prefers-color-scheme: dark" in text
    assert "width=device-width" in text


def test_a_line_says_nothing_of_what_was_not_measured() -> None:
    value = Value(1.0, 1.0, 1.0, 2)
    whole = Line("hybridlog", tuple((x, value) for x in (1.0, 2.0, 3.0, 4.0)))
    part = Line("mongo_json", ((1.0, value), (2.0, value), (4.0, value)))
    panel = Panel("", (whole, part))
    assert figures._parted(panel, whole) == whole
    drawn = [(x, math.isnan(v.median)) for x, v in figures._parted(panel, part).points]
    assert drawn == [(1.0, False), (2.0, False), (4.0, True), (4.0, False)]


def test_figures_are_well_formed_and_the_same_again(written: Path, tmp_path: Path) -> None:
    files = sorted((written / "figures").iterdir(), key=lambda file: file.stem)
    assert [file.stem for file in files] == [
        "ceilings",
        "cpu",
        "figure-3",
        "figure-4",
        "figure-5",
        "figure-5-real-1",
        "reading",
        "table-1",
    ]
    for file in files:
        text = file.read_text("utf-8")
        assert ET.fromstring(text).tag.endswith("svg")
        assert figures.INK not in text
        assert figures.GRID not in text
    write(full(tmp_path), tmp_path)
    for file in [*files, written / "report.md", written / "report.html"]:
        assert (tmp_path / file.relative_to(written)).read_bytes() == file.read_bytes()


def test_markdown_tables_are_rectangles(written: Path) -> None:
    text = (written / "report.md").read_text("utf-8")
    widths: list[int] = []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            widths.append(len(re.findall(r"(?<!\\)\|", line)))
        elif widths:
            assert len(set(widths)) == 1, widths
            widths = []
    for place in re.findall(r"\]\((figures/[^)]+)\)", text):
        assert (written / place).is_file()


def test_names_and_messages_are_not_obeyed(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script> a|b `c` [x](http://e) \x1b[31m_"
    samples = [
        whole_log(evil, "hybridlog", 1.0),
        Sample("persistence", {"log": "x"}, evil, 0, "failed", {}, evil),
        Sample("persistence", {"log": "x"}, "mcap", 0, "missing", {}, evil),
    ]
    found = report(journal(tmp_path, *samples, cpu=evil))
    checker = Checker()
    written = write(found, tmp_path)
    checker.feed(written.files[0].read_text("utf-8"))
    assert "script" not in checker.tags
    text = written.files[1].read_text("utf-8")
    assert not re.search(r"(?<!\\)<script", text)
    assert not re.search(r"(?<!\\)\]\(http", text)


def test_markdown_keeps_code_and_escapes_the_rest() -> None:
    assert escaped("a_b `c_d|e` *f*\n|") == "a\\_b `c_d\\|e` \\*f\\* \\|"
    assert escaped("a ` b") == "a \\` b"


def test_the_terminal_shows_no_control_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = Sample("persistence", {"log": "x\x1b"}, "mcap", 0, "failed", {}, "no\x1b[2J")
    found = journal(tmp_path, failed)
    show(report(found), Book(found))
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "1 run failed" in said


def test_without_matplotlib_there_are_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [one for one in sys.modules if one.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    done = write(full(tmp_path), tmp_path)
    assert "pip install" in done.note
    text = done.files[0].read_text("utf-8")
    assert "<svg" not in text
    assert "Table 1" in text
    assert "](figures" not in done.files[1].read_text("utf-8")


def test_an_older_report_is_replaced_whole(tmp_path: Path) -> None:
    (tmp_path / "report.md").write_text("old")
    write(report(Journal(tmp_path)), tmp_path)
    assert "old" not in (tmp_path / "report.md").read_text("utf-8").split()
    assert list(_left(tmp_path)) == []


def _left(directory: Path) -> Iterator[Path]:
    return directory.rglob("*.new")


def test_a_damaged_log_is_said_to_be_one(tmp_path: Path) -> None:
    whole, half = whole_log("whole", "mcap", 1.0), whole_log("half", "mcap", 1.0)
    half = replace(half, values={**half.values, DAMAGE: "it ends in a record"})
    told = report(journal(tmp_path, whole, half)).findings
    assert [text for text in told if "can be read" in text] == [
        "Of half only what can be read was published: it ends in a record."
    ]


def test_logs_that_all_keep_are_told_in_one_sentence(tmp_path: Path) -> None:
    samples = [whole_log(log, name, 1.0) for log in ("hcr1", "x") for name in ("mcap", "bagfile")]
    samples += [whole_log("mit1", "mcap", 1.0), whole_log("mit1", "bagfile", 0.5)]
    assert [text for text in report(journal(tmp_path, *samples)).findings if "Of " in text] == [
        "Of mit1, plain MCAP kept everything; not so ROS bag 50 %.",
        "Of hcr1 and x, every backend that took part kept everything.",
    ]
