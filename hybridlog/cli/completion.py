"""Completion of recordings, topics, fields and frames, without repairs and without MongoDB."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    import click

    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

    _Complete = Callable[[click.Context, click.Parameter, str], list[str]]

_TRANSFORMS: Final = 100
"""Messages of a topic that are read to complete frames."""


def _of_store(complete: Callable[[Session, click.Context, str], Iterable[str]]) -> _Complete:
    """A completion as click wants it; it gives no candidates where it fails."""

    @wraps(complete)
    def found(context: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
        from hybridlog_storage.lazy import import_numpy_late

        import_numpy_late()
        from hybridlog.opened import OpenStore
        from hybridlog.store import store_path
        from hybridlog_storage.remote import directory_of

        try:
            value: Path | None = context.params.get("store")
            # The shell has not expanded the tilde of the line that is being completed.
            path = store_path(None if value is None else os.path.expanduser(value))  # noqa: PTH111
            with closing(OpenStore(directory_of(path), "none", None)) as shared:
                names = [*complete(shared.now(), context, incomplete)]
        except (HybridlogError, OSError):
            return []
        return [name for name in names if name.startswith(incomplete)]

    return found


@_of_store
def complete_recording(session: Session, _: click.Context, __: str) -> Iterable[str]:
    """Names of recordings that begin with what was typed."""
    return (one.name for one in session.look().summaries)


@_of_store
def complete_tag(session: Session, _: click.Context, incomplete: str) -> Iterable[str]:
    """Tags of recordings: keys, and values after the equals sign."""
    tags = session.look().tags
    key, sign, _value = incomplete.partition("=")
    return sorted(f"{key}={value}" for value in tags.get(key, ())) if sign else sorted(tags)


@_of_store
def complete_type(session: Session, _: click.Context, incomplete: str) -> Iterable[str]:
    """Types of messages, whole or by the name behind the package."""
    names = {*session.type_names().values()}
    return sorted(names | {name.rpartition("/")[2] for name in names if incomplete})


@_of_store
def complete_running(session: Session, _: click.Context, __: str) -> Iterable[str]:
    """Names of recordings in progress that begin with what was typed."""
    return (one.name for one in session.look().summaries if one.status == "open")


@_of_store
def complete_topic(session: Session, context: click.Context, incomplete: str) -> Iterable[str]:
    """Topics that begin with what was typed; without a slash, short names as well.

    A short name is offered when it stands for one topic only. With `--recording`, the
    topics of those recordings are offered.
    """
    topics_of = session.look().topics_of
    topics = {topic for one in _chosen(context, session) for topic in topics_of(one)}
    return sorted({*topics, *(_short_names(topics) if incomplete else ())})


def complete_condition(
    context: click.Context, param: click.Parameter, incomplete: str, space: str = " "
) -> list[str]:
    """Topics, with the colon and space that fields or a predicate follow; then its fields."""
    if ":" in incomplete:
        return complete_path(context, param, incomplete)
    return [f"{topic}:{space}" for topic in complete_topic(context, param, incomplete)]


complete_field: Final = partial(complete_condition, space="")
"""The same for a field, which follows without a space."""


@_of_store
def complete_path(session: Session, context: click.Context, incomplete: str) -> Iterable[str]:
    """Fields of a topic, for the last name in a list or a predicate.

    The topic is that before a colon; without, those of the command.
    """
    from hybridlog.frames.names import SUMMARIES, is_summary
    from hybridlog.query.question import field_types
    from hybridlog.query.topics import resolve

    last = re.findall(r"[\w.]*$", incomplete)[0]
    before = incomplete.removesuffix(last)
    named = re.match(r"([^\s:]+):", before)
    if named is not None:
        given = [named[1]]
    else:
        # The parser leaves words where a value is missing, as that of the option that is
        # completed.
        given = [*context.args, *(context.params.get("words") or ())]
        given += context.params.get("topic") or ()
        if not context.resilient_parsing:  # what is completed was taken for a topic
            given = [topic for topic in given if topic != incomplete]
    chosen = [session.entry_of(one) for one in _chosen(context, session)]
    topics = resolve(given, {one.topic for entry in chosen for one in entry.channels})
    channels = (one for entry in chosen for one in session.channels_of(entry, topics))
    known = field_types(tuple(channels)) or {}
    array = last.rpartition(".")[0]
    summaries = (f"{array}.{name}" for name in SUMMARIES)
    names = [*known, *(name for name in summaries if is_summary(name, known))]
    return [f"{before}{name}" for name in names]


@_of_store
def complete_frame(session: Session, context: click.Context, _: str) -> Iterable[str]:
    """Coordinate frames in the first transforms of the chosen recordings, or all."""
    from hybridlog.query.query import Query
    from hybridlog.query.question import Question
    from hybridlog.tf import frames_named, is_of_transforms

    found: set[str] = set()
    for one in _chosen(context, session):
        for channel in session.entry_of(one).channels:
            if is_of_transforms(channel.type):
                asked = Question((channel.topic,), (one.id,), limit=_TRANSFORMS)
                found.update(*(frames_named(each.fields) for each in Query(session, asked)))
    return sorted(found)


def _chosen(context: click.Context, session: Session) -> list[RecordingSummary]:
    """The recordings of `--recording` or all, one for each set of topics and types."""
    from hybridlog.query.choosing import placed

    given = context.params.get("recording") or ()
    snapshot = session.look()
    places = placed(session, (given,) if isinstance(given, str) else given)
    found = [snapshot.summaries[n] for n in places] if given else snapshot.summaries
    return [*{one.topics: one for one in found}.values()]


def _short_names(topics: set[str]) -> Iterator[str]:
    """Short names that stand for one topic only: `scan` for `/robot/scan`."""
    owners = Counter(
        "/".join(parts[start:])
        for parts in (topic.strip("/").split("/") for topic in topics)
        for start in range(len(parts))
    )
    yield from (name for name, count in owners.items() if count == 1)
