"""Rules of retention, and the plan: what goes, in what order, and why.

The plan is a pure function. It knows recordings by their manifests: sizes of segments, and
topics and times of their channels. Nothing is deleted here; see `keep.py`.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct, field
from msgspec.structs import replace

from hybridlog.query.choice import Choice
from hybridlog.query.latching import depth_of, publisher_of
from hybridlog.query.times import parse_duration
from hybridlog.query.topics import matcher
from hybridlog.wording import listed, parse_size, size
from hybridlog_storage.errors import HybridlogError, TimeError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.topics import TopicMatcher
    from hybridlog_storage.manifest import File, Manifest, Part, Pin

MIN_SEGMENT: Final = 4 << 20
MAX_SEGMENT: Final = 1 << 30
_SEGMENTS_OF_QUOTA: Final = 50
_TOPICS_FROM: Final = 0.8  # share of the quota above which payloads of topics go
_SEGMENTS_FROM: Final = 0.9  # share above which whole segments go
_TOPICS_BELOW: Final = 1.25  # times the free space below which segments go
_CLOCK_WAS_SET: Final = 1_577_836_800 * 10**9  # 2020: earlier times are of a clock not set yet
_LEAST_BARE: Final = 1 << 16  # bytes that a size without a unit has; less is meant as gigabytes
_KEYS: Final = ("quota", "min-free", "max-age", "topic", "never-tag", "fields-age")


class TopicRule(Struct, frozen=True):
    """Age at which payloads of some topics go; `pattern` and `age` are as the user wrote them."""

    pattern: str
    fits: TopicMatcher
    age_ns: int
    age: str


class Rules(Struct, frozen=True):
    """Rules of retention; None for no bound.

    Attributes:
        quota: Bytes that everything below the store may take.
        min_free: Bytes of the disk that stay free.
        max_age: Age at which whole segments go, as written.
        topics: Topics whose payloads go first, in this order; of several rules that match a
            topic the first one counts.
        never_tag: Tags of recordings of which nothing goes, None for any value.
        fields_age: Age at which whole recordings go, with fields and counts, as written.
        is_urgent: Whether a writer waits for room: then the largest segments go first.
    """

    quota: int | None = None
    min_free: int | None = None
    max_age: str | None = None
    topics: tuple[TopicRule, ...] = ()
    never_tag: tuple[tuple[str, str | None], ...] = ()
    fields_age: str | None = None
    is_urgent: bool = False

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Rules:
        """Rules from the table `[retention]`, or from options in its form."""
        unknown = [key for key in values if key not in _KEYS]
        if unknown:
            raise UsageError(f"Retention has no {listed(unknown)}; it has {', '.join(_KEYS)}.")
        try:
            topics, tags = values.get("topic", {}), values.get("never-tag", ())
            if not isinstance(topics, dict):
                raise UsageError("it is written {TOPIC = AGE}")
            return cls(
                _size(values, "quota"),
                _size(values, "min-free"),
                _age(values, "max-age"),
                tuple(TopicRule(n, matcher([n]), _age_ns(a), str(a)) for n, a in topics.items()),
                Choice.of(tag=tags).tag,
                _age(values, "fields-age"),
            )
        except (HybridlogError, TypeError) as error:
            raise UsageError(f"A rule of retention is malformed: {error}") from error

    @property
    def is_empty(self) -> bool:
        """True if nothing ever goes."""
        return self == Rules(never_tag=self.never_tag)

    @property
    def makes_room(self) -> bool:
        """True if something goes when room is short, whatever its age."""
        return self.quota is not None or self.min_free is not None

    def with_free(self, least: int) -> Rules:
        """The rules with so much free space at least, bytes."""
        return replace(self, min_free=max(self.min_free or 0, least))

    @property
    def segment_size(self) -> float:
        """The greatest size of a new segment: what goes are whole ones."""
        if self.quota is None:
            return math.inf
        return min(max(self.quota // _SEGMENTS_OF_QUOTA, MIN_SEGMENT), MAX_SEGMENT)

    def topic_rule(self, topic: str) -> TopicRule | None:
        """The first rule that matches a topic."""
        return next((rule for rule in self.topics if rule.fits(topic)), None)

    def is_never(self, tags: Mapping[str, str]) -> bool:
        """True if the tags of a recording keep all of it."""
        return any(key in tags and value in {None, tags[key]} for key, value in self.never_tag)


def _size(values: Mapping[str, Any], key: str) -> int | None:
    value = values.get(key)
    if value is None:
        return None
    found, text = parse_size(str(value)), str(value).strip()
    if text[-1:].isdigit() and found < _LEAST_BARE:
        raise UsageError(f"{key} {text} would be bytes: write a unit, such as {text}GB")
    return found


def _age(values: Mapping[str, Any], key: str) -> str | None:
    value = values.get(key)
    if value is not None:
        _age_ns(value)
    return None if value is None else str(value)


def _age_ns(value: object) -> int:
    """An age, ns. Elsewhere 30 is seconds and 30M minutes; here days or months may be meant."""
    text = str(value).strip()
    if not isinstance(value, str) or text[-1:].isdigit() or "M" in text:
        raise UsageError(f"{value!r} is no age: write it with a unit, such as 12h, 30d or 2y")
    try:
        return parse_duration(text)
    except TimeError as error:
        raise UsageError(f"{value!r} is no age: write 12h, 30d or 2y") from error


class Held(Struct, frozen=True):
    """A log of a recording, or what is left of it.

    Attributes:
        written: When it was written, or the time of its last message if that is later, ns.
        row_bytes: Bytes of its files of rows.
        is_pinned: Whether a pin keeps messages of it.
        stays: Whether nothing of its group may go now.
        goes_last: Whether triggers have not seen it yet.
        is_over: Whether its time in a ring is over, and triggers have seen it.
        is_in_force: Whether it has latched messages that no later ones have replaced.
    """

    recording: Manifest
    log: File
    written: int
    row_bytes: int
    topics: frozenset[str]
    is_pinned: bool
    stays: bool
    goes_last: bool
    is_over: bool
    is_in_force: bool

    @property
    def key(self) -> tuple[str, int]:
        """Id of its recording, and its number."""
        return self.recording.id, self.log.number

    @property
    def size(self) -> int:
        """Bytes of its file; 0 if it is gone."""
        return self.log.bytes if self.log.is_here else 0

    @property
    def may_go(self) -> bool:
        """True if its payloads may go before its group, unless they are pinned."""
        return may_go(self.log) and not self.stays

    @property
    def order(self) -> tuple[bool, int, int, tuple[str, int]]:
        """The oldest first, and last what triggers have not seen."""
        return self.goes_last, self.written, self.recording.created, self.key


def held_of(
    manifest: Manifest,
    now: int,
    seen: Collection[int] | None = None,
    stays: Collection[int] = (),
    over: Collection[int] = (),
) -> list[Held]:
    """The logs of a recording at `now`, ns.

    Those go last that are not among the numbers that triggers have `seen`; None if there are no
    triggers. `stays` has the numbers of those that cannot go, `over` groups whose time in a ring is
    over.
    """
    found, in_force = list[Held](), _in_force(manifest) if over else set[int]()
    later, rows = now, manifest.rows
    for number, log in sorted(manifest.logs.items(), reverse=True):
        parts = _parts_of(log, manifest)
        last = max((part.last or 0 for _, part in parts), default=0)
        # A log is not newer than those that follow it, whatever the clock was.
        later = min(later, max(log.written, last))
        found.append(
            Held(
                manifest,
                log,
                later,
                sum(file.bytes for file in rows.get(number, ())),
                frozenset(topic for topic, _ in parts),
                is_pinned(log, manifest),
                number in stays,
                seen is not None and number not in seen,
                log.group in over and (seen is None or number in seen),
                number in in_force,
            )
        )
    return found[::-1]


def _in_force(manifest: Manifest) -> set[int]:
    """Numbers of the logs with latched messages that no later ones have replaced."""
    found, newer = set[int](), Counter[Hashable]()
    for number, log in sorted(manifest.logs.items(), reverse=True):
        came = Counter[Hashable]()
        for own, part in log.parts.items():
            channel = manifest.channels[own]
            publisher = publisher_of(channel, own)
            came[publisher] += part.messages
            if part.messages and newer[publisher] < depth_of(channel):
                found.add(number)
        newer += came
    return found


def _parts_of(log: File, manifest: Manifest) -> list[tuple[str, Part]]:
    """Topics of a log, and what it has of them; of each channel one."""
    channels = manifest.channels
    return [(channels[n].topic, part) for n, part in log.parts.items() if part.messages]


def is_pinned(log: File, manifest: Manifest) -> bool:
    """True if a pin keeps messages of a log."""
    return any(
        _touches(pin, topic, part)
        for topic, part in _parts_of(log, manifest)
        for pin in manifest.pins
    )


def _touches(pin: Pin, topic: str, part: Part) -> bool:
    # A part without times may have messages at any.
    return (
        (pin.topics is None or topic in pin.topics)
        and (pin.first is None or part.last is None or pin.first <= part.last)
        and (pin.last is None or part.first is None or part.first <= pin.last)
    )


def may_go(log: File) -> bool:
    """True if a log may go before its recording: the first one of a group stays."""
    return log.is_here and log.number != log.group and bool(log.parts)


class Step(Struct, frozen=True):
    """A deletion; without segments and groups, that of the whole recording, with its fields.

    Of `segments` the payloads go, of `groups` the fields, too, but for the segments `but`. About
    so many `bytes` become free. The `reason` is empty for a ring.
    """

    recording: str
    id: str
    segments: tuple[int, ...]
    bytes: int
    reason: str
    groups: tuple[int, ...] = ()
    but: tuple[int, ...] = ()


class Plan(Struct):
    """Deletions, in their order.

    Attributes:
        used_bytes: Bytes that the store takes.
        free_bytes: Free bytes of the disk.
        steps: The deletions.
        warnings: What the rules cannot reach, in sentences.
        is_short: Whether more should go than may go.
    """

    used_bytes: int
    free_bytes: int
    steps: list[Step] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    is_short: bool = False


def plan(
    held: Iterable[tuple[Manifest, Sequence[Held]]],
    rules: Rules,
    *,
    used: int,
    free: int,
    now: int,
    has_arrays: bool = False,
) -> Plan:
    """Plan deletions: their order, and the reason of each.

    `held` are recordings with their logs, none of those that another process records; `used` and
    `free` are bytes, `now` is ns. With `has_arrays`, tables shrink when payloads go, by unknown
    amounts: whole groups wait for the next plan, which measures again.
    """
    return _Planning(rules, Plan(used, free), now, has_arrays=has_arrays).made(held)


class _Planning:
    def __init__(self, rules: Rules, made: Plan, now: int, *, has_arrays: bool) -> None:
        self._has_arrays = has_arrays
        self._rules, self._plan, self._now = rules, made, now
        self._freed = 0
        self._left: list[Held] = []  # logs of recordings of which something may go
        self._shared: set[str] = set()  # topics of rules, in logs with others
        self._going: set[tuple[str, int]] = set()  # keys of logs

    def made(self, held: Iterable[tuple[Manifest, Sequence[Held]]]) -> Plan:
        for manifest, logs in held:
            if not self._rules.is_never(manifest.tags) and not self._goes_whole(manifest, logs):
                self._left += logs
        self._left.sort(key=lambda one: one.order)
        self._by_ring()
        self._by_age()
        self._by_room()
        self._warn()
        return self._plan

    def _is_older(self, written: int, age: int) -> bool:
        # The age of what a clock that was not set has written is unknown.
        return _CLOCK_WAS_SET <= written <= self._now - age

    def _goes_whole(self, manifest: Manifest, logs: Sequence[Held]) -> bool:
        age = self._rules.fields_age
        if age is None or manifest.pins or not manifest.is_ended:
            return False
        if not logs or not self._is_older(logs[-1].written, parse_duration(age)):
            return False
        size = sum(one.size + one.row_bytes for one in logs)
        self._step(Step(manifest.name, manifest.id, (), size, f"fields older than {age}"))
        return True

    def _by_ring(self) -> None:
        """Let groups go whose time is over, rows too, but for latched messages in force."""
        for (recording, group), logs in self._grouped().items():
            going = [one for one in logs if not one.is_in_force]
            if going and all(one.is_over and not (one.is_pinned or one.stays) for one in logs):
                self._going |= {one.key for one in going}
                freed = sum(one.size + one.row_bytes for one in going)
                but = tuple(one.log.number for one in logs if one.is_in_force)
                self._step(Step(logs[0].recording.name, recording, (), freed, "", (group,), but))

    def _grouped(self) -> dict[tuple[str, int], list[Held]]:
        """What is left by recording and group, the oldest first."""
        groups: defaultdict[tuple[str, int], list[Held]] = defaultdict(list)
        for one in sorted(self._left, key=lambda one: one.order):
            groups[one.recording.id, one.log.group].append(one)
        return groups

    def _by_age(self) -> None:
        age = self._rules.max_age
        if age is not None:
            self._take(f"older than {age}", age_ns=parse_duration(age))
        for rule in self._rules.topics:
            self._take(f"{rule.pattern} older than {rule.age}", rule, age_ns=rule.age_ns)

    def _by_room(self) -> None:
        if self._short(_SEGMENTS_FROM, 1.0) > 0:
            need = self._short(_TOPICS_FROM, _TOPICS_BELOW)
            if self._rules.is_urgent:
                self._left.sort(key=lambda one: (one.goes_last, -one.size))
            self._take(self._reason(_SEGMENTS_FROM, 1.0), need=need)
        for rule in self._rules.topics:
            need = self._short(_TOPICS_FROM, _TOPICS_BELOW)
            if need > 0:
                reason = f"{rule.pattern}: {self._reason(_TOPICS_FROM, _TOPICS_BELOW)}"
                self._take(reason, rule, need=need)
        is_known = not (self._has_arrays and self._going)
        if is_known and self._short(_SEGMENTS_FROM, 1.0) > 0:
            self._groups()

    def _groups(self) -> None:
        """Let whole groups go, the oldest first, until enough is free.

        Those of a recording in progress only while its writer waits.
        """
        reason = f"{self._reason(_SEGMENTS_FROM, 1.0)}, and no payloads are left to go"
        need = self._short(_TOPICS_FROM, _TOPICS_BELOW)
        groups = {
            key: logs
            for key, logs in self._grouped().items()
            if logs[0].recording.is_ended or self._rules.is_urgent
        }
        chosen: dict[str, dict[int, int]] = {}  # what becomes free besides, by group
        for (recording, group), logs in groups.items():
            if need > 0 and not any(one.is_pinned or one.stays for one in logs):
                size = sum(one.row_bytes for one in logs)
                size += sum(one.size for one in logs if one.key not in self._going)
                chosen.setdefault(recording, {})[group] = size
                need -= size
        for recording, own in chosen.items():
            manifest = groups[recording, next(iter(own))][0].recording
            left = {group for one, group in groups if one == recording} - own.keys()
            is_whole = manifest.is_ended and not left and not manifest.pins
            numbers = () if is_whole else tuple(own)
            self._step(Step(manifest.name, recording, (), sum(own.values()), reason, numbers))

    def _short(self, share: float, times: float) -> float:
        """Bytes that are to become free for a share of the quota, and for the free space."""
        rules, need = self._rules, -math.inf
        if rules.quota is not None:
            need = self._plan.used_bytes - share * rules.quota
        if rules.min_free is not None:
            need = max(need, times * rules.min_free - self._plan.free_bytes)
        return need - self._freed

    def _reason(self, share: float, times: float) -> str:
        rules = self._rules
        quota = rules.quota
        if quota is not None and self._plan.used_bytes - self._freed > share * quota:
            return f"more than {share:.0%} of {size(quota)} is used"
        return f"less than {size(times * (rules.min_free or 0))} is free"

    def _take(
        self,
        reason: str,
        rule: TopicRule | None = None,
        *,
        age_ns: int | None = None,
        need: float = math.inf,
    ) -> None:
        """Let logs go, the oldest first, until `need` bytes become free; a step a recording.

        With `rule`, those with no other topics than its own; with `age_ns`, those that are as old.
        """
        chosen: dict[str, list[Held]] = {}  # by recording
        for one in self._left:
            if need <= 0:
                break
            if not one.may_go or (age_ns is not None and not self._is_older(one.written, age_ns)):
                continue
            if rule is not None:
                fits = {t for t in one.topics if self._rules.topic_rule(t) is rule}
                if fits != one.topics:
                    self._shared |= fits
                    continue
                if age_ns is None and one.goes_last:
                    continue
            if one.key not in self._going and not one.is_pinned:
                self._going.add(one.key)
                need -= one.size
                chosen.setdefault(one.recording.id, []).append(one)
        for recording, logs in chosen.items():
            numbers = tuple(sorted(one.log.number for one in logs))
            size, name = sum(one.size for one in logs), logs[0].recording.name
            self._step(Step(name, recording, numbers, size, reason))

    def _step(self, step: Step) -> None:
        self._freed += step.bytes
        self._plan.steps.append(step)

    def _warn(self) -> None:
        if self._shared:
            self._plan.warnings.append(
                f"{listed(sorted(self._shared))}: older files have other topics, too, and go with "
                "these. A rule for a topic holds for files that are opened after it."
            )
        left = self._short(_SEGMENTS_FROM, 1.0)
        self._plan.is_short = left > 0
        if left > 0:
            self._plan.warnings.append(
                f"{size(left)} more should be deleted, but all that is left must stay: it is "
                "pinned, being recorded, or tables and the index."
            )
