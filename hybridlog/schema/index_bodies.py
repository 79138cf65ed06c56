"""Bodies of index documents: the fields of messages as BSON, long arrays summarised."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from hybridlog.schema.column import Records
from hybridlog.schema.document import bodies

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec, Decoded
    from hybridlog_storage.messages import Batch

ARRAY_LIMIT: Final = 32
"""Arrays of more elements are summarised."""
MAX_BYTES: Final = 8 << 20


class BodyGroup(NamedTuple):
    """Bodies of index documents of equal width.

    Attributes:
        rows: intp[k], rows of the input.
        body: uint8[k, width], BSON elements without the document's length and end.
        error: Reason why these payloads could not be read; the width is then 0.
    """

    rows: NDArray[np.intp]
    body: NDArray[np.uint8]
    error: str | None


def bodies_of(codec: Codec, batch: Batch) -> Iterator[BodyGroup]:
    """Make index bodies of messages of one channel, with or without payloads."""
    return bodies_in(codec.columns_of(batch) if codec.indexed else None, len(batch))


def bodies_in(decoded: Decoded | None, messages: int) -> Iterator[BodyGroup]:
    """Make index bodies of so many decoded messages; None where these have no fields.

    Each message is in exactly one group.
    """
    if decoded is None:
        if messages:
            yield _without_fields(np.arange(messages), None)
        return
    records = decoded.records
    if isinstance(records, Records):
        made = bodies(records, array_limit=ARRAY_LIMIT, max_bytes=MAX_BYTES)
    else:
        made = records.bodies(ARRAY_LIMIT, MAX_BYTES)
    for own, body in made:
        rows = decoded.rows[own]
        if isinstance(body, str):
            yield _without_fields(rows, body)
        else:
            yield BodyGroup(rows, body, None)
    for bad in decoded.unreadable:
        yield _without_fields(bad.rows, bad.reason)


def _without_fields(rows: NDArray[np.intp], error: str | None) -> BodyGroup:
    return BodyGroup(rows, np.empty((len(rows), 0), np.uint8), error)


def document_of(body: bytes) -> dict[str, object]:
    """The document of a body."""
    import bson

    return bson.decode(struct.pack("<i", len(body) + 5) + body + b"\0")
