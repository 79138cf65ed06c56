"""Study 1: what is planned, what is done again and what is not, and the ceilings."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.backends.base import Backend
from benchmarks.backends.nothing import Nothing
from benchmarks.harness.run import Outcome, Setting
from benchmarks.loads.base import Load
from benchmarks.samples import Journal, Sample
from benchmarks.studies import ceiling, runs, throughput
from benchmarks.studies.runs import Context, chosen, run_directory
from tests.benchmarks.test_harness import Dying, Missing, Slow, make_load

BACKENDS: dict[str, type[Backend]] = {"nothing": Nothing, "missing": Missing, "slow": Slow}
SMALL = throughput.Settings(sizes=(200, 2000), rates=(50.0,), messages=5, topics=2, repetitions=2)


def context(directory: Path, **settings: Any) -> Context:
    return Context(
        **{
            "work": directory / "work",
            "backends": {"nothing": Nothing},
            "journal": Journal(directory / "out"),
            **settings,
        }
    )


# The plan.


def test_the_full_plan_is_that_of_the_paper(tmp_path: Path) -> None:
    cases = throughput.plan(context(tmp_path, backends=BACKENDS))
    assert len(cases) == 8 * 3 * 5 * 3
    assert len({case.key for case in cases}) == len(cases)
    assert sorted({case.case["size"] for case in cases}) == [
        5_000, 10_000, 20_000, 40_000, 80_000, 160_000, 320_000, 640_000,
    ]  # fmt: skip
    assert {case.case["rate"] for case in cases} == {4, 16, 64}
    assert {(c.case["topics"], c.case["messages"]) for c in cases} == {(20, 500)}
    # Backends take turns within a stream, all streams come before the next repetition.
    assert [case.backend for case in cases[:6]] == ["nothing", "missing", "slow"] * 2
    assert [case.repetition for case in cases] == [n for n in range(5) for _ in range(72)]


def test_a_quick_plan_has_the_extremes_and_says_so(tmp_path: Path) -> None:
    quick = context(tmp_path, quick=True)
    cases = throughput.plan(quick)
    streams = {(case.case["size"], case.case["rate"]) for case in cases}
    assert streams == {(5000, 4), (5000, 64), (640_000, 4), (640_000, 64)}
    assert {case.case["messages"] for case in cases} == {20}


def test_another_speed_is_another_case(tmp_path: Path) -> None:
    one, other = context(tmp_path), context(tmp_path, speed=2.0)
    keys = [{case.key for case in throughput.plan(c, SMALL)} for c in (one, other)]
    assert not keys[0] & keys[1]


def test_backends_are_chosen_by_name() -> None:
    assert list(chosen(BACKENDS, ["slow", "nothing"])) == ["nothing", "slow"]
    assert list(chosen(BACKENDS, None)) == list(BACKENDS)
    with pytest.raises(ValueError, match=r"'nosuch'.*nothing, missing, slow"):
        chosen(BACKENDS, ["nosuch"])


# Doing it.


def test_a_study_is_run_and_nothing_of_its_data_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = context(tmp_path, backends={"nothing": Nothing, "missing": Missing})
    throughput.run(where, SMALL)
    samples = Journal(tmp_path / "out").samples
    assert len(samples) == 8
    good = [sample for sample in samples.values() if sample.backend == "nothing"]
    assert {sample.status for sample in good} == {"ok"}
    assert {sample.values["persisted"] for sample in good} == {10}
    assert {s.values["published_bytes"] / s.case["size"] for s in good} == {10}
    absent = [sample for sample in samples.values() if sample.backend == "missing"]
    assert {(s.status, s.reason) for s in absent} == {("missing", "no such system; install it")}
    # Once it was tried; who is missing once is missing.
    assert capsys.readouterr().err.count("throughput: missing") == 1
    assert list((tmp_path / "work" / "runs").iterdir()) == []
    loads = sorted(path.name for path in (tmp_path / "work" / "loads").iterdir())
    assert [name.rsplit("-", 1)[0] for name in loads] == [
        "pool-200-10", "pool-2000-10", "stream-200-50", "stream-2000-50",
    ]  # fmt: skip


def test_what_is_done_is_not_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one = replace(SMALL, repetitions=1)
    started: list[str] = []
    real = runs.run_load

    def interrupted(load: Load, *rest: Any) -> Any:
        if started:
            raise KeyboardInterrupt
        started.append(load.name)
        return real(load, *rest)

    monkeypatch.setattr(runs, "run_load", interrupted)
    with pytest.raises(KeyboardInterrupt):
        throughput.run(context(tmp_path), one)
    assert len(Journal(tmp_path / "out").samples) == 1
    assert list((tmp_path / "work" / "runs").iterdir()) == []

    started.clear()
    again = context(tmp_path)
    throughput.run(again, one)
    assert started == ["2 kB 50 Hz"]
    capsys.readouterr()
    throughput.run(context(tmp_path), one)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("quick", [False, True])
def test_the_machine_is_left_alone_after_a_run_that_kept_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: bool
) -> None:
    class Time:
        now = 100.0
        slept: list[float] = []  # noqa: RUF012 - of this test

        def monotonic(self) -> float:
            return self.now

        def sleep(self, seconds: float) -> None:
            self.slept.append(seconds)
            self.now += seconds

    clock = Time()
    kept = iter([10**9, 10**12, 0, 0])

    def run(*_: Any) -> Outcome:
        clock.now += 1
        values = {"steal_s": 0.0, "wall_s": 1.0, "persisted_bytes": next(kept)}
        return Outcome("ok", values)

    monkeypatch.setattr(runs, "time", clock)
    monkeypatch.setattr(runs, "run_load", run)
    where = context(tmp_path, quick=quick)
    for number in range(4):
        wanted = Sample("throughput", {"size": 1}, "nothing", number)
        where.run(wanted, lambda: make_load(tmp_path / f"load{number}"))  # noqa: B023
    assert clock.slept == ([] if quick else [0, 2, 12, 0])


def test_a_failure_is_noted_and_tried_again(tmp_path: Path) -> None:
    settings = throughput.Settings(
        sizes=(200,), rates=(500.0,), messages=100, topics=2, repetitions=1
    )
    throughput.run(context(tmp_path, backends={"it": Dying}), settings)
    (sample,) = Journal(tmp_path / "out").samples.values()
    assert (sample.status, sample.reason) == ("failed", "the disk is full")
    assert sample.values["published"] > 20
    throughput.run(context(tmp_path, backends={"it": Nothing}), settings)
    (sample,) = Journal(tmp_path / "out").samples.values()
    assert sample.status == "ok"


def test_a_load_that_was_not_finished_is_made_again(tmp_path: Path) -> None:
    where = context(tmp_path)
    made: list[Path] = []

    def broken(directory: Path) -> Load:
        (directory / "payloads.bin").write_bytes(b"half")
        raise OSError("no space")

    def whole(directory: Path) -> Load:
        made.append(directory)
        shutil.rmtree(directory)
        return make_load(directory, messages=2)

    with pytest.raises(OSError, match="no space"):
        where.load("name", {"seed": 1}, broken)
    assert list((where.work / "loads").iterdir()) == []
    for _ in range(2):
        load = where.load("name", {"seed": 1}, whole)
        assert len(load) == 6
        assert load.payloads.is_file()
    where.load("name", {"seed": 2}, whole)
    assert len(made) == 2


def test_directories_of_killed_runs_are_removed_and_others_are_not(tmp_path: Path) -> None:
    left = tmp_path / "runs" / "999999999-abc"
    other = tmp_path / "runs" / f"{os.getppid()}-abc"
    for place in (left, other):
        place.mkdir(parents=True)
        (place / "data").write_bytes(b"data")
    with run_directory(tmp_path) as directory:
        assert directory.is_dir()
        assert not left.exists()
        assert other.is_dir()
    assert not directory.exists()


# Ceilings.


def trial(backend: str, rate: float, **values: float) -> Sample:
    of_trial: Mapping[str, float] = {
        "published": 100,
        "persisted": 100,
        "published_bytes": 1e6,
        "persisted_bytes": 1e6,
        "due_s": 1.0,
        "publish_s": 1.0,
        "wall_s": 2.0,
    }
    case = {"size": 5000, "rate": rate}
    return Sample("ceiling", case, backend, 0, values={**of_trial, **values})


def test_ceilings_are_computed_from_samples() -> None:
    lost = {"persisted": 99}
    late = {"publish_s": 1.5}
    samples = [
        trial("nothing", 64),
        trial("nothing", 1024),
        trial("nothing", 2048, **late),
        trial("low", 64, **lost),
        trial("middle", 64),
        trial("middle", 96),
        trial("middle", 128, **lost),
        trial("high", 1024),
        trial("high", 2048, **lost),
        trial("hybridlog_recorder", 1024),
        trial("hybridlog_recorder", 4096, **lost),
        trial("late", 64),
        trial("late", 128, **late),
        trial("open", 64),
        trial("crashed", 64),
        replace(trial("crashed", 128), status="failed", values={}),
        replace(trial("absent", 64), status="missing", values={}),
        replace(trial("middle", 4096), study="throughput"),
    ]
    found = {one.backend: one for one in ceiling.ceilings(samples)}
    rates = {name: (one.rate, one.lost_rate, one.limit) for name, one in found.items()}
    assert rates == {
        "nothing": (1024, 2048, "harness"),
        "low": (None, 64, "backend"),
        "middle": (96, 128, "backend"),
        "high": (1024, 2048, "harness"),
        # Its messages do not go through the queues in which the harness lost some.
        "hybridlog_recorder": (1024, 4096, "backend"),
        "late": (64, 128, "harness"),
        "open": (64, None, "plan"),
        "crashed": (64, 128, "backend"),
    }
    assert found["middle"].offered_bytes_s == 1e6
    assert found["middle"].stored_bytes_s == 0.5e6
    assert found["low"].offered_bytes_s == 0


def test_each_search_has_a_ceiling_of_its_own() -> None:
    lost = {"persisted": 99}
    samples = [
        trial("some", 64),
        trial("some", 128, **lost),
        replace(trial("some", 64), repetition=1),
        replace(trial("some", 128), repetition=1),
        replace(trial("some", 256, **lost), repetition=1),
        trial("nothing", 192, **lost),
    ]
    found = [one for one in ceiling.ceilings(samples) if one.backend == "some"]
    assert [(one.repetition, one.rate, one.limit) for one in found] == [
        (0, 64, "backend"),
        (1, 128, "harness"),  # which was looked at once only, and could do no more
    ]


TRUTH = {"slow": 100.0, "dying": 70.0, "nothing": 1e9}
"""Rates up to which the backends of the model keep all."""


def model(load: Load, backend: type[Backend], _: Path, setting: Setting) -> Outcome:
    """What a run would give: lost is a tenth, or all when the backend dies."""
    name = backend.__name__.lower()
    if name == "missing":
        return Outcome("missing", {}, "install it")
    assert setting.speed == 1
    kept = round(len(load) / 2 / load.duration_s) <= TRUTH[name] * 1.05
    persisted = len(load) if kept else len(load) * 9 // 10
    values = {
        "published": len(load),
        "persisted": persisted,
        "published_bytes": load.payload_bytes,
        "persisted_bytes": persisted * 200,
        "due_s": load.duration_s,
        "publish_s": load.duration_s,
        "wall_s": load.duration_s * 2,
    }
    if name == "dying" and not kept:
        return Outcome("failed", {"published": len(load)}, "it died")
    return Outcome("ok", values)


def test_a_search_is_done_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ceiling.Settings(
        sizes=(200,), topics=2, seconds=1.0, messages=20, start=40.0, highest=320.0, repetitions=1
    )
    backends = {"slow": Slow, "missing": Missing, "dying": Dying, "nothing": Nothing}
    done: list[tuple[str, float]] = []
    limit = 5

    def noted(load: Load, backend: type[Backend], *rest: Any) -> Outcome:
        if len(done) == limit:
            raise KeyboardInterrupt
        done.append((backend.__name__.lower(), float(load.name.split()[2])))
        return model(load, backend, *rest)

    monkeypatch.setattr(runs, "run_load", noted)
    with pytest.raises(KeyboardInterrupt):
        ceiling.run(context(tmp_path, backends=backends, speed=3.0), settings)
    assert done == [
        ("slow", 40), ("missing", 40), ("dying", 40), ("nothing", 40), ("slow", 80),
    ]  # fmt: skip
    limit = 1000
    ceiling.run(context(tmp_path, backends=backends), settings)
    tried: dict[str, list[float]] = {}
    for name, rate in done:
        tried.setdefault(name, []).append(rate)
    assert tried == {
        "missing": [40, 40],
        "nothing": [40, 80, 160, 320],
        "slow": [40, 80, 160, 120, 100],
        "dying": [40, 80, 60, 70],
    }
    found = {
        one.backend: one for one in ceiling.ceilings(Journal(tmp_path / "out").samples.values())
    }
    assert {name: (one.rate, one.lost_rate, one.limit) for name, one in found.items()} == {
        "slow": (100, 120, "backend"),
        "dying": (70, 80, "backend"),
        "nothing": (320, None, "plan"),
    }
    assert found["slow"].stored_bytes_s == found["slow"].offered_bytes_s / 2
    done.clear()
    again = context(tmp_path, backends={"slow": Slow, "nothing": Nothing})
    ceiling.run(again, settings)
    assert done == []


def test_a_search_is_repeated_from_the_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ceiling.Settings(
        sizes=(200,), topics=2, seconds=1.0, messages=20, start=40.0, highest=320.0, repetitions=2
    )
    truths = iter([100.0] * 5 + [70.0] * 4)

    def changing(load: Load, backend: type[Backend], *rest: Any) -> Outcome:
        monkeypatch.setitem(TRUTH, "slow", next(truths))
        return model(load, backend, *rest)

    monkeypatch.setattr(runs, "run_load", changing)
    ceiling.run(context(tmp_path, backends={"slow": Slow}), settings)
    samples = list(Journal(tmp_path / "out").samples.values())
    rates = [(one.repetition, one.case["rate"]) for one in samples]
    assert rates == [
        *((0, rate) for rate in (40, 80, 160, 120, 100)),
        *((1, rate) for rate in (40, 80, 60, 70)),
    ]
    assert [one.rate for one in ceiling.ceilings(samples)] == [100, 70]


def test_a_ceiling_is_found_with_real_runs(tmp_path: Path) -> None:
    settings = ceiling.Settings(
        sizes=(200,), topics=2, seconds=0.1, messages=40, start=25.0, highest=100.0, halvings=0,
        repetitions=1,
    )  # fmt: skip
    ceiling.run(context(tmp_path, backends={"slow": Slow}), settings)
    (found,) = ceiling.ceilings(Journal(tmp_path / "out").samples.values())
    # 20 ms a message: 50 Hz, and a little more since a queue holds ten.
    assert (found.rate, found.lost_rate, found.limit) in {
        (25, 50, "backend"), (50, 100, "backend"),
    }  # fmt: skip


def test_a_trial_is_long_enough_for_its_queue() -> None:
    full, quick = ceiling.Settings.usual(quick=False), ceiling.Settings.usual(quick=True)
    assert full.messages_at(64) == 512
    assert full.messages_at(1) == 100
    assert quick.messages_at(64) == 64
    assert quick.messages_at(1) == 20
    assert (quick.sizes, len(full.sizes)) == ((5000, 640_000), 8)
