"""Makes a query of the options --topic, --recording and --fields."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.store import Store
    from hybridlog_storage.summary import RecordingSummary


def query_of(store: Store, topics: Sequence[str] | None, recordings: Sequence[str] | None) -> Query:
    """A query of some topics of some recordings.

    Short names and globs are resolved among the topics of the chosen recordings. A name that
    is ambiguous in the store may be clear in one recording.

    Args:
        store: The store.
        topics: As typed; None or empty for all.
        recordings: As typed; None or empty for all.

    Raises:
        TopicError: A name fits nothing, or several things.
    """
    if not recordings:
        if not topics:
            return store.all_topics()
        with _name_open_recordings(store.summaries):
            return store.topic(*topics)
    from hybridlog.entries import summary_of
    from hybridlog.losses import topics_of
    from hybridlog.query.topics import resolve

    chosen = store.select(recordings)
    known = {topic for entry in chosen for topic in topics_of(entry)}
    with _name_open_recordings(lambda: [summary_of(entry) for entry in chosen]):
        names = resolve(topics, known) if topics else sorted(known)
    return store.query(names, [entry.id for entry in chosen])


@contextmanager
def _name_open_recordings(
    recordings: Callable[[], Sequence[RecordingSummary]],
) -> Iterator[None]:
    """Add the recordings in progress to the error about a topic: they may have it."""
    try:
        yield
    except TopicError as error:
        names = [entry.label for entry in recordings() if entry.status == "open"]
        if not names:
            raise
        are = "is" if len(names) == 1 else "are"
        raise TopicError(
            f"{error}; {', '.join(names)} {are} still being recorded: ask again when that has ended"
        ) from error


def parse_fields(text: str) -> list[str]:
    """The fields of --fields, each once.

    Raises:
        UsageError: A name is empty.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise UsageError(f"--fields takes names with commas between them, not {text!r}.")
    return list(dict.fromkeys(names))
