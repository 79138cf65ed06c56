"""JSON messages, indexed with their own structure."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, cast

import bson

from hybridlog.schema.object_rows import (
    arrow_of,
    body_groups,
    body_of,
    objects_of,
    payloads_of,
    top,
)
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.schema.codec import BodyGroup, DecodedArrow, DecodedObjects
    from hybridlog.schema.definition import FieldPath
    from hybridlog.schema.object_rows import Plain
    from hybridlog_storage.messages import Buffer


class JsonCodec:
    """Messages in JSON. A JSON schema is ignored.

    Args:
        array_limit: Arrays of more elements are summarised in the index.
    """

    indexed = True
    reason: str | None = None

    def __init__(self, array_limit: int) -> None:
        self._limit = array_limit

    def paths(self) -> list[FieldPath]:
        """No fields: a message may have any content."""
        return []

    def bodies(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> Iterator[BodyGroup]:
        """Index bodies; see `Codec.bodies`."""
        return body_groups(map(self._body, payloads_of(buffer, offset, length)))

    def fields(self, payload: Buffer) -> dict[str, object]:
        """The fields of this message in its index document."""
        body = self._body(memoryview(payload))
        if isinstance(body, PayloadError):
            return {}
        return bson.decode(struct.pack("<i", len(body) + 5) + body + b"\0")

    def plain(self, payload: Buffer, names: Collection[str] | None = None) -> dict[str, object]:
        """The message as plain values; see `Codec.plain`."""
        return cast("dict[str, object]", top(_parsed(memoryview(payload))))

    def decode(self, payload: Buffer) -> object:
        """Decode the JSON text into Python objects.

        Raises:
            PayloadError: the payload is not JSON.
        """
        return _parsed(memoryview(payload))

    def arrow(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> DecodedArrow:
        """Fields as Arrow arrays; see `Codec.arrow`."""
        from hybridlog.schema.arrow_objects import objects_array

        return arrow_of(
            lambda payload: top(_parsed(payload)),
            objects_array,
            payloads_of(buffer, offset, length),
            fields,
        )

    def objects(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> DecodedObjects | None:
        """The values of the JSON texts; see `Codec.objects`."""
        return objects_of(
            lambda payload: top(_parsed(payload)), payloads_of(buffer, offset, length)
        )

    def _body(self, payload: memoryview) -> bytes | PayloadError:
        try:
            value = _parsed(payload)
        except PayloadError as error:
            return error
        try:
            return body_of(value, self._limit)
        except PayloadError as error:
            return PayloadError(f"the payload is JSON, but {error}")


def _parsed(payload: memoryview) -> Plain:
    try:
        return cast("Plain", json.loads(str(payload, "utf-8-sig")))
    except (ValueError, RecursionError) as error:
        raise PayloadError(f"the payload is not JSON: {error}") from error
