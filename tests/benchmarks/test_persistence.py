"""Study 2: which logs are published, in which order, and the search for the speed."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.backends.mcap_file import McapFile
from benchmarks.backends.nothing import Nothing
from benchmarks.loads.base import Load
from benchmarks.loads.hcr_like import RIGHT_GRIPPER, TF, WEBCAM
from benchmarks.loads.mit_like import KINECT_DEPTH
from benchmarks.samples import Journal, Sample
from benchmarks.studies import persistence, replays, search, speed_up
from benchmarks.studies.replays import MADE, Replay, logs_at
from benchmarks.studies.runs import Context
from hybridlog_storage.errors import SourceError, UsageError
from tests.data import DATA, needs_data


@dataclass
class Model(Context):
    """Runs nothing: each backend keeps all up to a speed of its own."""

    kept_up_to: Mapping[str, float] = field(default_factory=dict)
    broken: set[str] = field(default_factory=set)
    trials: list[Sample] = field(default_factory=list)

    def run(
        self,
        wanted: Sample,
        load: Callable[[], Load],
        *,
        speed: float | None = None,
    ) -> Sample:
        assert callable(load)
        if not self.to_do(wanted):
            return self.journal.samples[wanted.key]
        at = self.speed if speed is None else speed
        kept = at <= self.kept_up_to[wanted.backend]
        values = {"published": 100, "persisted": 100 if kept else 99, "publish_s": 1, "due_s": 1}
        status: Any = "failed" if wanted.backend in self.broken else "ok"
        sample = replace(wanted, status=status, values=values)
        self.journal.add(sample)
        self.trials.append(sample)
        return sample


def model(directory: Path, kept_up_to: Mapping[str, float] | None = None, **more: Any) -> Model:
    kept = kept_up_to or {"nothing": 5.0, "mcap": 1e9}
    kinds = dict.fromkeys(kept, Nothing)
    return Model(directory, kinds, Journal(directory), kept_up_to=kept, **more)


def real(directory: Path, **more: Any) -> Context:
    backends = {"nothing": Nothing, "mcap": McapFile}
    return Context(directory, backends, Journal(directory), **more)


FEW = persistence.Settings(log_seconds=5, made=("hcr1", "mit1"), chosen=False, repetitions=2)


def test_the_order_of_runs(tmp_path: Path) -> None:
    context = model(tmp_path)
    plan = persistence.plan(context, FEW)
    runs = [(one.repetition, one.case["log"], one.backend) for one in plan]
    assert runs == [
        (repetition, log, backend)
        for repetition in range(2)
        for log in ("hcr1", "mit1")
        for backend in ("nothing", "mcap")
    ]
    assert {tuple(one.case.items()) for one in plan} == {
        (("log", "hcr1"), ("seconds", 5)),
        (("log", "mit1"), ("seconds", 5)),
    }


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    context = model(tmp_path)
    persistence.run(context, FEW)
    assert len(context.trials) == 8
    again = model(tmp_path)
    persistence.run(again, FEW)
    assert again.trials == []
    persistence.run(again, replace(FEW, repetitions=3))
    assert {sample.repetition for sample in again.trials} == {2}


def test_another_speed_is_another_case(tmp_path: Path) -> None:
    context = model(tmp_path, speed=8.0)
    persistence.run(context, replace(FEW, repetitions=1, backends=["nothing"]))
    assert [sample.case["speed"] for sample in context.trials] == [8, 8]
    assert all(sample.values["persisted"] == 99 for sample in context.trials)


def test_settings_of_a_quick_run(tmp_path: Path) -> None:
    full, quick = (persistence.Settings.usual(quick=quick) for quick in (False, True))
    assert (full.log_seconds, full.repetitions) == (60, 3)
    assert (quick.log_seconds, quick.repetitions) == (5, 1)
    assert full.made == MADE
    context = model(tmp_path, quick=True)
    assert len(persistence.plan(context)) == 4 * 2


def test_unknown_names(tmp_path: Path) -> None:
    context = model(tmp_path)
    with pytest.raises(ValueError, match="'mit3'"):
        persistence.plan(context, replace(FEW, made=["mit3"]))
    with pytest.raises(ValueError, match="'oracle'"):
        persistence.plan(context, replace(FEW, backends=["oracle"]))
    with pytest.raises(ValueError, match="more than 0"):
        persistence.plan(context, replace(FEW, log_seconds=0))
    with pytest.raises(UsageError, match="--logs"):
        persistence.plan(context, replace(FEW, made=()))
    with pytest.raises(SourceError, match="no such file"):
        persistence.plan(context, replace(FEW, logs=[tmp_path / "absent.bag"]))
    with pytest.raises(ValueError, match="ascending"):
        speed_up.Settings(start=0.5, lowest=1)


# --- the logs ---


def test_the_pairs_differ(tmp_path: Path) -> None:
    loads = {}
    for replay in replays.replays(3, 1.0, []):
        (tmp_path / replay.name).mkdir()
        loads[replay.name] = replay.make(tmp_path / replay.name)
    topics = {name: {channel.topic for channel in load.channels} for name, load in loads.items()}
    assert topics["mit1"] < topics["mit2"]
    assert KINECT_DEPTH in topics["mit2"]
    assert topics["hcr1"] < topics["hcr2"]
    assert {TF} <= topics["hcr2"] - topics["hcr1"]
    assert {WEBCAM, RIGHT_GRIPPER} <= topics["hcr1"]
    assert len({load.seed for load in loads.values()}) == 2
    for name, load in loads.items():
        assert load.name == name
        assert 0.9 < load.duration_s < 1.0, name
        assert not (load.payloads.parent / "truth.json").exists()
    assert loads["mit1"].payload_bytes > 4 * loads["hcr1"].payload_bytes


@needs_data
def test_logs_of_a_directory(tmp_path: Path) -> None:
    folder = DATA / "real"
    inside = logs_at(folder)
    assert folder / "tilt_laser.bag" in inside
    assert folder / "auv_ros2_db3" in inside
    assert len(inside) == len(list(folder.iterdir()))
    # A directory that is one log stands for itself.
    assert logs_at(folder / "auv_ros2_db3") == [folder / "auv_ros2_db3"]
    with pytest.raises(SourceError):
        logs_at(tmp_path)
    (tmp_path / "notes.txt").write_text("no log")
    with pytest.raises(SourceError):
        logs_at(tmp_path)
    for name in ("a.bag", "b.bag"):
        shutil.copy(folder / "compressed_image.bag", tmp_path / name)
    assert logs_at(tmp_path) == [tmp_path / "a.bag", tmp_path / "b.bag"]


@needs_data
def test_real_logs_have_names_of_their_own(tmp_path: Path) -> None:
    twin = tmp_path / "tilt_laser.mcap"
    shutil.copy(DATA / "real" / "ouster.mcap", twin)
    made_up = tmp_path / "hcr1.bag"
    shutil.copy(DATA / "real" / "compressed_image.bag", made_up)
    found = replays.replays(1, 10.0, [DATA / "real" / "tilt_laser.bag", twin, made_up])
    assert [one.name for one in found[4:]] == ["tilt_laser", "tilt_laser-2", "hcr1-2"]
    assert [one.case["bytes"] for one in found[4:]] == [1427039, 4077320, 623948]
    assert found[4].seconds == 10.0
    assert found[5].seconds < 1
    # The same path with other content is another load.
    twin.write_bytes((DATA / "real" / "auv_ros2.mcap").read_bytes())
    assert replays.replays(1, 10.0, [twin])[4].settings != found[5].settings


@needs_data
def test_chosen_logs_are_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(replays, "REAL_LOGS", DATA / "real")
    assert [path.name for path in replays.chosen_logs()] == list(replays.CHOSEN)
    named = [one.name for one in persistence.Settings(made=()).replays(1)]
    assert named == [Path(name).stem for name in replays.CHOSEN]
    # One's own log stands in their place; in two spellings, it is still published once.
    log = DATA / "real" / replays.CHOSEN[0]
    again = DATA / "real" / ".." / "real" / replays.CHOSEN[0]
    own = persistence.Settings(made=(), logs=[log, again]).replays(1)
    assert [one.name for one in own] == named[:1]
    assert persistence.Settings.usual(quick=True).replays(1)[4:] == []
    monkeypatch.setattr(replays, "REAL_LOGS", tmp_path)
    assert replays.chosen_logs() == []


# --- the search for the speed ---

ONE = speed_up.Settings(log_seconds=5, made=("hcr1",), chosen=False, repetitions=1)


def speeds(context: Model, backend: str) -> list[float]:
    return [one.case["speed"] for one in context.trials if one.backend == backend]


def test_search(tmp_path: Path) -> None:
    context = model(tmp_path, {"slow": 0.5, "five": 5.0, "fast": 1e9})
    speed_up.run(context, replace(ONE, highest=64))
    assert speeds(context, "slow") == [1]
    assert speeds(context, "five") == [1, 2, 4, 8, 6, 5]
    assert speeds(context, "fast") == [1, 2, 4, 8, 16, 32, 64]
    again = model(tmp_path, {"slow": 0.5, "five": 5.0, "fast": 1e9})
    speed_up.run(again, replace(ONE, highest=64))
    assert again.trials == []
    # The backends take turns.
    assert [one.backend for one in context.trials[:5]] == ["slow", "five", "fast", "five", "fast"]


@settings(max_examples=50, deadline=None)
@given(limit=st.floats(1.0, 200.0), halvings=st.integers(0, 4), stop=st.integers(0, 12))
def test_search_brackets_the_limit_and_goes_on(
    limit: float, halvings: int, stop: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    directory: Path = tmp_path_factory.mktemp("search")
    wanted = replace(ONE, halvings=halvings)
    replay = wanted.replays(1)[0]
    first = model(directory, {"one": limit})
    of_one = speed_up._search(first, wanted, "one", replay, 0)
    for _ in range(stop):
        if not search._try(first, of_one, set()):
            break
    second = model(directory, {"one": limit})
    speed_up.run(second, wanted)
    tried = speeds(first, "one") + speeds(second, "one")
    assert len(tried) == len(set(tried))
    kept = max(speed for speed in tried if speed <= limit)
    lost = min((speed for speed in tried if speed > limit), default=None)
    if lost is None:
        assert kept == wanted.highest
    else:
        assert kept <= limit < lost
        assert lost / kept <= 1 + 2.0**-halvings + 1e-9
    shutil.rmtree(directory)


def test_each_search_is_repeated_from_the_beginning(tmp_path: Path) -> None:
    context = model(tmp_path, {"five": 5.0})
    speed_up.run(context, replace(ONE, repetitions=2))
    assert speeds(context, "five") == [1, 2, 4, 8, 6, 5] * 2
    assert [one.repetition for one in context.trials] == [0] * 6 + [1] * 6


def test_a_trial_that_fails_ends_this_search_and_is_tried_by_the_next(tmp_path: Path) -> None:
    context = model(tmp_path, {"one": 1e9}, broken={"one"})
    speed_up.run(context, ONE)
    assert speeds(context, "one") == [1]
    again = model(tmp_path, {"one": 3.0})
    speed_up.run(again, ONE)
    assert speeds(again, "one") == [1, 2, 4, 3, 3.5]


def test_missing_backends_take_no_part(tmp_path: Path) -> None:
    context = model(tmp_path)
    context.missing["nothing"] = "not installed"
    speed_up.run(context, replace(ONE, highest=2))
    assert speeds(context, "nothing") == []
    assert speeds(context, "mcap") == [1, 2]


def test_searches_of_two_logs_are_apart(tmp_path: Path) -> None:
    context = model(tmp_path, {"one": 1.0})
    speed_up.run(context, replace(ONE, made=("hcr1", "hcr2")))
    logs = [one.case["log"] for one in context.trials]
    assert logs == ["hcr1"] * (len(logs) // 2) + ["hcr2"] * (len(logs) // 2)
    assert all(one.study == "speed-up" and one.case["seconds"] == 5 for one in context.trials)


# --- for real ---


def test_a_log_through_the_harness(tmp_path: Path) -> None:
    context = real(tmp_path)
    settings_ = persistence.Settings(log_seconds=1, made=("hcr1",), chosen=False, repetitions=1)
    persistence.run(context, settings_)
    samples = list(context.journal.samples.values())
    assert [(one.backend, one.status) for one in samples] == [("nothing", "ok"), ("mcap", "ok")]
    replay: Replay = settings_.replays(1)[0]
    load = replay.load(context)
    for one in samples:
        assert one.values["published"] == len(load)
        assert one.values["persisted"] <= len(load)
        assert 0.9 < one.values["due_s"] < 1
    assert len(list((tmp_path / "loads").iterdir())) == 1


class Scripted(Context):
    """Runs whose figures are given."""

    script: list[dict[str, Any]]

    def _run(self, wanted: Sample, load: Load, speed: float) -> Sample:
        values = {"published": 10, "wall_s": 1000.0, **self.script.pop(0)}
        return replace(wanted, status="ok", values=values)


@pytest.mark.parametrize(
    ("script", "quick", "left", "counts"),
    [
        ([(9, 0)], False, 0, 9),
        ([(10, 1e6)], False, 0, 10),
        ([(9, 1e6), (8, 0)], False, 0, 8),
        ([(9, 3e6), (7, 1e6), (8, 2e6), (10, 0)], False, 1, 7),
        ([(9, 1e6), (10, 0)], True, 1, 9),
    ],
)
def test_what_the_machine_disturbed_is_run_again(
    tmp_path: Path, script: list[tuple[int, float]], left: int, counts: int, *, quick: bool
) -> None:
    found = Scripted(tmp_path, {"nothing": Nothing}, Journal(tmp_path), quick=quick)
    found.script = [{"persisted": kept, "steal_s": taken} for kept, taken in script]
    wanted = Sample("persistence", {"log": "a"}, "nothing", 0)
    for _ in range(2):  # the second time there is nothing to do
        sample = found.run(wanted, lambda: None)  # type: ignore[arg-type,return-value]
        assert sample.values["persisted"] == counts
        assert len(found.script) == left
    kept = Journal(tmp_path)
    assert kept.samples[wanted.key].values["persisted"] == counts
    assert kept.successes(wanted) == len(script) - left
