"""From --topic and --recording to a question."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hybridlog.losses import topics_of
from hybridlog_storage.errors import TopicError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry


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
        if not topics:
            return store.all_topics()
        with _explained(store.recordings):
            return store.topic(*topics)
    from hybridlog.query.topics import resolve

    chosen = store.select(recordings)
    known = {topic for entry in chosen for topic in topics_of(entry)}
    with _explained(lambda: chosen):
        names = resolve(topics, known) if topics else sorted(known)
    return store.query(names, [entry.id for entry in chosen])


@contextmanager
def _explained(recordings: Callable[[], Sequence[RecordingEntry]]) -> Iterator[None]:
    """A topic that is not there may be one that is only just being recorded."""
    try:
        yield
    except TopicError as error:
        names = [entry.label for entry in recordings() if entry.status == "open"]
        if not names:
            raise
        are = "is" if len(names) == 1 else "are"
        raise TopicError(
            f"{error}; {', '.join(names)} {are} still being recorded, and can be asked afterwards"
        ) from error
