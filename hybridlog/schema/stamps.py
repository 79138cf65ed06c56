"""Header stamps of messages, whatever their encoding."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.schema.column import STAMP

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec
    from hybridlog_storage.messages import Batch


def stamps_of(codec: Codec, batch: Batch) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Decode the header stamps of messages of one channel.

    Args:
        codec: The codec of the channel.
        batch: The messages.

    Returns:
        Rows of the messages that have a stamp, and the stamps, ns.
    """
    decoded = codec.columns(batch.buffer, batch.offset, batch.length, {STAMP})
    found = stamp_array(decoded.arrow())
    if found is None:
        return np.empty(0, np.intp), np.empty(0, np.int64)
    there = found.is_valid().to_numpy(zero_copy_only=False)
    stamps = found.drop_null().view("int64").to_numpy()
    return decoded.rows[there], stamps


def stamp_array(records: pa.StructArray) -> pa.Array[Any] | None:
    """The header stamps of decoded messages, timestamp[ns]; None when they have none."""
    import pyarrow as pa

    found: pa.Array[Any] = records
    for name in STAMP.split("."):
        if not pa.types.is_struct(found.type) or found.type.get_field_index(name) < 0:
            return None
        found = found.flatten()[found.type.get_field_index(name)]
    return found if pa.types.is_timestamp(found.type) else None
