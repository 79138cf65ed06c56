"""Every method of `Query` and of `Store` that answers, with what is right, in plain Python."""

from __future__ import annotations

import hashlib
import json
import statistics
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.attachments import Extras, extras_of
from hybridlog.query.intervals import Intervals
from hybridlog.query.query import at_time, channels_of, field_types, narrowed, spans_of, tables_of
from hybridlog_storage.errors import HybridlogError, IncompleteError, PayloadError
from tests.every_output import written
from tests.running.sequence import CHANNELS, MS, SECOND, START, STEP, Known, Sent

LABEL = "live"
"""Label of the recording that goes on."""
TAGS = {"robot": "7"}
FIRST_S, LAST_S = START + SECOND, START + 2 * SECOND
"""A second in the middle of what is there from the first answer on."""


class Rule(NamedTuple):
    """A question, and the right answer.

    Attributes:
        ask: Asks a store.
        right: The answer, if the recording has these messages.
    """

    ask: Callable[[hl.Store], Any]
    right: Callable[[Known], Any]


def same(found: Any, wanted: Any) -> bool:
    """True if two answers are equal; floats up to rounding."""
    if isinstance(found, float) or isinstance(wanted, float):
        if found is None or wanted is None:
            return found is wanted
        return bool(found == pytest.approx(wanted, rel=1e-9, abs=1e-9, nan_ok=True))
    if isinstance(found, dict) and isinstance(wanted, dict):
        return found.keys() == wanted.keys() and all(same(found[k], wanted[k]) for k in found)
    if isinstance(found, list | tuple) and isinstance(wanted, list | tuple):
        pairs = zip(found, wanted, strict=False)
        return len(found) == len(wanted) and all(same(one, other) for one, other in pairs)
    return bool(found == wanted)


# What is read.


def hash_of(message: hl.Message | Sent) -> str:
    """SHA-256 of a payload, which may have expired."""
    try:
        return hashlib.sha256(message.raw).hexdigest()
    except PayloadError as error:
        return str(error).rpartition(" ")[2].rstrip(")")


def rows(messages: Iterable[hl.Message]) -> list[tuple[Any, ...]]:
    return [(m.topic, m.log_time_ns, m.publish_time_ns, m.seq, hash_of(m)) for m in messages]


def sent(messages: Iterable[Sent]) -> list[tuple[Any, ...]]:
    return [(m.topic, m.log_time, m.publish_time, m.seq, hash_of(m)) for m in messages]


def seqs(messages: Iterable[Any]) -> list[int]:
    return [message.seq for message in messages]


def batches(found: Iterable[tuple[Any, Any]]) -> list[tuple[Any, ...]]:
    return [
        (channels[batch.channel[n]].channel.topic, int(batch.log_time[n]), bytes(batch.payload(n)))
        for batch, channels in found
        for n in range(len(batch))
    ]


def spans(intervals: Intervals) -> list[tuple[int, int, int]]:
    assert set(intervals.recordings) <= {one.recording for one in intervals}
    return [(one.begin_ns, one.end_ns, one.messages) for one in intervals]


def refusal(work: Callable[[], Any]) -> str:
    """The name of the error that something raises; empty without."""
    try:
        work()
    except HybridlogError as error:
        return type(error).__name__
    return ""


# What is right, in plain Python.


def held(known: Known, topic: str, holds: Callable[[dict[str, Any]], bool]) -> Any:
    """The longest intervals in which the last message holds."""
    found: list[list[int]] = []
    is_on = False
    for one in known.of(topic):
        assert one.fields is not None
        if holds(one.fields):
            if not is_on:
                found.append([one.log_time, 0, 0])
            found[-1][2] += 1
        elif is_on:
            found[-1][1] = one.log_time
        is_on = holds(one.fields)
    if is_on:
        found[-1][1] = known.span[1] + 1
    return [tuple(one) for one in found]


def changed(known: Known, topic: str, name: str, pause: int) -> Any:
    found: list[list[int]] = []
    before = None
    for one in known.of(topic):
        assert one.fields is not None
        if before is not None and one.fields[name] != before:
            if found and one.log_time - found[-1][1] <= pause:
                found[-1][1:] = [one.log_time, found[-1][2] + 1]
            else:
                found.append([one.log_time, one.log_time, 1])
        before = one.fields[name]
    return [(begin, last + 1, steps) for begin, last, steps in found]


