"""JSON messages, indexed with their own structure."""

from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING, cast

from hybridlog.schema.codec import decode_each
from hybridlog.schema.objects import Objects
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.schema.codec import Decoded
    from hybridlog.schema.definition import FieldPath
    from hybridlog.schema.objects import Plain
    from hybridlog_storage.messages import Buffer


class JsonCodec:
    """Messages in JSON. A JSON schema is ignored."""

    indexed = True
    reason: str | None = None

    def paths(self) -> list[FieldPath]:
        """No fields: a message may have any content."""
        return []

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None = None,
    ) -> Decoded:
        """Decode messages; see `Codec.columns`."""
        return decode_each(self.decode, partial(Objects, fields=fields), buffer, offset, length)

    def decode(self, payload: Buffer) -> Plain:
        """Decode the JSON text into Python objects.

        Raises:
            PayloadError: the payload is not JSON.
        """
        try:
            return cast("Plain", json.loads(str(memoryview(payload), "utf-8-sig")))
        except (ValueError, RecursionError) as error:
            raise PayloadError(f"the payload is not JSON: {error}") from error
