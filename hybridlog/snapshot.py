"""All recordings of a store at one moment, in short, to choose among them.

Questions choose recordings here by topic, time and name. Only the chosen ones are read from
the catalog and compared with their files, so the cost of a question depends on what it is
about, not on what else is in the store.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from hybridlog_storage.cache import lazy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.summary import RecordingSummary, TopicType

UNFINISHED = frozenset({"open", "unfinished"})
"""Statuses of recordings that may have ended, or grown, since the snapshot."""
_LEAST = 4  # characters of an id that stand for it


def _order(one: RecordingSummary) -> tuple[bool, tuple[int, int], str, str]:
    return one.span is None, one.span or (0, 0), one.name, one.id


class Snapshot:
    """The summaries of all recordings. Unchangeable, so it is safe for many threads.

    They are by log time, oldest first, empty recordings last; topics and their types are by the
    hash that summaries have.
    """

    def __init__(
        self,
        summaries: Iterable[RecordingSummary],
        topics: Mapping[str, Collection[TopicType]],
    ) -> None:
        self.summaries = sorted(summaries, key=_order)
        self._topics = topics

    def __len__(self) -> int:
        return len(self.summaries)

    @lazy
    def begin(self) -> NDArray[np.int64]:
        """int64[n], first log time of each, ns."""
        return np.array([one.extent[0] for one in self.summaries], np.int64)

    @lazy
    def end(self) -> NDArray[np.int64]:
        """int64[n], one past the last log time of each, ns; both count lost messages."""
        return np.array([one.extent[1] for one in self.summaries], np.int64)

    @lazy
    def _set(self) -> NDArray[np.intp]:
        """The number of the topics of each."""
        numbers = {digest: number for number, digest in enumerate(self._topics)}
        return np.array([numbers[one.topics] for one in self.summaries], np.intp)

    @lazy
    def unfinished(self) -> list[int]:
        """Positions of those that may have later messages by now."""
        return [n for n, one in enumerate(self.summaries) if one.status in UNFINISHED]

    def with_changes(
        self,
        changed: Iterable[RecordingSummary],
        topics: Mapping[str, Collection[TopicType]],
        gone: Collection[str] = (),
    ) -> Snapshot:
        """All recordings, some of them as they are now; topics are by hash."""
        changed = [*changed]
        left_out = {*gone, *(one.id for one in changed)}
        summaries = [*(one for one in self.summaries if one.id not in left_out), *changed]
        known, used = {**self._topics, **topics}, {one.topics for one in summaries}
        return Snapshot(summaries, {digest: of for digest, of in known.items() if digest in used})

    @lazy
    def by_id(self) -> dict[str, int]:
        """The position of each recording in `summaries`, by id."""
        return {summary.id: place for place, summary in enumerate(self.summaries)}

    @lazy
    def by_name(self) -> dict[str, list[int]]:
        """The positions of the recordings with each name: one, but for those copied by hand."""
        found: dict[str, list[int]] = defaultdict(list)
        for place, summary in enumerate(self.summaries):
            found[summary.name].append(place)
        return dict(found)

    def ids_called(self) -> dict[str, str]:
        """The id of each recording, by its id and, where no other one has it, by its name."""
        places = self.by_name.items()
        names = {name: self.summaries[of[0]].id for name, of in places if len(of) == 1}
        return names | {one.id: one.id for one in self.summaries}

    @lazy
    def topics(self) -> list[str]:
        """Names of all topics, sorted; includes those whose messages are all lost."""
        return sorted({topic.topic for topics in self._topics.values() for topic in topics})

    @lazy
    def types(self) -> frozenset[str]:
        """Names of all types of messages."""
        return frozenset(
            topic.type for topics in self._topics.values() for topic in topics if topic.type
        )

    @lazy
    def tags(self) -> dict[str, dict[str, list[int]]]:
        """Positions of the recordings with each tag, by key and value."""
        found: dict[str, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
        for place, summary in enumerate(self.summaries):
            for key, value in summary.tags.items():
                found[key][value].append(place)
        return found

    @lazy
    def by_fingerprint(self) -> dict[str, RecordingSummary]:
        """A recording of each log, and of each part of one, by the fingerprint of its content."""
        found: dict[str, RecordingSummary] = {}
        for summary in self.summaries:
            parts = summary.source.get("parts")  # a catalog from elsewhere may have anything there
            known = summary.source.get("fingerprint"), *(parts if isinstance(parts, list) else ())
            found.update((one, summary) for one in known if isinstance(one, str))
        return found

    def topics_of(self, summary: RecordingSummary) -> set[str]:
        """Names of the topics of a recording."""
        return {topic.topic for topic in self._topics[summary.topics]}

    def topics_at(self, places: NDArray[np.intp]) -> list[str]:
        """Names of all topics of the recordings at some positions, sorted."""
        if len(places) == len(self.summaries):
            return self.topics
        held = list(self._topics.values())
        sets = np.unique(self._set[places]).tolist()
        return sorted({topic.topic for number in sets for topic in held[number]})

    def with_types(self, types: Collection[str]) -> NDArray[np.intp]:
        """Positions of the recordings that have messages of any of some types, in order."""
        sets = [any(t.type in types for t in held) for held in self._topics.values()]
        return np.flatnonzero(np.array(sets, np.bool_)[self._set])

    def topics_with(self, types: Collection[str]) -> tuple[str, ...]:
        """Names of all topics with messages of any of some types, sorted."""
        held = {topic for topics in self._topics.values() for topic in topics}
        return tuple(sorted({one.topic for one in held if one.type in types}))

    def having(
        self, topics: Collection[str], ids: Collection[str] | None = None
    ) -> NDArray[np.intp]:
        """Positions of recordings, all or some by id, that have any of some topics, in order."""
        wanted = {*topics}
        sets = [any(t.topic in wanted for t in held) for held in self._topics.values()]
        found = np.flatnonzero(np.array(sets, np.bool_)[self._set])
        if ids is None:
            return found
        own = [self.by_id[one] for one in ids if one in self.by_id]
        return np.intersect1d(found, np.array(own, np.intp))

    def during(self, places: NDArray[np.intp], begin: int, end: int, now: int) -> NDArray[np.intp]:
        """Those of some recordings that overlap the log time `[begin, end)`, ns.

        A recording that is being written begins with its first known message, or when it was
        started, and reaches until now.
        """
        first, last = self.begin[places], self.end[places]
        is_written = np.array([self.summaries[p].status == "open" for p in places], np.bool_)
        created = np.array([self.summaries[p].created for p in places], np.int64)
        first = np.where(is_written & (first == last), created, first)
        last = np.where(is_written, np.maximum(last, now), last)
        return places[(first < last) & (first < end) & (last > begin)]

    def differing(self, places: NDArray[np.intp]) -> list[RecordingSummary]:
        """One of the recordings at some positions for each set of topics and types."""
        _, firsts = np.unique(self._set[places], return_index=True)
        return [self.summaries[place] for place in places[np.sort(firsts)].tolist()]

    def called(self, name: str) -> list[int]:
        """Positions of the recordings with exactly this id, else with this name."""
        return [self.by_id[name]] if name in self.by_id else self.by_name.get(name, [])

    def named(self, name: str) -> list[int]:
        """Positions of the recordings that a name may mean.

        It is an id, else a name, else the beginning of a name, else that of an id or of its
        random digits.
        """
        found = self.called(name)
        if found:
            return found
        everything = list(enumerate(self.summaries))
        return [place for place, one in everything if one.name.startswith(name)] or [
            place
            for place, one in everything
            if len(name) >= _LEAST and (one.id.startswith(name) or one.key.startswith(name))
        ]

    def matching(self, pattern: str) -> list[int]:
        """Positions of the recordings whose name fits a glob, with case."""
        return [place for place, one in enumerate(self.summaries) if fnmatchcase(one.name, pattern)]
