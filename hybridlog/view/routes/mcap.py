"""Selections as MCAP for other viewers: files to read by ranges, and data for a remote data loader.

A file is written when it is first asked for, and goes with the server. The data of the loader is
made while it is sent, and nothing is kept.
"""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any, Final

from starlette.responses import FileResponse

from hybridlog.formats.slices import fingerprint
from hybridlog.query.choice import Choice
from hybridlog.query.predicate.tokens import MAX_TEXT
from hybridlog.query.query import channels_of, spans_of
from hybridlog.query.times import format_time
from hybridlog.schema.completion import with_nested
from hybridlog.view.context import Context, route
from hybridlog.view.question import MAX_TOPICS
from hybridlog.view.routes.export import mcap_response
from hybridlog_storage.errors import TimeError, UsageError

if TYPE_CHECKING:
    from starlette.responses import Response

    from hybridlog.query.query import Query
    from hybridlog.query.question import RecordedChannel
    from hybridlog.view.context import RequestParams
    from hybridlog_storage.messages import Schema

MAX_RECORDINGS: Final = 100
_MAX_PREDICATES: Final = 16
_MEDIA_TYPE: Final = "application/octet-stream"


def slice_file(context: Context, params: RequestParams) -> Response:
    """A selection as an MCAP file; ranges of it can be asked for."""
    query = _query(context, params)
    path, digest = context.slices.get(query)
    return FileResponse(path, headers={"ETag": f'"{digest[:16]}"'}, media_type=_MEDIA_TYPE)


def manifest(context: Context, params: RequestParams) -> dict[str, Any]:
    """The manifest of a remote data loader: topics, times and data URL of a selection."""
    query = _query(context, params)
    spans = spans_of(query).values()
    if not spans:
        raise TimeError("This selection has no messages.")
    schemas: dict[Schema, int] = {}
    topics = [_topic(channel, schemas) for channel in channels_of(query) if not channel.is_reduced]
    source = {
        "url": f"data?{params.encoded}",
        "id": fingerprint(query),
        "topics": [dict(topic) for topic in dict.fromkeys(topics)],
        "schemas": [_schema(schema, number) for schema, number in schemas.items()],
        "startTime": format_time(min(begin for begin, _ in spans)),
        "endTime": format_time(max(end for _, end in spans) - 1),
    }
    return {"name": _name(context, query), "sources": [source]}


def data(context: Context, params: RequestParams) -> Response:
    """A selection as an MCAP file that is read from its beginning to its end."""
    return mcap_response(_query(context, params), "slice.mcap")


def _query(context: Context, params: RequestParams) -> Query:
    """The query of the parameters, which mean what the options of the command line mean."""
    context.refresh()
    names = params.texts("recording", most=MAX_RECORDINGS)
    if not names:
        raise UsageError("The parameter recording is missing.")
    chosen = context.store.choose(Choice.of(names)).check()
    topics = params.texts("topic", most=MAX_TOPICS)
    query = chosen.topic(*topics) if topics else chosen.all_topics()
    if params.has("begin") or params.has("end"):
        query = query.between(_time(params, "begin", "start"), _time(params, "end", "end"))
    for predicate in params.texts("where", most=_MAX_PREDICATES, longest=MAX_TEXT):
        query = query.where(predicate)
    return query


def _time(params: RequestParams, name: str, default: str) -> str:
    """A time as on the command line; the plus of `+10s` is a space in a URL."""
    text = params.text(name, default, longest=64)
    return f"+{text[1:]}" if text.startswith(" ") else text


def _name(context: Context, query: Query) -> str:
    """The name of the recording, if it is one."""
    ids = query.recordings
    return context.store.entry(ids[0]).name if len(ids) == 1 else f"{len(ids)} recordings"


def _topic(recorded: RecordedChannel, schemas: dict[Schema, int]) -> tuple[tuple[str, Any], ...]:
    """A topic of the manifest; a new schema gets a number."""
    channel = recorded.channel
    schema = channel.schema
    found = (("name", channel.topic), ("messageEncoding", channel.message_encoding))
    if schema is None:
        return found
    return (*found, ("schemaId", schemas.setdefault(schema, len(schemas) + 1)))


def _schema(schema: Schema, number: int) -> dict[str, Any]:
    return {
        "id": number,
        "name": schema.name,
        "encoding": schema.encoding,
        "data": base64.b64encode(with_nested(schema).data).decode(),
    }


routes = [
    route("/mcap/slice.mcap", slice_file),
    route("/mcap/manifest", manifest),
    route("/mcap/data", data),
]
