"""Completion of recordings, topics, fields and frames, without repairs and without MongoDB."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    import click

    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_TRANSFORMS: Final = 100
"""Messages of a topic that are read to complete frames."""


def complete(context: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Candidates for a value, which its name in help tells; none where finding them fails."""
    kind = re.match(r"[\w.,:=]*", str(param.metavar).lstrip("["))
    find = _KINDS.get(kind[0].rstrip(".") if kind else "")
    if find is None:
        return []
    from hybridlog_storage.cache import import_numpy_late

    import_numpy_late()
    from hybridlog.opened import OpenStore
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    try:
        value: Path | None = context.params.get("store")
        # The shell has not expanded the tilde of the line that is being completed.
        path = store_path(None if value is None else os.path.expanduser(value))  # noqa: PTH111
        with closing(OpenStore(directory_of(path), "none", None)) as shared:
            names = [*find(shared.now(), context, incomplete)]
    except (HybridlogError, OSError):
        return []
    return [name for name in names if name.startswith(incomplete)]


def _recordings(session: Session, context: click.Context, _: str) -> Iterable[str]:
    """Names; where a recorder is meant, of recordings in progress."""
    is_recorder = context.info_name in {"mark", "top"}
    found = session.look().summaries
    return (one.name for one in found if one.status == "open" or not is_recorder)


def _tags(session: Session, _: click.Context, incomplete: str) -> Iterable[str]:
    """Keys, and values after the equals sign."""
    tags = session.look().tags
    key, sign, _value = incomplete.partition("=")
    return sorted(f"{key}={value}" for value in tags.get(key, ())) if sign else sorted(tags)


def _types(session: Session, _: click.Context, incomplete: str) -> Iterable[str]:
    """Types of messages, whole or by the name behind the package."""
    names = session.look().types
    return sorted(names | {name.rpartition("/")[2] for name in names if incomplete})


def _topics(session: Session, context: click.Context, incomplete: str) -> Iterable[str]:
    """Topics of the chosen recordings; of what has no slash, short names that stand for one."""
    topics_of = session.look().topics_of
    topics = {topic for one in _chosen(context, session) for topic in topics_of(one)}
    owners = Counter(
        "/".join(parts[start:])
        for parts in (topic.strip("/").split("/") for topic in topics)
        for start in range(len(parts))
    )
    short = (name for name, count in owners.items() if count == 1)
    return sorted({*topics, *(short if incomplete else ())})


def _conditions(session: Session, context: click.Context, incomplete: str) -> Iterable[str]:
    """Topics, with the colon and space that fields or a predicate follow; then its fields."""
    if ":" in incomplete or context.params.get("step") is not None:  # all topics of an alignment
        return _fields(session, context, incomplete)
    return (f"{topic}: " for topic in _topics(session, context, incomplete))


def _fields(session: Session, context: click.Context, incomplete: str) -> Iterable[str]:
    """Fields for the last name in a list or a predicate: of the topic before a colon, or of all."""
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


def _frames(session: Session, context: click.Context, _: str) -> Iterable[str]:
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


_KINDS: Final[dict[str, Callable[[Session, click.Context, str], Iterable[str]]]] = {
    **dict.fromkeys(("RECORDING", "A", "B"), _recordings),
    **dict.fromkeys(("TOPIC", "TOPIC=AGE"), _topics),
    **dict.fromkeys(("A,B.C", "PREDICATE"), _fields),
    **dict.fromkeys(("FRAME", "TARGET", "SOURCE"), _frames),
    "K=V": _tags,
    "TYPE": _types,
    "TOPIC:": _conditions,
}
"""By the name of a value in help."""
