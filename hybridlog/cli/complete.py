"""Tab completion of recordings and topics, out of the segments: no MongoDB is started."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from hybridlog_storage.directory import StoreDirectory


def complete_recording(context: typer.Context, incomplete: str) -> list[str]:
    """Labels of recordings that begin with what was typed."""
    with _nothing_on_error():
        return [i for i in _store(context).labels() if i.startswith(incomplete)]
    return []


def complete_running(context: typer.Context, incomplete: str) -> list[str]:
    """Recorders that run now, by the beginning of their id."""
    from hybridlog.live.control_server import running

    with _nothing_on_error():
        return [name for name in running(_store(context).path) if name.startswith(incomplete)]
    return []


def complete_field(context: typer.Context, incomplete: str) -> list[str]:
    """Topics, with the colon that a field follows."""
    if ":" in incomplete:
        return []
    return [f"{topic}:" for topic in complete_topic(context, incomplete)]


def complete_topic(context: typer.Context, incomplete: str) -> list[str]:
    """Topics that begin with what was typed; without a slash, short names as well.

    A short name is offered when it stands for one topic only. With `--recording`, the
    topics of those recordings are offered.
    """
    with _nothing_on_error():
        directory = _store(context)
        given = context.params.get("recording") or ()
        wanted = (given,) if isinstance(given, str) else tuple(given)
        labels = directory.labels()
        # A recording may be given by its name, too, which is not looked up here.
        topics = _topics(directory, [i for i in labels if i.startswith(wanted)] or labels)
        found = {topic for topic in topics if topic.startswith(incomplete)}
        if incomplete and not incomplete.startswith("/"):
            found.update(n for n in _short_names(topics) if n.startswith(incomplete))
        return sorted(found)
    return []


def _store(context: typer.Context) -> StoreDirectory:
    from hybridlog.store import store_path
    from hybridlog_storage.directory import StoreDirectory

    value = context.params.get("store")
    return StoreDirectory(store_path(os.path.expanduser(value) if value is not None else None))  # noqa: PTH111


def _topics(directory: StoreDirectory, labels: Sequence[str]) -> set[str]:
    from hybridlog.entries import read_summary

    return {
        channel.topic
        for label in labels
        for number, path in directory.segments(label)
        for channel in read_summary(path, number).channels.values()
    }


def _short_names(topics: set[str]) -> Iterator[str]:
    """Ends of topics, in whole parts, that no two topics share."""
    owners: dict[str, int] = {}
    for topic in topics:
        parts = topic.strip("/").split("/")
        for start in range(len(parts)):
            name = "/".join(parts[start:])
            owners[name] = owners.get(name, 0) + 1
    yield from (name for name, count in owners.items() if count == 1)


@contextmanager
def _nothing_on_error() -> Iterator[None]:
    """A shell that completes has no place for errors."""
    from hybridlog_storage.errors import HybridlogError

    try:
        yield
    except (HybridlogError, OSError):
        return
