"""The verdict on a recording by a contract, also in the XML of JUnit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np

from hybridlog.across.match import match
from hybridlog.arrays.message_arrays import plain_type
from hybridlog.query.answers.completeness import completeness_of
from hybridlog.query.answers.marks import marks_in
from hybridlog.query.answers.statistics import check
from hybridlog.query.planner import log_times
from hybridlog.query.query import Query
from hybridlog.query.question import Question
from hybridlog.query.times import format_duration
from hybridlog.record.losses import topics_of
from hybridlog.record.marks import CONTRACT
from hybridlog_storage.errors import WhereError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.contract import Contract, TopicRules
    from hybridlog.query.answers.statistics import TopicCheck
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary


@dataclass(frozen=True, slots=True)
class Result:
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
    return [*_Judge(session, contract, summary).results()]


class _Judge:
    def __init__(self, session: Session, contract: Contract, summary: RecordingSummary) -> None:
        self._session = session
        self._contract = contract
        self._summary = summary
        self._known = topics_of(session.entry_of(summary))

    def results(self) -> Iterator[Result]:
        if self._contract.lost is not None:
            complete = completeness_of(self._session, self._question(*sorted(self._known)))
            lost = complete.messages if complete.is_exact else None
            yield self._lost("", self._contract.lost, lost)
        topics = [name for name in self._contract.topics if name in self._known]
        question = self._question(*topics)
        checked = check(self._session, question) if topics else []
        by_topic = {one.topic: one for one in checked}
        beyond = self._beyond()
        for name, rules in self._contract.topics.items():
            one = by_topic.get(name)
            if one is not None and one.messages:
                yield self._result(name, "messages", "some", str(one.messages), holds=True)
                yield from self._of_times(rules, one, beyond)
                yield from self._of_stamps(rules, name)
                yield from self._of_others(rules, one)
            elif not rules.optional:
                yield self._result(name, "messages", "some", "none", holds=False)

    def _beyond(self) -> int:
        """The silence behind the last message, as a recorder saw it, ns."""
        end = self._summary.extent[1]
        ends = [
            one.end or 0
            for one in marks_in(self._session, [self._summary.id])
            if one.tags.get("cause") == CONTRACT
        ]
        return max([end, *ends]) - end

    def _of_times(self, rules: TopicRules, one: TopicCheck, beyond: int) -> Iterator[Result]:
        if rules.type is not None:
            types = {plain_type(name) for name in one.type.split(", ")}
            holds = types == {plain_type(rules.type)}
            yield self._result(one.topic, "type", rules.type, one.type, holds=holds)
        if rules.rate is not None:
            rate, room = one.rate_hz, rules.tolerance * rules.rate
            holds = rate is not None and abs(rate - rules.rate) <= room
            found = "none" if rate is None else f"{rate:.6g} Hz"
            wanted = f"{rules.rate:g} Hz ± {100 * rules.tolerance:g} %"
            yield self._result(one.topic, "rate", wanted, found, holds=holds)
        late, early = one.late_ns or 0, (one.early_ns or 0) + beyond
        yield from self._at_most(
            one.topic, "longest_gap", rules.longest_gap, max(one.gap_ns or 0, late, early)
        )
        yield from self._at_most(one.topic, "jitter", rules.jitter, one.jitter_ns or 0)
        yield from self._at_most(one.topic, "late_start", rules.late_start, late)
        yield from self._at_most(one.topic, "early_stop", rules.early_stop, early)
        if rules.lost is not None:
            yield self._lost(one.topic, rules.lost, one.lost)

    def _of_stamps(self, rules: TopicRules, topic: str) -> Iterator[Result]:
        limits = {"least_age": rules.least_age, "greatest_age": rules.greatest_age}
        limited = [name for name, limit in limits.items() if limit is not None]
        if not limited and not rules.stamps_in_order:
            return
        least, greatest, backwards, unset = None, None, 0, 0
        last: NDArray[np.int64] = np.empty(0, np.int64)
        for table in Query(self._session, self._question(topic)).fields("stamp").to_tables():
            rows = table.select(["log_time", "stamp"]).drop_null()
            unset += table.num_rows - rows.num_rows
            if rows.num_rows:
                stamp = rows["stamp"].cast("int64").to_numpy()
                age = rows["log_time"].cast("int64").to_numpy() - stamp
                low, high = int(age.min()), int(age.max())
                least = low if least is None else min(least, low)
                greatest = high if greatest is None else max(greatest, high)
                backwards += int((np.diff(np.concatenate([last, stamp])) < 0).sum())
                last = stamp[-1:]
        without = f"; {unset} without a stamp that is set" if unset else ""
        for name in limited:
            limit, age_ns = limits[name], least if name == "least_age" else greatest
            assert limit is not None
            holds = age_ns is not None and (
                age_ns >= limit if name == "least_age" else age_ns <= limit
            )
            found = "no header stamps" if age_ns is None else format_duration(age_ns) + without
            wanted = format_duration(limit)
            yield self._result(topic, name, wanted, found, holds=holds and not unset)
        if rules.stamps_in_order:
            found = f"{backwards} before the last one{without}"
            found = "no header stamps" if least is None else found
            holds = least is not None and not backwards and not unset
            yield self._result(topic, "stamps_in_order", "in order", found, holds=holds)

    def _of_others(self, rules: TopicRules, one: TopicCheck) -> Iterator[Result]:
        times = self._times(one.topic) if rules.offset else np.empty(0, np.int64)
        for other, limit in rules.offset.items():
            others = self._times(other) if other in self._known else times[:0]
            matched = match(times, others, "nearest", None)
            far = int((np.abs(matched.distance) > limit).sum()) if len(others) else len(times)
            found = f"{far} of {len(times)} messages are farther"
            wanted = f"{other} within {format_duration(limit)}"
            yield self._result(one.topic, "offset", wanted, found, holds=not far)
        for predicate, share in rules.share.items():
            try:
                query = Query(self._session, self._question(one.topic)).where(predicate)
                held, why = query.count(), ""
            except WhereError as error:
                held, why = 0, f": {error}"
            found = f"{held} of {one.messages}{why}"
            wanted = f"{predicate} for {100 * share:g} %"
            holds = held >= share * one.messages and not why
            yield self._result(one.topic, "share", wanted, found, holds=holds)

    def _times(self, topic: str) -> NDArray[np.int64]:
        return log_times(self._session, self._question(topic))

    def _at_most(self, topic: str, rule: str, limit: int | None, ns: float) -> Iterator[Result]:
        if limit is not None:
            found = format_duration(round(ns))
            yield self._result(topic, rule, format_duration(limit), found, holds=ns <= limit)

    def _lost(self, topic: str, limit: int, lost: int | None) -> Result:
        found = "an unknown number" if lost is None else str(lost)
        return self._result(
            topic, "lost", str(limit), found, holds=lost is not None and lost <= limit
        )

    def _result(self, topic: str, rule: str, wanted: str, found: str, *, holds: bool) -> Result:
        return Result(self._summary.name, topic, rule, wanted, found, holds)

    def _question(self, *topics: str) -> Question:
        return Question(*self._session.having(topics, [self._summary.id]))


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
