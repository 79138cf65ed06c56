"""From --topic and --recording to a question."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog.reader import Query
    from hybridlog.store import Store


def question(store: Store, topics: Sequence[str] | None, recordings: Sequence[str] | None) -> Query:
    """A question about some topics of some recordings.

    Short names and globs are resolved among the topics of the recordings that are chosen,
    so that what is ambiguous in the store may be clear in one of them.

    Args:
        store: The store.
        topics: As typed; None or empty for all.
        recordings: As typed; None or empty for all.

    Raises:
        TopicError: a name fits nothing, or several things.
    """
    if not recordings:
        return store.topic(*topics) if topics else store.all_topics()
    from hybridlog.query.topics import resolve

    chosen = store.select(recordings)
    known = {channel.topic for entry in chosen for channel in entry.channels}
    names = resolve(topics, known) if topics else sorted(known)
    return store.query(names, [entry.id for entry in chosen])
