"""Questions of one process while another one changes the store, asked before each step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import hybridlog as hl
from hybridlog.record.losses import losses_of
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.errors import HybridlogError
from tests.faults.cases import Bench, Scenario
from tests.faults.steps import Pauses, Point
from tests.faults.stores import WHERE, Seen, look, number_of
from tests.indexed import EVERYTHING


@dataclass
class Watched:
    """What was asked beside a command.

    Attributes:
        points: Steps before which it was asked.
        refused: Questions that were refused, by the class of the error.
        wrong: Answers that are neither those before nor those after.
    """

    points: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


def watch(bench: Bench, scenario: Scenario, *, anew: bool) -> Watched:
    """Ask before each step of a command.

    Args:
        bench: What the cases share.
        scenario: The command.
        anew: Open the store for each time; else one that was open before is asked.
    """
    watched = Watched()
    name, *arguments = scenario.command
    with scenario.prepared.copy(bench.server, bench.path / "case") as case:
        pauses = Pauses(bench.path / "pauses")
        with pauses, case.open() as held:
            held.connect()
            command = [name, str(pauses.path), *arguments]
            bench.stepper.start(command, case.path, case.uri, Point("pause"))
            for step in pauses.steps():
                watched.points += 1
                if not anew:
                    _ask(held, scenario, step, watched)
                    continue
                try:
                    with case.open() as opened:
                        _ask(opened, scenario, step, watched)
                except HybridlogError as error:
                    watched.refused[type(error).__name__] += 1
            run = bench.stepper.wait()
            assert run.outcome == "done", run
            held.refresh()
            _ask(held, scenario, "the end", watched)
        state = look(case)
        assert state == scenario.after, state
    return watched


def _ask(store: hl.Store, scenario: Scenario, step: str, watched: Watched) -> None:
    known = [scenario.before.recordings, scenario.after.recordings]
    entries = {entry.name: entry for entry in store.recordings()}
    ended = {label for label, entry in entries.items() if entry.status != "open"}
    if not any(ended <= state.keys() for state in known) or store.repairs.unreadable:
        watched.wrong.append(f"{step}: {ended}, unreadable {store.repairs.unreadable}")
    for label in ended:
        if losses_of(entries[label]) and entries[label].status == "damaged":
            continue  # it says what is missing
        seen = [state[label] for state in known if label in state]
        for what, ask, of in _QUESTIONS:
            try:
                answer = ask(store, entries[label])
            except HybridlogError as error:
                watched.refused[type(error).__name__] += 1
                continue
            right = [of(one) for one in seen]
            if answer not in right:
                watched.wrong.append(f"{step}: {label}, {what}: {answer} is none of {right}")


def _topics(entry: RecordingEntry) -> list[str]:
    return sorted({c.topic for c in entry.channels})


def _count(store: hl.Store, entry: RecordingEntry) -> dict[str, int]:
    query = {t: store.query([t], [entry.id]) for t in _topics(entry)}
    return {t: q.where(f"n >= {WHERE}").count() for t, q in query.items()}


def _fetch_where(store: hl.Store, entry: RecordingEntry) -> list[tuple[int, bytes]]:
    query = store.query(_topics(entry), [entry.id]).where(f"n >= {WHERE}")
    return [(m.log_time_ns, bytes(m.raw)) for m in query]


def _documents(store: hl.Store, entry: RecordingEntry) -> int:
    """Documents, and messages of which it is told that they have none."""
    query = store.query(_topics(entry), [entry.id]).where(EVERYTHING)
    return query.count() + query.counters.unindexed


def _fetch(store: hl.Store, entry: RecordingEntry) -> list[tuple[int, bytes]]:
    return [(m.log_time_ns, bytes(m.raw)) for m in store.query(_topics(entry), [entry.id])]


def _count_first_half(store: hl.Store, entry: RecordingEntry) -> int:
    begin, end = _EDGES
    return store.query(_topics(entry), [entry.id]).between(f"{begin}ns", f"{end}ns").count()


def _wanted(seen: Seen) -> dict[str, list[tuple[int, bytes]]]:
    return {
        topic: [(t, p) for t, p in part if (number_of(topic, p) or 0) >= WHERE]
        for topic, part in seen.messages.items()
    }


def _all(parts: dict[str, list[tuple[int, bytes]]]) -> list[tuple[int, bytes]]:
    return sorted(item for part in parts.values() for item in part)


_EDGES = 1_700_000_000_150_000_000, 1_700_000_000_250_000_000
_QUESTIONS: list[
    tuple[str, Callable[[hl.Store, RecordingEntry], object], Callable[[Seen], object]]
] = [
    ("count where", _count, lambda seen: {t: len(p) for t, p in _wanted(seen).items()}),
    ("fetch where", _fetch_where, lambda seen: _all(_wanted(seen))),
    ("documents", _documents, lambda seen: sum(map(len, seen.messages.values()))),
    ("fetch", _fetch, lambda seen: _all({t: list(p) for t, p in seen.messages.items()})),
    (
        "count between",
        _count_first_half,
        lambda seen: sum(
            _EDGES[0] <= time < _EDGES[1] for part in seen.messages.values() for time, _ in part
        ),
    ),
]
