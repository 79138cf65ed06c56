"""Makes a query of the options that choose topics and recordings, and of --fields."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hybridlog.query.choice import Choice
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.recordings import Recordings
    from hybridlog.store import Store


_MAX_NAMES = 5  # recordings in a message


def recordings_of(store: Store, choice: Choice) -> Recordings:
    """The chosen recordings; of an empty store none, if nothing is asked of them.

    Raises:
        TopicError: No recording satisfies the choice; says which condition none does.
    """
    chosen = store.choose(choice)
    return chosen if choice.is_everything else chosen.check()


def named_or_chosen(
    store: Store, choice: Choice, words: Sequence[str]
) -> tuple[Recordings, Sequence[str], bool]:
    """The recordings of a command that names one in its first word, or chooses by options.

    Returns:
        The recordings, the other words, and whether one recording is named.

    Raises:
        UsageError: There is neither a word nor an option.
        TopicError: No recording satisfies the choice.
    """
    if not choice.is_everything:
        return recordings_of(store, choice), words, False
    if not words:
        raise UsageError("Name a recording, or choose some: -r 'monday*', --has TOPIC.")
    named = Choice.of(words[0])
    return recordings_of(store, named), words[1:], store.is_one(named.name)


def asked(
    store: Store,
    topics: Sequence[str],
    choice: Choice,
    *,
    between: tuple[str, str] | None,
    where: Sequence[str],
    fields: str | None = None,
    strict: bool,
) -> Query:
    """The query of a command with these options.

    Raises:
        TopicError: A name fits nothing, or several things; or no recording is chosen.
        TimeError: `between` is no range of time.
        WhereError: A predicate cannot be parsed, or does not fit the fields.
        IncompleteError: `strict`, and messages of the range are lost.
    """
    query = query_of(store, topics, choice)
    if between is not None:
        query = query.between(*between)
    for predicate in where:
        query = query.where(predicate)
    if fields is not None:
        query = query.fields(*parse_fields(fields))
    if strict:
        query.completeness().check()
    return query


def query_of(store: Store, topics: Sequence[str] | None, choice: Choice) -> Query:
    """A query of some topics of the chosen recordings.

    Short names and globs are resolved among the topics of the chosen recordings. A name that
    is ambiguous in the store may be clear in one recording.

    Args:
        store: The store.
        topics: As typed; None or empty for all.
        choice: The recordings.

    Raises:
        TopicError: A name fits nothing, or several things; or no recording is chosen.
    """
    if choice.is_everything:
        if not topics:
            return store.all_topics()
        return store.topic(*topics)
    chosen = recordings_of(store, choice)
    if not topics:
        return chosen.all_topics()
    return chosen.topic(*topics)


def parse_fields(text: str, option: str = "--fields") -> list[str]:
    """The names of --fields or a similar option, each once.

    Raises:
        UsageError: A name is empty.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise UsageError(f"{option} takes names with commas between them, not {text!r}.")
    return list(dict.fromkeys(names))
