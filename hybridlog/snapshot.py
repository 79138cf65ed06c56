"""All recordings of a store at one moment, in short, to choose among them.

Questions choose recordings here by topic, time and name. Only the chosen ones are read from
the catalog and compared with their files, so the cost of a question depends on what it is
about, not on what else is in the store.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from hybridlog_storage.cache import lazy

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingSummary, TopicType

UNFINISHED = frozenset({"open", "unfinished"})
"""Statuses of recordings that may have ended, or grown, since the snapshot."""
_LEAST = 4  # characters of an id that stand for it


def _order(one: RecordingSummary) -> tuple[bool, tuple[int, int], str, str]:
    return one.span is None, one.span or (0, 0), one.name, one.id


class Snapshot:
    """The summaries of all recordings. Unchangeable, so it is safe for many threads.

    They are by log time, oldest first, empty recordings last, as all lists of them are; topics and
    their types are by the hash that summaries have.
    """

    def __init__(
        self,
        summaries: Iterable[RecordingSummary],
        topics: Mapping[str, Collection[TopicType]],
    ) -> None:
        self.summaries = sorted(summaries, key=_order)
        self.by_id = {one.id: one for one in self.summaries}
        used = {one.topics for one in self.summaries}
        self._topics = {digest: of for digest, of in topics.items() if digest in used}

    def with_changes(
        self,
        changed: Iterable[RecordingSummary],
        topics: Mapping[str, Collection[TopicType]],
        gone: Collection[str] = (),
    ) -> Snapshot:
        """All recordings, some of them as they are now; topics are by hash."""
        left = {one.id: one for one in self.summaries if one.id not in gone}
        found = left | {one.id: one for one in changed}
        return Snapshot(found.values(), {**self._topics, **topics})

    @lazy
    def unfinished(self) -> list[RecordingSummary]:
        """Those that may have later messages by now."""
        return [one for one in self.summaries if one.status in UNFINISHED]

    @lazy
    def kinds(self) -> frozenset[TopicType]:
        """All topics with their types."""
        return frozenset(topic for topics in self._topics.values() for topic in topics)

    @lazy
    def topics(self) -> list[str]:
        """Names of all topics, sorted; includes those whose messages are all lost."""
        return sorted({topic.topic for topic in self.kinds})

    @lazy
    def by_fingerprint(self) -> dict[str, RecordingSummary]:
        """A recording of each log, and of each part of one, by the fingerprint of its content."""
        found: dict[str, RecordingSummary] = {}
        for summary in self.summaries:
            parts = summary.source.get("parts")  # a catalog from elsewhere may have anything there
            known = summary.source.get("fingerprint"), *(parts if isinstance(parts, list) else ())
            found.update((one, summary) for one in known if isinstance(one, str))
        return found

    def topics_of(self, summaries: Iterable[RecordingSummary]) -> list[str]:
        """Names of all topics of some recordings, sorted."""
        if summaries is self.summaries:
            return self.topics
        sets = {one.topics for one in summaries}
        return sorted({topic.topic for one in sets for topic in self._topics[one]})

    def some(self, ids: Collection[str]) -> list[RecordingSummary]:
        """The recordings with some ids, without those that are gone."""
        return sorted((self.by_id[one] for one in {*ids} if one in self.by_id), key=_order)

    def with_types(self, types: Collection[str]) -> list[RecordingSummary]:
        """The recordings that have messages of any of some types."""
        sets = {digest for digest, own in self._topics.items() if any(t.type in types for t in own)}
        return [one for one in self.summaries if one.topics in sets]

    def having(
        self, topics: Collection[str], ids: Collection[str] | None = None
    ) -> list[RecordingSummary]:
        """The recordings, all or some by id, that have any of some topics."""
        wanted = {*topics}
        known = self.summaries if ids is None else self.some(ids)
        sets = {one.topics for one in known}
        having = {one for one in sets if any(t.topic in wanted for t in self._topics[one])}
        return [one for one in known if one.topics in having]

    def named(self, name: str, *, is_pattern: bool = False) -> list[RecordingSummary]:
        """The recordings that a name may mean.

        It is an id, else a name, else a glob with case if it may be one, else the beginning of a
        name, else that of an id or of its random digits.
        """
        if name in self.by_id:
            return [self.by_id[name]]
        known, is_long = self.summaries, len(name) >= _LEAST
        return (
            [one for one in known if one.name == name]
            or [one for one in known if is_pattern and fnmatchcase(one.name, name)]
            or [one for one in known if one.name.startswith(name)]
            or [o for o in known if is_long and (o.id.startswith(name) or o.key.startswith(name))]
        )


def differing(summaries: Iterable[RecordingSummary]) -> list[RecordingSummary]:
    """The first one of some recordings for each set of topics and types."""
    found: dict[str, RecordingSummary] = {}
    for one in summaries:
        found.setdefault(one.topics, one)
    return [*found.values()]
