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
from hybridlog.query.topics import TopicMatcher, matcher
from hybridlog.wording import listed, parse_size, size
from hybridlog_storage.errors import HybridlogError, TimeError, UsageError

if TYPE_CHECKING:
    from hybridlog_storage.manifest import File, Manifest, Part

MIN_SEGMENT: Final = 4 << 20
MAX_SEGMENT: Final = 1 << 30
_SEGMENTS_OF_QUOTA: Final = 50
_FROM: Final = 0.9, 1.0  # share of the quota above which something goes; of the free space, below
_TO: Final = 0.8, 1.25  # and until then
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
        is_urgent: Whether a writer waits for room: then groups go of what is being recorded, too.
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
        return self == Rules(never_tag=self.never_tag, is_urgent=self.is_urgent)

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
        stays: Whether nothing of its group may go: a pin keeps messages of it, or it failed to go.
    """

    recording: Manifest
    log: File
    written: int
    row_bytes: int
    topics: frozenset[str]
    stays: bool

    @property
    def key(self) -> tuple[str, int]:
        """Id of its recording, and its number."""
        return self.recording.id, self.log.number

    @property
    def size(self) -> int:
        """Bytes of its file; 0 if it is gone."""
        return self.log.bytes if self.log.is_here else 0


def held_of(manifest: Manifest, now: int, stays: Collection[int] = ()) -> list[Held]:
    """The logs of a recording at `now`, ns; `stays` has the numbers of some that cannot go."""
    found, later, rows = list[Held](), now, manifest.rows
    for number, log in sorted(manifest.logs.items(), reverse=True):
        parts = _parts_of(log, manifest)
        # A log is not newer than those that follow it, whatever the clock was.
        later = min(later, max([log.written, *(part.last or 0 for _, part in parts)]))
        size = sum(file.bytes for file in rows.get(number, ()))
        topics = frozenset(topic for topic, _ in parts)
        stay = number in stays or is_pinned(log, manifest)
        found.append(Held(manifest, log, later, size, topics, stay))
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
    # A part without times may have messages at any.
    return any(
        (pin.topics is None or topic in pin.topics)
        and (pin.first is None or part.last is None or pin.first <= part.last)
        and (pin.last is None or part.first is None or part.first <= pin.last)
        for topic, part in _parts_of(log, manifest)
        for pin in manifest.pins
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

    def going(self, manifest: Manifest) -> list[File]:
        """The logs that go."""
        return [
            log
            for number, log in manifest.logs.items()
            if number in self.segments
            or (number not in self.but and (log.group in self.groups or self.is_whole))
        ]

    @property
    def is_whole(self) -> bool:
        """True if the recording goes."""
        return not self.segments and not self.groups


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


def past_ring(manifest: Manifest, groups: Iterable[int]) -> list[Step]:
    """Deletions of groups whose time in a ring is over: fields, too, not latched ones in force."""
    in_force, steps = _in_force(manifest), list[Step]()
    for group in groups:
        logs = [log for log in manifest.logs.values() if log.group == group]
        but = tuple(log.number for log in logs if log.number in in_force)
        if len(but) < len(logs) and not any(is_pinned(log, manifest) for log in logs):
            numbers = {log.number for log in logs} - in_force
            size = sum(f.bytes for f in manifest.present.values() if f.number in numbers)
            steps.append(Step(manifest.name, manifest.id, (), size, "", (group,), but))
    return steps


def plan(
    held: Iterable[tuple[Manifest, Sequence[Held]]],
    rules: Rules,
    *,
    used: int,
    free: int,
    now: int,
    others: int = 0,
    has_arrays: bool = False,
) -> Plan:
    """Plan deletions: their order, and the reason of each.

    `held` are recordings with their logs, none of those that another process records; `used`,
    `free` and `others`, of what no rule deletes, are bytes, `now` is ns. With `has_arrays`, tables
    shrink when payloads go, by unknown amounts: whole groups wait for the next plan.
    """
    return _Planning(rules, Plan(used, free), now, has_arrays=has_arrays).made(held, others)


class _Planning:
    def __init__(self, rules: Rules, made: Plan, now: int, *, has_arrays: bool) -> None:
        self._has_arrays = has_arrays
        self._rules, self._plan, self._now = rules, made, now
        self._freed = 0
        self._left: list[Held] = []  # logs of recordings of which something may go
        self._shared: set[str] = set()  # topics of rules, in logs with others
        self._going: set[tuple[str, int]] = set()  # keys of logs

    def made(self, held: Iterable[tuple[Manifest, Sequence[Held]]], others: int) -> Plan:
        rules, age = self._rules, self._rules.fields_age
        for manifest, logs in held:
            size = sum(file.bytes for file in manifest.present.values())
            if not logs or rules.is_never(manifest.tags):
                others += size
            elif (
                age is not None
                and manifest.is_ended
                and not manifest.pins
                and self._is_older(logs[-1], parse_duration(age))
            ):
                self._step(Step(manifest.name, manifest.id, (), size, f"fields older than {age}"))
            else:
                others += sum(one.size + one.row_bytes for one in logs if one.stays)
                self._left += logs
        self._left.sort(key=lambda one: (one.written, one.recording.created, one.key))
        self._refuse(others)
        if rules.max_age is not None:
            self._take(f"older than {rules.max_age}", age=parse_duration(rules.max_age))
        for rule in rules.topics:
            self._take(f"{rule.pattern} older than {rule.age}", rule, age=rule.age_ns)
        if self._short(_FROM) > 0:
            self._make_room()
        self._warn()
        return self._plan

    def _is_older(self, one: Held, age: int) -> bool:
        # The age of what a clock that was not set has written is unknown.
        return _CLOCK_WAS_SET <= one.written <= self._now - age

    def _refuse(self, needed: int) -> None:
        """Leave out a quota that cannot be kept: it would take all, and miss what it is for."""
        quota = self._rules.quota
        if quota is not None and needed > quota:
            self._rules, self._plan.is_short = replace(self._rules, quota=None), True
            self._plan.warnings.append(
                f"A quota of {size(quota)} cannot be kept, so nothing goes for it: {size(needed)} "
                "must stay, since it is pinned, being recorded, or MongoDB and the catalog. Give "
                "more than that."
            )

    def _make_room(self) -> None:
        """Let payloads go, of topics with rules first, then whole groups."""
        rules, quota = self._rules, self._rules.quota
        reason = f"less than {size(rules.min_free or 0)} is free"
        if quota is not None and self._plan.used_bytes - self._freed > _FROM[0] * quota:
            reason = f"more than {_FROM[0]:.0%} of {size(quota)} is used"
        for rule in rules.topics:
            self._take(f"{rule.pattern}: {reason}", rule, need=self._short(_TO))
        self._take(reason, need=self._short(_TO))
        if self._short(_FROM) > 0 and not (self._has_arrays and self._going):
            self._groups(f"{reason}, and no payloads are left to go")

    def _groups(self, reason: str) -> None:
        """Let whole groups go, the oldest first, until enough is free."""
        groups: defaultdict[tuple[str, int], list[Held]] = defaultdict(list)
        for one in self._left:
            if one.recording.is_ended or self._rules.is_urgent:
                groups[one.recording.id, one.log.group].append(one)
        counts = Counter(recording for recording, _ in groups)
        need, chosen = self._short(_TO), defaultdict[str, dict[int, int]](dict)
        for (recording, group), logs in groups.items():
            if need > 0 and not any(one.stays for one in logs):
                here = sum(one.size for one in logs if one.key not in self._going)
                chosen[recording][group] = here + sum(one.row_bytes for one in logs)
                need -= chosen[recording][group]
        for recording, own in chosen.items():
            manifest = groups[recording, next(iter(own))][0].recording
            is_all = len(own) == counts[recording]
            is_whole = is_all and manifest.is_ended and not manifest.pins
            numbers = () if is_whole else tuple(own)
            self._step(Step(manifest.name, recording, (), sum(own.values()), reason, numbers))

    def _short(self, bounds: tuple[float, float]) -> float:
        """Bytes that are to become free for a share of the quota, and for the free space."""
        rules, need, (share, times) = self._rules, -math.inf, bounds
        if rules.quota is not None:
            need = self._plan.used_bytes - share * rules.quota
        if rules.min_free is not None:
            need = max(need, times * rules.min_free - self._plan.free_bytes)
        return need - self._freed

    def _take(
        self,
        reason: str,
        rule: TopicRule | None = None,
        *,
        age: int | None = None,
        need: float = math.inf,
    ) -> None:
        """Let logs go, the oldest first, until `need` bytes become free; a step a recording.

        With `rule`, those with no other topics than its own; with `age`, ns, those that are as old.
        """
        chosen = defaultdict[str, list[Held]](list)  # by recording
        for one in self._left:
            if need <= 0:
                break
            if not may_go(one.log) or (age is not None and not self._is_older(one, age)):
                continue
            if rule is not None:
                fits = {t for t in one.topics if self._rules.topic_rule(t) is rule}
                if fits != one.topics:
                    self._shared |= fits
                    continue
            if one.key not in self._going and not one.stays:
                self._going.add(one.key)
                need -= one.size
                chosen[one.recording.id].append(one)
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
        if (left := self._short(_FROM)) > 0:
            self._plan.is_short = True
            self._plan.warnings.append(
                f"{size(left)} more should be deleted, but all that is left must stay: it is "
                "pinned, being recorded, or tables and the index."
            )
