"""The verdict on a recording by a contract, also in the XML of JUnit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np
from msgspec import Struct

from hybridlog.across.match import match
from hybridlog.arrays.message_arrays import plain_type
from hybridlog.query.answers.completeness import completeness_of
from hybridlog.query.answers.interval_queries import marks_in
from hybridlog.query.planner import log_times
from hybridlog.query.query import Query
from hybridlog.query.times import format_duration
from hybridlog.record.marks import CONTRACT
from hybridlog_storage.errors import WhereError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.contract import Contract, TopicRules
    from hybridlog.query.answers.statistics import TopicCheck
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingSummary


class Result(Struct, frozen=True):
    """One rule of a contract on one recording.

    Attributes:
        recording: Name of the recording.
        topic: Full name of the topic; empty for the whole recording.
        rule: Name of the rule, as in the contract; `messages` for a topic that must be there.
        wanted: What the rule asks for.
        found: What the recording has.
        holds: False if the rule is broken.
    """

    recording: str
    topic: str
    rule: str
    wanted: str
    found: str
    holds: bool


def judge(session: Session, contract: Contract, summary: RecordingSummary) -> list[Result]:
    """The results of all rules on a recording, in the order of the contract."""
    return [Result(summary.name, *one) for one in _verdicts(session, contract, summary)]


_Verdict = tuple[str, str, str, str, bool]  # a result without the name of the recording


def _verdicts(
    session: Session, contract: Contract, summary: RecordingSummary
) -> Iterator[_Verdict]:
    known = session.entry_of(summary).topics

    def about(*topics: str) -> Query:
        return Query(session, session.about(topics, [summary.id]))

    if contract.lost is not None:
        complete = completeness_of(session, about(*sorted(known)).question)
        lost = complete.messages if complete.is_exact else None
        yield _lost("", contract.lost, lost)
    topics = [name for name in contract.topics if name in known]
    by_topic = {one.topic: one for one in (about(*topics).check() if topics else ())}
    beyond = _beyond(session, summary)
    for name, rules in contract.topics.items():
        one = by_topic.get(name)
        if one is not None and one.messages:
            yield name, "messages", "some", str(one.messages), True
            yield from _of_times(rules, one, beyond)
            yield from _of_stamps(rules, about(name))
            yield from _of_others(rules, one, known, about)
        elif not rules.optional:
            yield name, "messages", "some", "none", False


def _beyond(session: Session, summary: RecordingSummary) -> int:
    """The silence behind the last message, as a recorder saw it, ns."""
    end = summary.extent[1]
    marks = marks_in(session, [summary.id])
    ends = [one.end or 0 for one in marks if one.tags.get("cause") == CONTRACT]
    return max([end, *ends]) - end


def _of_times(rules: TopicRules, one: TopicCheck, beyond: int) -> Iterator[_Verdict]:
    if rules.type is not None:
        types = {plain_type(name) for name in one.type.split(", ")}
        yield one.topic, "type", rules.type, one.type, types == {plain_type(rules.type)}
    if rules.rate is not None:
        rate, room = one.rate_hz, rules.tolerance * rules.rate
        holds = rate is not None and abs(rate - rules.rate) <= room
        found = "none" if rate is None else f"{rate:.6g} Hz"
        wanted = f"{rules.rate:g} Hz ± {100 * rules.tolerance:g} %"
        yield one.topic, "rate", wanted, found, holds
    late, early = one.late_ns or 0, (one.early_ns or 0) + beyond
    longest: dict[str, float] = {
        "longest_gap": max(one.gap_ns or 0, late, early),
        "jitter": one.jitter_ns or 0,
        "late_start": late,
        "early_stop": early,
    }
    for rule, ns in longest.items():
        limit = getattr(rules, rule)
        if limit is not None:
            yield one.topic, rule, format_duration(limit), format_duration(round(ns)), ns <= limit
    if rules.lost is not None:
        yield _lost(one.topic, rules.lost, one.lost)


def _of_stamps(rules: TopicRules, query: Query) -> Iterator[_Verdict]:
    limits = {"least_age": rules.least_age, "greatest_age": rules.greatest_age}
    limited = {name: limit for name, limit in limits.items() if limit is not None}
    if not limited and not rules.stamps_in_order:
        return
    (topic,) = query.topics
    table = query.fields("stamp").to_arrow().select(["log_time", "stamp"])
    rows = table.drop_null()
    unset = table.num_rows - rows.num_rows
    time, stamp = (column.cast("int64").to_numpy() for column in rows.columns)
    without = f"; {unset} without a stamp that is set" if unset else ""
    for name, limit in limited.items():
        found, holds = "no header stamps", False
        if len(stamp):
            is_least = name == "least_age"
            age = int((time - stamp).min() if is_least else (time - stamp).max())
            found = format_duration(age) + without
            holds = not unset and (age >= limit if is_least else age <= limit)
        yield topic, name, format_duration(limit), found, holds
    if rules.stamps_in_order:
        backwards = int((np.diff(stamp) < 0).sum())
        found = f"{backwards} before the last one{without}" if len(stamp) else "no header stamps"
        holds = bool(len(stamp)) and not backwards and not unset
        yield topic, "stamps_in_order", "in order", found, holds


def _of_others(
    rules: TopicRules, one: TopicCheck, known: Collection[str], about: Callable[..., Query]
) -> Iterator[_Verdict]:
    def times_of(topic: str) -> NDArray[np.int64]:
        return log_times(query.source.now(), about(topic).question)

    query = about(one.topic)
    times = times_of(one.topic) if rules.offset else np.empty(0, np.int64)
    for other, limit in rules.offset.items():
        others = times_of(other) if other in known else times[:0]
        matched = match(times, others, "nearest", None)
        far = int((np.abs(matched.distance) > limit).sum()) if len(others) else len(times)
        found = f"{far} of {len(times)} messages are farther"
        yield one.topic, "offset", f"{other} within {format_duration(limit)}", found, not far
    for predicate, share in rules.share.items():
        try:
            held, why = query.where(predicate).count(), ""
        except WhereError as error:
            held, why = 0, f": {error}"
        found, wanted = f"{held} of {one.messages}{why}", f"{predicate} for {100 * share:g} %"
        yield one.topic, "share", wanted, found, held >= share * one.messages and not why


def _lost(topic: str, limit: int, lost: int | None) -> _Verdict:
    found = "an unknown number" if lost is None else str(lost)
    return topic, "lost", str(limit), found, lost is not None and lost <= limit


def broken(results: Sequence[Result]) -> list[Result]:
    """The results of broken rules."""
    return [one for one in results if not one.holds]


def junit_of(results: Sequence[Result]) -> str:
    """A suite for each recording, a case for each rule."""
    root = ET.Element("testsuites")
    suites: dict[str, list[Result]] = defaultdict(list)
    for one in results:
        suites[one.recording].append(one)
    for recording, cases in suites.items():
        bad = sum(not one.holds for one in cases)
        about = {"name": recording, "tests": str(len(cases)), "failures": str(bad)}
        suite = ET.SubElement(root, "testsuite", _plain(about))
        for one in cases:
            named = {"classname": one.topic or "recording", "name": f"{one.rule}: {one.wanted}"}
            case = ET.SubElement(suite, "testcase", _plain(named))
            if not one.holds:
                ET.SubElement(case, "failure", _plain({"message": f"found {one.found}"}))
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _plain(texts: dict[str, str]) -> dict[str, str]:
    """Texts without characters that XML cannot hold."""
    return {
        name: "".join(c if c.isprintable() else "?" for c in text) for name, text in texts.items()
    }