def silent(known: Known, topic: str, longer: int) -> Any:
    first, last = known.span
    times = [one.log_time for one in known.of(topic)]
    edges = [first, *times, last + 1]
    return [(a, b, 0) for a, b in pairwise(edges) if b - a > longer]


def between_messages(gaps: Sequence[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Gaps without the one at the end, which ends before what may not be flushed yet.

    Messages have whole milliseconds; a recording ends a nanosecond after its last one.
    """
    return [gap for gap in gaps if gap[1] % MS == 0]


def around(known: Known, times: Sequence[int], before: int, after: int, *topics: str) -> Any:
    return [
        m for m in known.of(*topics) if any(t - before <= m.log_time < t + after for t in times)
    ]


def numbers(known: Known, topic: str, name: str) -> Any:
    values = [one.fields[name] for one in known.of(topic) if one.fields is not None]
    least, most = min(values), max(values)
    mean, deviation = statistics.fmean(values), statistics.stdev(values)
    return [(topic, name, len(values), 0, 0, least, most, mean, deviation)]


def _checked(known: Known, topic: str) -> Any:
    times = [one.log_time for one in known.of(topic)]
    gap = max(b - a for a, b in pairwise(times))
    lost = 3 if topic == "/said" else 0
    return topic, len(times), gap, times[0] - known.span[0], lost


def current(known: Known, topic: str, time: int) -> Sent:
    """The last message not after a time."""
    found = known.of(topic)
    return found[bisect_right([one.log_time for one in found], time) - 1]


def beside(known: Known, base: str, other: str) -> Any:
    """Log time and `n` of a topic; distance and `n` of the last message of another by then."""
    found = []
    others = known.of(other)
    times = [one.log_time for one in others]
    for one in known.of(base):
        place = bisect_right(times, one.log_time) - 1
        assert one.fields is not None
        near = others[place].fields if place >= 0 else None
        distance = times[place] - one.log_time if place >= 0 else None
        found.append((one.log_time, one.fields["n"], distance, near and near["n"]))
    return found


def regular(known: Known, topic: str, step: int) -> Any:
    first, last = known.span
    times = [one.log_time for one in known.of(topic)]
    grid = range(first, last + 1, step)
    return [(t, max((at - t for at in times if at <= t), default=None)) for t in grid]


def in_force(known: Known, time: int) -> Any:
    found = [one for one in known.of("/map") if one.log_time < time]
    return [("/map", time, found[-1].raw)] if found else []


def ranged(known: Known, topic: str, clock: str, begin: int | None, end: int | None) -> Any:
    """Messages between two offsets from the begin; negative ones count from the end."""
    first, after = known.clock_span(clock, [topic]) if clock != "log" else known.span
    after += clock == "log"
    edges = [
        default if given is None else (after + given if given < 0 else first + given)
        for given, default in ((begin, -(10**18)), (end, 10**19))
    ]
    return sent(known.of(topic, between=(edges[0], edges[1]), clock=clock))


def _json_lines(query: Any) -> list[tuple[int, int]]:
    found = [json.loads(line) for line in written(query, "jsonl").splitlines()]
    return [(one["n"], one["big"]) for one in found]


def _numbers(known: Known) -> list[tuple[int, int]]:
    return [(m.fields["n"], m.fields["big"]) for m in known.of("/said") if m.fields is not None]


def _frame(frame: Any) -> list[tuple[int, int]]:
    return [*zip(frame.index.astype("int64").tolist(), frame["n"].tolist(), strict=True)]


def _times(known: Known, topic: str) -> list[tuple[int, int]]:
    return [(m.log_time, m.fields["n"]) for m in known.of(topic) if m.fields is not None]


def _table(table: Any, *names: str) -> list[tuple[Any, ...]]:
    import pyarrow as pa

    columns = []
    for name in names:
        column = table.column(name)
        if pa.types.is_timestamp(column.type) or pa.types.is_duration(column.type):
            column = column.cast(pa.int64())
        columns.append(column.to_pylist())
    return [*zip(*columns, strict=True)]


def _clocks(store: hl.Store) -> Any:
    said, arm = store.topic("said"), store.topic("arm")
    return {
        "publish": rows(said.clock("publish").between("+0s", "+2s")),
        "publish end": rows(said.clock("publish").between("-1s", "end")),
        "publish count": said.clock("publish").between("-1s", "end").count(),
        "publish where": said.clock("publish").where("n >= 3").between("+0.5s", "+1s").count(),
        "publish absolute": rows(said.clock("publish").between(FIRST_S, LAST_S)),
        "header": rows(arm.clock("header").between("+0s", "+2s")),
        "header end": rows(arm.clock("header").between("-1s", "end")),
        "header count": arm.clock("header").between("-1s", None).count(),
        "header absolute": rows(arm.clock("header").between(FIRST_S, LAST_S)),
        "log": rows(arm.clock("log").between("-1s", "end")),
    }


def _right_clocks(known: Known) -> Any:
    said, arm, one = "/said", "/arm", SECOND
    first = known.clock_span("publish", [said])[0]
    wide = known.of(said, between=(first + one // 2, first + one), clock="publish")
    span = (FIRST_S, LAST_S)
    return {
        "publish": ranged(known, said, "publish", 0, 2 * one),
        "publish end": ranged(known, said, "publish", -one, None),
        "publish count": len(ranged(known, said, "publish", -one, None)),
        "publish where": sum(m.fields["n"] >= 3 for m in wide),  # type: ignore[index]
        "publish absolute": sent(known.of(said, between=span, clock="publish")),
        "header": ranged(known, arm, "header", 0, 2 * one),
        "header end": ranged(known, arm, "header", -one, None),
        "header count": len(ranged(known, arm, "header", -one, None)),
        "header absolute": sent(known.of(arm, between=span, clock="header")),
        "log": ranged(known, arm, "log", -one, None),
    }


def _during(store: hl.Store) -> Intervals:
    recording = store.session.look().summaries[0].id
    return Intervals([(recording, np.array([[FIRST_S, LAST_S, 0]], np.int64))])


def _thrice(query: Any) -> Any:
    """The same question by the three ways of asking."""
    return query.count(), rows(query), len(query.to_arrow())


def _right_thrice(found: list[Sent]) -> Any:
    return len(found), sent(found), len(found)


def _is_high(fields: dict[str, Any]) -> bool:
    return bool(fields["x"] > 50)


def _second(known: Known, *topics: str) -> list[Sent]:
    return known.of(*topics, between=(FIRST_S, LAST_S))


def _lost(store: hl.Store) -> Any:
    said, arm = (store.topic(name).completeness() for name in ("said", "arm"))
    strict = store.topic("arm").between(FIRST_S, LAST_S).completeness()
    refused = refusal(said.check), refusal(strict.check)
    return (said.messages, said.is_exact, arm.has_losses), str(said), refused


def _extras(store: hl.Store) -> Extras:
    query = store.all_topics()
    return extras_of(query.source.now(), query.question)


METHODS: dict[str, Rule] = {
    "__iter__": Rule(lambda s: rows(s.all_topics()), lambda k: sent(k.of())),
    "__eq__": Rule(lambda s: s.topic("arm") == s.topic("/arm"), lambda _: True),
    "__hash__": Rule(lambda s: len({s.topic("arm"), s.topic("/arm")}), lambda _: 1),
    "__repr__": Rule(
        lambda s: repr(s.topic("said")), lambda _: f"<Query /said; recording {LABEL}>"
    ),
    "at": Rule(
        lambda s: [s.topic("said").at(t).seq for t in (FIRST_S, LAST_S + 1, "-0.3s", "end")],
        lambda k: [
            current(k, "/said", t).seq
            for t in (FIRST_S, LAST_S + 1, k.span[1] + 1 - 300 * MS, k.span[1])
        ],
    ),
    "batches": Rule(
        lambda s: batches(s.topic("said", "cam", "opaque").batches()),
        lambda k: [(m.topic, m.log_time, m.raw) for m in k.of("/said", "/cam", "/opaque")],
    ),
    "between": Rule(
        lambda s: (
            _thrice(s.topic("said", "arm").between(FIRST_S, LAST_S)),
            _thrice(s.topic("said").between("-1s", "end")),
            _thrice(s.topic("said").between("+0.5s", "-0.5s").where("n > 3")),
        ),
        lambda k: (
            _right_thrice(_second(k, "/said", "/arm")),
            _right_thrice(k.of("/said", between=(k.span[1] + 1 - SECOND, k.span[1] + 1))),
            _right_thrice(
                k.of(
                    "/said",
                    between=(k.span[0] + SECOND // 2, k.span[1] + 1 - SECOND // 2),
                    where=lambda f: f["n"] > 3,
                )
            ),
        ),
    ),
    "changes": Rule(
        lambda s: (
            spans(s.topic("said").changes("state")),
            spans(s.topic("said").changes("state", pause=0)),
            spans(s.topic("arm").changes("name", pause="0.1s")),
        ),
        lambda k: (
            changed(k, "/said", "state", SECOND),
            changed(k, "/said", "state", 0),
            changed(k, "/arm", "name", SECOND // 10),
        ),
    ),
    "clock": Rule(_clocks, _right_clocks),
    "check": Rule(
        lambda s: [
            (c.topic, c.messages, c.gap_ns, c.late_ns, c.lost)
            for c in sorted(s.topic("said", "arm").check(), key=lambda c: c.topic)
        ],
        lambda k: [_checked(k, topic) for topic in ("/arm", "/said")],
    ),
    "completeness": Rule(
        _lost,
        lambda _: (
            (3, True, False),
            "3 messages are lost",
            (IncompleteError.__name__, ""),
        ),
    ),
    "count": Rule(
        lambda s: (
            s.all_topics().count(),
            s.topic("said").count(),
            s.topic("said").where("x > 50").count(),
            s.topic("arm").where("ranges.max > 29 and name == 'arm 2'").count(),
            s.topic("arm").where("ranges[3:7].min >= 4").count(),
            s.topic("said").where("n >= 10").limit(7).count(),
            s.topic("said", "arm").where("n == 9 or n > 20").every(3).count(),
        ),
        lambda k: (
            len(k.of()),
            len(k.of("/said")),
            len(k.of("/said", where=_is_high)),
            len(k.of("/arm", where=lambda f: max(f["ranges"]) > 29 and f["name"] == "arm 2")),
            len(k.of("/arm", where=lambda f: min(f["ranges"][3:7]) >= 4)),
            7,
            sum(
                -(-len(k.of(topic, where=lambda f: f["n"] == 9 or f["n"] > 20)) // 3)
                for topic in ("/said", "/arm")
            ),
        ),
    ),
    "in_frame": Rule(  # the recording has no transforms
        lambda s: refusal(lambda: s.topic("said").in_frame("map").to_arrow()),
        lambda k: "UsageError",
    ),
    "during": Rule(
        lambda s: _thrice(s.topic("said", "cam").during(_during(s))),
        lambda k: _right_thrice(_second(k, "/said", "/cam")),
    ),
    "every": Rule(lambda s: seqs(s.topic("said").every(7)), lambda k: seqs(k.of("/said")[::7])),
    "fields": Rule(
        lambda s: _table(
            s.topic("arm").fields("n", "name", "ranges.max").to_arrow(), "n", "name", "ranges.max"
        ),
        lambda k: [
            (m.fields["n"], m.fields["name"], max(m.fields["ranges"]))  # type: ignore[index]
            for m in k.of("/arm")
        ],
    ),
    "gaps": Rule(
        lambda s: (
            between_messages(spans(s.topic("said").gaps(longer_than="25ms"))),
            between_messages(spans(s.topic("cam").gaps(longer_than="100ms"))),
        ),
        lambda k: (
            between_messages(silent(k, "/said", 25 * MS)),
            between_messages(silent(k, "/cam", 100 * MS)),
        ),
    ),
    "in_recording": Rule(
        lambda s: _thrice(s.topic("arm").in_recording(LABEL)),
        lambda k: _right_thrice(k.of("/arm")),
    ),
    "intervals": Rule(
        lambda s: (
            spans(s.topic("said").where("x > 50").intervals()),
            spans(s.topic("arm").where("name == 'arm 2'").intervals()),
        ),
        lambda k: (
            held(k, "/said", _is_high),
            held(k, "/arm", lambda f: f["name"] == "arm 2"),
        ),
    ),
    "latched": Rule(
        lambda s: [
            batches(s.all_topics().between(FIRST_S, LAST_S).latched()),
            batches(s.topic("map").between("-0.2s", "end").latched()),
        ],
        lambda k: [in_force(k, FIRST_S), in_force(k, k.span[1] + 1 - 200 * MS)],
    ),
    "limit": Rule(lambda s: seqs(s.all_topics().limit(23)), lambda k: seqs(k.of()[:23])),
    "recordings": Rule(
        lambda s: [s.entry(one).name for one in s.topic("arm").recordings], lambda _: [LABEL]
    ),
    "resample": Rule(
        lambda s: _table(s.topic("said").resample("100ms").to_arrow(), "log_time", "distance"),
        lambda k: regular(k, "/said", SECOND // 10),
    ),
    "reverse": Rule(lambda s: rows(s.all_topics().reverse()), lambda k: sent(reversed(k.of()))),
    "stats": Rule(
        lambda s: [
            (f.topic, f.field, f.count, f.nan, f.infinite, f.min, f.max, f.mean, f.std)
            for f in s.topic("said").stats("x")
        ],
        lambda k: numbers(k, "/said", "x"),
    ),
    "to_arrow": Rule(
        lambda s: (
            _table(s.topic("arm").to_arrow(), "log_time", "n", "ranges", "position"),
            _table(s.topic("said").where("n > 20").to_arrow(), "log_time", "n", "list", "state"),
        ),
        lambda k: (
            [
                (m.log_time, *(m.fields[n] for n in ("n", "ranges", "position")))  # type: ignore[index]
                for m in k.of("/arm")
            ],
            [
                (m.log_time, *(m.fields[n] for n in ("n", "list", "state")))  # type: ignore[index]
                for m in k.of("/said", where=lambda f: f["n"] > 20)
            ],
        ),
    ),
    "to_numpy": Rule(
        lambda s: [image.tolist() for image in s.topic("cam").to_numpy()],
        lambda k: [
            np.array(m.fields["data"]).reshape(6, 8, 3).tolist()  # type: ignore[index]
            for m in k.of("/cam")
        ],
    ),
    "to_pandas": Rule(
        lambda s: (_frame(s.topic("said").to_pandas()), _frame(s.topic("arm").to_pandas())),
        lambda k: (_times(k, "/said"), _times(k, "/arm")),
    ),
    "to_polars": Rule(
        lambda s: _table(s.topic("said").to_polars().to_arrow(), "log_time", "n"),
        lambda k: _times(k, "/said"),
    ),
    "topics": Rule(lambda s: sorted(s.all_topics().topics), lambda _: sorted(CHANNELS)),
    "where": Rule(
        lambda s: (
            _thrice(s.topic("said").where("x > 50 and state == 'b'")),
            _thrice(s.topic("arm").where("ranges[90:].max < 26")),
            _thrice(s.topic("said").where("list[0] < 12 or list[2] == 2")),
            seqs(s.topic("arm").where("/said: x > 50", "10ms")),
        ),
        lambda k: (
            _right_thrice(k.of("/said", where=lambda f: _is_high(f) and f["state"] == "b")),
            _right_thrice(k.of("/arm", where=lambda f: max(f["ranges"][90:]) < 26)),
            _right_thrice(k.of("/said", where=lambda f: f["list"][0] < 12 or f["list"][2] == 2)),
            seqs(
                around(
                    k,
                    [m.log_time for m in k.of("/said", where=_is_high)],
                    STEP // 2,
                    STEP // 2 + 1,
                    "/arm",
                )
            ),
        ),
    ),
    "windows": Rule(
        lambda s: spans(s.topic("cam").windows("10ms", "20ms")),
        lambda k: [
            (max(m.log_time - 10 * MS, k.span[0]), min(m.log_time + 20 * MS, k.span[1] + 1), 1)
            for m in k.of("/cam")
        ],
    ),
}
"""By name of the method."""

EXEMPT_METHODS: dict[str, str] = {
    "follow": "it gives what comes later; see tests/live/test_follow.py",
}
"""Methods without a rule here, and why."""


EDGES = "+1s", "-500ms"


def _sql(store: hl.Store, query: str, **scope: Any) -> Any:
    return store.sql(query, **scope).rows()


def _aligned(found: Any) -> Any:
    table = found.to_arrow()
    wanted = [n for n in table.column_names if n.endswith((".n", ".distance"))]
    return _table(table, "log_time", *wanted)


STORE: dict[str, Rule] = {
    "at_time": Rule(
        lambda s: rows(at_time(s.topic("arm"), "-0.1s")),
        lambda k: sent([current(k, "/arm", k.span[1] + 1 - 100 * MS)]),
    ),
    "sentences": Rule(
        lambda s: any(
            "3 messages" in remark for remark in s.topic("said").completeness().sentences
        ),
        lambda _: True,
    ),
    "json_lines": Rule(lambda s: _json_lines(s.topic("said")), _numbers),
    "tables_of": Rule(
        lambda s: [row for t in tables_of(s.topic("said")) for row in _table(t, "log_time", "n")],
        lambda k: _times(k, "/said"),
    ),
    "channels": Rule(
        lambda s: sorted(c.channel.topic for c in channels_of(s.all_topics())),
        lambda _: sorted(CHANNELS),
    ),
    "field_types": Rule(
        lambda s: (field_types(s.topic("arm")) or {}).get("position"), lambda _: "float64[]"
    ),
    "spans": Rule(
        lambda s: [*spans_of(s.topic("arm")).values()],
        lambda k: [k.clock_span("log", ["/arm"])],
    ),
    "with_topic": Rule(
        lambda s: _thrice(narrowed(s.all_topics(), "/arm")), lambda k: _right_thrice(k.of("/arm"))
    ),
    "extras": Rule(
        lambda s: (sorted(c.topic for c in _extras(s).channels), len(_extras(s).problems)),
        lambda _: (sorted(CHANNELS), 0),
    ),
    "__repr__": Rule(lambda s: "<Store " in repr(s), lambda _: True),
    "align": Rule(
        lambda s: _aligned(s.align("arm", "said", fields={"arm": ["n"], "said": ["n"]})),
        lambda k: beside(k, "/arm", "/said"),
    ),
    "all_topics": Rule(lambda s: s.all_topics().count(), lambda k: len(k.of())),
    "choose": Rule(lambda s: [r.messages for r in s.recordings()], lambda k: [len(k.of())]),
    "entry": Rule(
        lambda s: {t: n for t, n in s.entry(LABEL).messages_by_topic().items() if n},
        lambda k: {t: n for t, n in k.counts.items() if n},
    ),
    "query": Rule(lambda s: s.query(["/arm"], [LABEL]).count(), lambda k: len(k.of("/arm"))),
    "recordings": Rule(
        lambda s: (
            s.recordings(has="arm").names,
            s.recordings(where="said: n == 4").names,
            s.recordings(where="said: n < 0").names,
            s.recordings(during=(FIRST_S, LAST_S)).names,
            s.recordings(tag="robot=7").topic("arm").count(),
        ),
        lambda k: ((LABEL,), (LABEL,), (), (LABEL,), len(k.of("/arm"))),
    ),
    "select": Rule(
        lambda s: [(e.name, e.status, e.messages, e.span) for e in s.session.select(None)],
        lambda k: [(LABEL, "open", len(k.of()), k.span)],
    ),
    "sizes": Rule(
        lambda s: {
            row.topic: row.messages for row in s.sizes().rows if row.topic in {"/arm", "/said"}
        },
        lambda k: {t: k.counts[t] for t in ("/arm", "/said")},
    ),
    "sql": Rule(
        lambda s: (
            _sql(s, "select count(*), min(n), max(n), sum(x) from said"),
            _sql(s, "select n, ranges[3], name from arm where n > 40 order by t"),
            _sql(s, "select topic, messages from topics order by topic"),
            _sql(s, "select recording, status, messages from recordings"),
            _sql(s, "select text from marks order by log_time"),
            _sql(s, "select cause, messages from losses"),
            _sql(s, "select seq from said order by t, seq", recordings=[LABEL], between=EDGES),
        ),
        lambda k: (
            [
                (
                    len(k.of("/said")),
                    min(m.fields["n"] for m in k.of("/said")),  # type: ignore[index]
                    max(m.fields["n"] for m in k.of("/said")),  # type: ignore[index]
                    sum(m.fields["x"] for m in k.of("/said")),  # type: ignore[index]
                )
            ],
            [
                (m.fields["n"], m.fields["ranges"][2], m.fields["name"])  # type: ignore[index]
                for m in k.of("/arm", where=lambda f: f["n"] > 40)
            ],
            sorted((t, n) for t, n in k.counts.items() if n),
            [(LABEL, "open", len(k.of()))],
            [(m.fields["text"],) for m in k.of("/hybridlog/marks")],  # type: ignore[index]
            [("transport", 3)],
            [(one[3],) for one in ranged(k, "/said", "log", SECOND, -SECOND // 2)],
        ),
    ),
    "session": Rule(
        lambda s: [(r.name, r.status, r.messages, r.span) for r in s.session.look().summaries],
        lambda k: [(LABEL, "open", len(k.of()), k.span)],
    ),
    "sync": Rule(
        lambda s: [
            (one.log_time_ns, two.log_time_ns)
            for one, two in s.sync(["said", "arm"], clock="log")
            if one.log_time_ns == two.log_time_ns
        ],
        lambda k: [(m.log_time, m.log_time) for m in k.of("/arm")],
    ),
    "topic": Rule(lambda s: s.topic("arm").count(), lambda k: len(k.of("/arm"))),
    "topics": Rule(lambda s: s.topics(), lambda _: sorted(CHANNELS)),
}
"""By name of the method of the store."""
