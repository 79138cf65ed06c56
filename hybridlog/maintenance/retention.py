"""Rules of retention, and the plan: what goes, in what order, and why.

The plan is a pure function. It knows recordings by their manifests: sizes of segments, and
topics, times and bytes of their channels. Nothing is deleted here; see `keep.py`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from msgspec import UNSET

from hybridlog.maintenance.expiry import MIN_BYTES
from hybridlog.query.choice import Choice
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
_STEP_BYTES: Final = 256 << 20  # that go together, so that a recorder can stop soon
_WARN_FROM: Final = 0.8  # share of the quota that pins may take without a warning
_CLOCK_WAS_SET: Final = 1_577_836_800 * 10**9  # 2020: earlier times are of a clock not set yet
_LEAST_BARE: Final = 1 << 16  # bytes that a size without a unit has; less is meant as gigabytes
_KEYS: Final = ("quota", "min-free", "max-age", "topic", "never-tag", "fields-age")


@dataclass(frozen=True, slots=True)
class TopicRule:
    """Age at which payloads of some topics go.

    Attributes:
        pattern: As the user wrote it.
        fits: Tells whether a topic matches.
        age_ns: The age, ns.
        age: The age as the user wrote it.
    """

    pattern: str
    fits: TopicMatcher
    age_ns: int
    age: str


@dataclass(frozen=True, slots=True)
class Rules:
    """Rules of retention; None for no bound.

    Attributes:
        quota: Bytes that everything below the store may take.
        min_free: Bytes of the disk that stay free.
        max_age: Age at which whole segments go, as written.
        topics: Topics whose payloads go first, in this order; of several rules that match a
            topic the first one counts.
        never_tag: Tags of recordings of which nothing goes, None for any value.
        fields_age: Age at which whole recordings go, with fields and counts, as written.
    """

    quota: int | None = None
    min_free: int | None = None
    max_age: str | None = None
    topics: tuple[TopicRule, ...] = ()
    never_tag: tuple[tuple[str, str | None], ...] = ()
    fields_age: str | None = None

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Rules:
        """Rules from the table `[retention]`, or from options in its form.

        Raises:
            UsageError: A key is unknown, or a value is not of its kind.
        """
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
                tuple(_topic_rule(topic, topics) for topic in topics),
                Choice.of(tag=tags).tag,
                _age(values, "fields-age"),
            )
        except (HybridlogError, TypeError) as error:
            raise UsageError(f"A rule of retention is malformed: {error}") from error

    def check_place(self, *, is_remote: bool) -> None:
        """Raise if a store in a bucket cannot follow them.

        Raises:
            UsageError: They ask for free space.
        """
        if is_remote and self.min_free is not None:
            raise UsageError("A bucket has no disk that fills: use --quota, not --min-free.")

    @property
    def is_empty(self) -> bool:
        """True if nothing ever goes."""
        return self == Rules(never_tag=self.never_tag)

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


def _topic_rule(topic: str, topics: Mapping[str, Any]) -> TopicRule:
    age = topics[topic]
    return TopicRule(topic, matcher([topic]), _age_ns(age), str(age))


@dataclass(frozen=True, slots=True)
class HeldSegment:
    """Payloads of a sealed segment that are still there.

    Attributes:
        number: Its number.
        written: When it was written, or the time of its last message if that is later, ns.
        size: Bytes of its file.
        topics: Payload bytes of each topic that may go: that of small messages stay.
        pinned: Topics of which a pin keeps messages.
        small: Payload bytes of topics of small messages.
    """

    number: int
    written: int
    size: int
    topics: Mapping[str, int]
    pinned: frozenset[str] = frozenset()
    small: int = 0

    def share(self, topics: AbstractSet[str]) -> int:
        """About the bytes of the file that payloads of some topics take."""
        whole = sum(self.topics.values()) + self.small
        part = sum(self.topics[topic] for topic in topics)
        return round(self.size * part / whole) if whole else self.size


@dataclass(frozen=True, slots=True)
class Held:
    """The content of a recording.

    Attributes:
        id: Its id.
        name: Its name.
        created: When it began, ns.
        written: When its last segment was written, or its last message if that is later, ns.
        tags: Its tags.
        segments: Segments with payloads, in their order.
        is_ended: Whether it has ended.
        pins: Number of its pins.
    """

    id: str
    name: str
    created: int
    written: int
    tags: Mapping[str, str]
    segments: Sequence[HeldSegment]
    is_ended: bool = True
    pins: int = 0


def held_of(manifest: Manifest, now: int) -> Held:
    """The content of a recording.

    Args:
        manifest: Its manifest.
        now: The time, ns.
    """
    found: list[HeldSegment] = []
    later, last = now, 0
    for _, log in sorted(manifest.logs.items(), reverse=True):
        parts = _parts_of(log, manifest)
        times = [part.last for _, part in parts if part.last is not None]
        written = min(max([log.written, *times]), now)
        # A segment is not newer than those that follow it, whatever the clock was.
        later = min(later, written)
        last = max(last, written)
        expired = () if log.retained is UNSET else log.retained
        if parts and expired is not None:
            segment = _segment(log, later, manifest, expired)
            found += [segment] if segment.topics or not segment.small else []
    found.reverse()
    return Held(
        manifest.id,
        manifest.name,
        manifest.created,
        last,
        manifest.tags,
        found,
        manifest.is_ended,
        len(manifest.pins),
    )


def _parts_of(log: File, manifest: Manifest) -> list[tuple[str, Part]]:
    """Topics of a log, and what it has of them; of each channel one."""
    channels = manifest.channels
    return [(channels[n].topic, part) for n, part in log.parts.items() if part.messages]


def _segment(log: File, written: int, manifest: Manifest, expired: Collection[str]) -> HeldSegment:
    topics: Counter[str] = Counter()
    messages: Counter[str] = Counter()
    for topic, part in _parts_of(log, manifest):
        if topic not in expired:
            topics[topic] += part.bytes
            messages[topic] += part.messages
    # Chunks with few stored bytes a message stay. How well each is compressed, nobody knows yet.
    packed = min(log.bytes / max(sum(topics.values()), 1), 1)
    small = [t for t, count in topics.items() if count * packed < MIN_BYTES * messages[t]]
    stays = sum(topics.pop(topic) for topic in small)
    pinned = frozenset(pinned_topics(log, manifest))
    return HeldSegment(log.number, written, log.bytes, topics, pinned, stays)


def pinned_topics(log: File, manifest: Manifest) -> set[str]:
    """Topics of a log of which a pin keeps messages."""
    return {
        topic
        for topic, part in _parts_of(log, manifest)
        for pin in manifest.pins
        if _touches(pin, topic, part)
    }


def _touches(pin: Pin, topic: str, part: Part) -> bool:
    # A part without times may have messages at any.
    return (
        (pin.topics is None or topic in pin.topics)
        and (pin.first is None or part.last is None or pin.first <= part.last)
        and (pin.last is None or part.first is None or part.first <= pin.last)
    )


@dataclass(frozen=True, slots=True)
class Step:
    """A deletion.

    Attributes:
        recording: Name of the recording.
        id: Its id.
        segments: Numbers of the segments; empty for the whole recording, with its fields.
        topics: Topics whose payloads go; empty for all.
        bytes: About the bytes that become free.
        reason: Why it goes.
        before: The time before which it was written, ns.
        digests: Digests that the files of segments must have, by number.
        copy: Address of a store with proven copies of them; empty if there is none.
    """

    recording: str
    id: str
    segments: tuple[int, ...]
    topics: tuple[str, ...]
    bytes: int
    reason: str
    before: int
    digests: Mapping[int, str] = field(default_factory=dict)
    copy: str = ""


@dataclass(slots=True)
class Plan:
    """Deletions, in their order.

    Attributes:
        used_bytes: Bytes that the store takes.
        free_bytes: Free bytes of the disk; None in a bucket.
        steps: The deletions.
        pinned_bytes: Bytes of segments that pins and tags keep.
        pins: Number of pins.
        warnings: What the rules cannot reach, in sentences.
        is_short: Whether more should go than may go.
    """

    used_bytes: int
    free_bytes: int | None
    steps: list[Step] = field(default_factory=list)
    pinned_bytes: int = 0
    pins: int = 0
    warnings: list[str] = field(default_factory=list)
    is_short: bool = False


def plan(held: Iterable[Held], rules: Rules, *, used: int, free: int | None, now: int) -> Plan:
    """Plan deletions: their order, and the reason of each.

    Args:
        held: What each recording holds, without segments that another process records.
        rules: The rules.
        used: Bytes that the store takes.
        free: Free bytes of its disk; None in a bucket.
        now: The time, ns.
    """
    return _Planning([*held], rules, used, free, now).made()


@dataclass(frozen=True, slots=True)
class _Piece:
    """A segment of a recording of which something may go."""

    held: Held
    segment: HeldSegment

    @property
    def order(self) -> tuple[int, int, str, int]:
        """The oldest first."""
        return self.segment.written, self.held.created, self.held.id, self.segment.number


class _Planning:
    def __init__(
        self, held: list[Held], rules: Rules, used: int, free: int | None, now: int
    ) -> None:
        self._held = held
        self._rules = rules
        self._now = now
        self._plan = Plan(used, free)
        self._freed = 0
        self._gone: set[str] = set()  # recordings
        self._pieces: list[_Piece] = []
        self._expired: dict[tuple[str, int], set[str]] = {}  # topics by recording and segment
        self._whole: set[tuple[str, int]] = set()

    def made(self) -> Plan:
        kept = [one for one in self._held if self._rules.is_never(one.tags)]
        others = [one for one in self._held if not self._rules.is_never(one.tags)]
        pinned = [s for one in others for s in one.segments if s.pinned]
        self._plan.pins = sum(one.pins for one in self._held)
        self._plan.pinned_bytes = sum(s.size for one in kept for s in one.segments)
        self._plan.pinned_bytes += sum(s.size for s in pinned)
        self._whole_recordings(others)
        self._pieces = sorted(
            (_Piece(o, s) for o in others if o.id not in self._gone for s in o.segments),
            key=lambda piece: piece.order,
        )
        self._by_age()
        self._by_room()
        self._warn()
        return self._plan

    def _is_older(self, written: int, age: int) -> bool:
        # The age of what a clock that was not set has written is unknown.
        return _CLOCK_WAS_SET <= written <= self._now - age

    def _whole_recordings(self, others: Iterable[Held]) -> None:
        age = self._rules.fields_age
        if age is None:
            return
        age_ns = parse_duration(age)
        for one in others:
            if one.is_ended and not one.pins and self._is_older(one.written, age_ns):
                self._gone.add(one.id)
                count, reason = sum(s.size for s in one.segments), f"fields older than {age}"
                self._step(Step(one.name, one.id, (), (), count, reason, one.written))

    def _by_age(self) -> None:
        age = self._rules.max_age
        if age is not None:
            age_ns = parse_duration(age)
            old = (p for p in self._pieces if self._is_older(p.segment.written, age_ns))
            self._segments(old, f"older than {age}", math.inf)
        for rule in self._rules.topics:
            old = (p for p in self._pieces if self._is_older(p.segment.written, rule.age_ns))
            self._topics(old, rule, f"{rule.pattern} older than {rule.age}", math.inf)

    def _by_room(self) -> None:
        if self._short(_SEGMENTS_FROM, 1.0) > 0:
            # Writing a segment again without a topic needs room for one: they go at once, and
            # several, since each deletion makes files of fields.
            need = self._short(_TOPICS_FROM, _TOPICS_BELOW)
            self._segments(self._pieces, self._reason(_SEGMENTS_FROM, 1.0), need)
        for rule in self._rules.topics:
            need = self._short(_TOPICS_FROM, _TOPICS_BELOW)
            if need > 0:
                reason = f"{rule.pattern}: {self._reason(_TOPICS_FROM, _TOPICS_BELOW)}"
                self._topics(self._pieces, rule, reason, need)

    def _short(self, share: float, times: float) -> float:
        """Bytes that are to become free for a share of the quota, and for the free space."""
        rules, need = self._rules, -math.inf
        if rules.quota is not None:
            need = self._plan.used_bytes - share * rules.quota
        free = self._plan.free_bytes
        if rules.min_free is not None and free is not None:
            need = max(need, times * rules.min_free - free)
        return need - self._freed

    def _reason(self, share: float, times: float) -> str:
        rules = self._rules
        quota = rules.quota
        if quota is not None and self._plan.used_bytes - self._freed > share * quota:
            return f"more than {share:.0%} of {size(quota)} is used"
        return f"less than {size(times * (rules.min_free or 0))} is free"

    def _segments(self, pieces: Iterable[_Piece], reason: str, need: float) -> None:
        """Let whole segments go until enough is free."""
        chosen: list[tuple[_Piece, int]] = []
        for piece in pieces:
            if need <= 0:
                break
            key, segment = (piece.held.id, piece.segment.number), piece.segment
            left = segment.topics.keys() - self._expired.get(key, set())
            if not (key in self._whole or segment.pinned):
                self._whole.add(key)
                chosen.append((piece, segment.share(left)))
                need -= chosen[-1][1]
        self._group(chosen, (), reason)

    def _topics(self, pieces: Iterable[_Piece], rule: TopicRule, reason: str, need: float) -> None:
        """Let payloads of the topics of a rule go until enough is free."""
        by_topics: dict[tuple[str, ...], list[tuple[_Piece, int]]] = {}
        for piece in pieces:
            if need <= 0:
                break
            segment = piece.segment
            key = piece.held.id, segment.number
            if key in self._whole:
                continue
            gone = self._expired.setdefault(key, set())
            topics = {
                topic
                for topic in segment.topics.keys() - segment.pinned - gone
                if self._rules.topic_rule(topic) is rule
            }
            if topics:
                gone |= topics
                share = segment.share(topics)
                is_whole = topics == segment.topics.keys() and not segment.small
                names = () if is_whole else tuple(sorted(topics))
                by_topics.setdefault(names, []).append((piece, share))
                need -= share
        for names, chosen in by_topics.items():
            self._group(chosen, names, reason)

    def _group(
        self, chosen: Iterable[tuple[_Piece, int]], topics: tuple[str, ...], reason: str
    ) -> None:
        """Make steps of the pieces of one recording; each is done as a whole."""
        groups: list[list[tuple[_Piece, int]]] = []
        latest: dict[str, list[tuple[_Piece, int]]] = {}  # of each recording
        for piece, share in chosen:
            group = latest.get(piece.held.id)
            if group is None or share + sum(count for _, count in group) > _STEP_BYTES:
                group = latest[piece.held.id] = []
                groups.append(group)
            group.append((piece, share))
        for group in groups:
            self._add(group, topics, reason)

    def _add(
        self, group: Sequence[tuple[_Piece, int]], topics: tuple[str, ...], reason: str
    ) -> None:
        held = group[0][0].held
        numbers = tuple(sorted(piece.segment.number for piece, _ in group))
        written = max(piece.segment.written for piece, _ in group)
        count = sum(share for _, share in group)
        self._step(Step(held.name, held.id, numbers, topics, count, reason, written))

    def _step(self, step: Step) -> None:
        self._freed += step.bytes
        self._plan.steps.append(step)

    def _warn(self) -> None:
        plan_, quota = self._plan, self._rules.quota
        pinned = plan_.pinned_bytes
        if quota is not None and 0 < pinned >= _WARN_FROM * quota:
            plan_.warnings.append(
                f"What is pinned takes {size(pinned)} of the quota of {size(quota)}: "
                "`hybridlog keep --pins` lists the pins, --unpin removes one."
            )
        left = self._short(_SEGMENTS_FROM, 1.0)
        plan_.is_short = left > 0
        if left > 0:
            plan_.warnings.append(
                f"{size(left)} more should be deleted, but all that is left must stay: it is "
                "pinned, being recorded, small messages, or fields, tables and the index. "
                "--fields-age and `hybridlog rm` delete whole recordings."
            )
