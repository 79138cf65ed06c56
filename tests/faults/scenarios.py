"""The commands that are interrupted, and the stores on which they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from hybridlog_storage.manifest import Manifest, replace
from tests import places
from tests.damage import flip
from tests.faults import logs
from tests.faults.cases import (
    Bench,
    Scenario,
    is_recovered_part,
    says_what_is_missing,
)
from tests.faults.logs import Content
from tests.faults.steps import Point
from tests.faults.stores import Prepared, State

FIRST = logs.content(0, 40)
SECOND = logs.content(15, 12)
THIRD = logs.content(100, 24)
_LOGS = {"a": FIRST, "b": SECOND, "c": THIRD}


def scenario(bench: Bench, name: str) -> Scenario:
    """A scenario by its name, made once for each module of tests."""
    found = bench.scenarios.get(name)
    if found is None:
        found = bench.scenarios[name] = SCENARIOS[name](bench)
    return found


def _log(bench: Bench, name: str) -> Path:
    path = bench.path / f"{name}.mcap"
    return path if path.exists() else logs.write(path, _LOGS[name])


def _two(bench: Bench) -> Prepared:
    """A store with the recordings `a`, of several segments, and `b`."""
    if bench.two is None:
        path, uri = bench.path / "two", bench.server.new()
        for name in ("a", "b"):
            logs.record(path, uri, _log(bench, name), name)
        bench.two = Prepared.of(bench.server, path, uri)
    return bench.two


def _changed(bench: Bench, name: str, change: Callable[[Path], None]) -> Prepared:
    """Such a store to which something has happened."""
    two = _two(bench)
    path = bench.path / name
    two.duplicate(path)
    change(path)
    return Prepared(path, two.documents)


def _simple(*command: str, **truth: Content) -> Callable[[Bench], Scenario]:
    def make(bench: Bench) -> Scenario:
        return bench.scenario(command[0], command, _two(bench), truth=truth)

    return make


def _import(bench: Bench) -> Scenario:
    other = bench.path / "other"
    logs.record(other, bench.server.new(), _log(bench, "c"), "c")

    def allowed(state: State, before: State, _outcome: str) -> bool:
        """What was copied so far is out of sight."""
        extra = state.files - before.files
        return (
            state.recordings == before.recordings
            and not state.findings
            and before.files < state.files
            and all(name.partition("/")[0] == "c" for name in extra)
        )

    return bench.scenario(
        "import", ["import", str(other)], _two(bench), allowed=allowed, truth={"c": THIRD}
    )


def _repair(bench: Bench) -> Scenario:
    def damage(store: Path) -> None:
        flip(places.folder(store, "a") / "000002.mcap", -60)
        places.manifest_of(places.folder(store, "b")).write_bytes(b"damaged")

    def allowed(state: State, _before: State, _outcome: str) -> bool:
        """The one without a manifest answers nothing until it is made again."""
        assert state.recordings.keys() | ({"b"} if state.unreadable else set()) == {"a", "b"}
        return all(says_what_is_missing(one, _LOGS[n]) for n, one in state.recordings.items())

    return bench.scenario(
        "repair",
        ["repair"],
        _changed(bench, "damaged", damage),
        allowed=allowed,
        is_clean=False,
        truth={"a": FIRST, "b": SECOND},
    )


def _record(bench: Bench) -> Scenario:
    def allowed(state: State, before: State, outcome: str) -> bool:
        """Who was killed could not take back what was written."""
        return (
            outcome == "killed"
            and not state.findings
            and state.without("c") == before
            and is_recovered_part(state.recordings["c"], THIRD)
        )

    return bench.scenario(
        "record",
        ["record", str(_log(bench, "c")), "c"],
        _two(bench),
        allowed=allowed,
        again=False,
        truth={"c": THIRD},
    )


def _crashed(bench: Bench, name: str, step: str, number: int) -> Prepared:
    """A store with a recording that died before a step: the n-th of its kind, from 0."""
    recorded = scenario(bench, "record")
    at = [n for n, told in enumerate(recorded.steps) if told.startswith(step)][number]
    two = _two(bench)
    with two.copy(bench.server, bench.path / "case") as case:
        run = bench.stepper.run(recorded.command, case.path, case.uri, Point("die", at))
        assert run.outcome == "killed", run
        path = bench.path / name
        prepared = Prepared.of(bench.server, case.path, case.uri)
        prepared.duplicate(path)
    return Prepared(path, prepared.documents)


def _says_more(state: State, before: State, outcome: str) -> bool:
    """A recovery that was killed may say of what it wrote last that it was cut short."""
    if outcome != "killed" or state.findings or state.recordings.keys() != before.recordings.keys():
        return False
    return all(
        seen == before.recordings[label]
        or (
            seen.entry["status"] == "recovered"
            and seen.messages == before.recordings[label].messages
            and {**seen.entry, "end": None} == {**before.recordings[label].entry, "end": None}
        )
        for label, seen in state.recordings.items()
    )


def _opening(prepare: Callable[[Bench], Prepared], **truth: Content) -> Callable[[Bench], Scenario]:
    def make(bench: Bench) -> Scenario:
        return bench.scenario(
            "open",
            ["open"],
            prepare(bench),
            allowed=_says_more,
            is_opening=True,
            is_clean=False,
            again=False,
            truth=truth,
        )

    return make


def _forget_segment(store: Path) -> None:
    def how(now: Manifest) -> Manifest:
        return replace(now, files=tuple(one for one in now.files if one.number != 1))

    places.change_in(places.folder(store, "a"), how)


def _announce(store: Path) -> None:
    places.change_in(places.folder(store, "a"), lambda now: replace(now, status="removed"))


def _lose_segment(store: Path) -> None:
    places.segment(store, "a", 1).unlink()


SCENARIOS: Mapping[str, Callable[[Bench], Scenario]] = {
    "rm": _simple("rm", "a", b=SECOND),
    "rename": _simple("rename", "a", "new", new=FIRST, b=SECOND),
    "tag": _simple("tag", "a", "x", "y", a=FIRST, b=SECOND),
    "mark": _simple("mark", "a", "+0.1s", "here", b=SECOND),
    "import": _import,
    "repair": _repair,
    "reindex": _simple("reindex", a=FIRST, b=SECOND),
    "reindex one": _simple("reindex", "a", a=FIRST, b=SECOND),
    "record": _record,
    "open after a crash": _opening(
        lambda bench: _crashed(bench, "crashed", "write 000001.mcap.open", 4), a=FIRST, b=SECOND
    ),
    "open after a crash in the index": _opening(
        lambda bench: _crashed(bench, "crashed in index", "insert", 2), a=FIRST, c=THIRD
    ),
    "open with an unlisted segment": _opening(
        lambda bench: _changed(bench, "unlisted", _forget_segment), a=FIRST, b=SECOND
    ),
    "open while removing": _opening(lambda bench: _changed(bench, "removing", _announce), b=SECOND),
    "open without a segment": _opening(
        lambda bench: _changed(bench, "lost", _lose_segment), b=SECOND
    ),
}
