"""Arrays of messages for SQL, from columns of payloads."""

from __future__ import annotations

import threading
from collections import defaultdict
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.query.engines.base import UndecidedError
from hybridlog.query.engines.payload_columns import records_of
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hybridlog.payloads.reader import PayloadReader
    from hybridlog.query.question import RecordedChannel
    from hybridlog.sql.counts import Paths, ScanCounts

_MAX_GROUPS: Final = 2  # row groups that are kept; neighbouring chunks share one


class PayloadArrays:
    """The columns of payloads of one topic of a recording. Thread safe.

    Args:
        readers: Its files.
    """

    def __init__(self, readers: Sequence[PayloadReader]) -> None:
        self._readers: dict[tuple[int, int], list[PayloadReader]] = defaultdict(list)
        for reader in readers:
            for place in reader.places:
                self._readers[place].append(reader)
        self._kept: dict[tuple[str, int, tuple[str, ...]], tuple[NDArray[np.int64], Any]] = {}
        self._lock = threading.Lock()

    def read(
        self,
        channel: RecordedChannel,
        place: tuple[int, int],
        offset: NDArray[np.int64],
        paths: Paths,
        counts: ScanCounts,
    ) -> pa.StructArray | None:
        """Fields of some messages of a chunk.

        Args:
            channel: Their channel.
            place: Numbers of the segment and the chunk.
            offset: int64[n], where each lies in the content of the chunk.
            paths: Dotted paths of the fields; None for all.
            counts: Count what is read.

        Returns:
            n rows, typed as the codec's; None if the columns do not have all of it.
        """
        readers = self._readers.get(place)
        if not readers:
            return None
        kind = channel.arrow_type(paths)
        for reader in readers:
            columns = reader.columns_of(kind)
            if columns is None:
                continue
            group, begin, count = reader.places[place]
            try:
                known, records = self._group(reader, group, columns, kind, counts)
            except (StoreError, UndecidedError):
                return None  # the chunk, or its error, tells
            own = known[begin : begin + count]
            rows = np.minimum(np.searchsorted(own, offset), count - 1)
            if (own[rows] == offset).all():
                return records.take(pa.array(begin + rows))
        return None

    def _group(
        self,
        reader: PayloadReader,
        group: int,
        columns: Sequence[str],
        kind: Any,
        counts: ScanCounts,
    ) -> tuple[NDArray[np.int64], pa.StructArray]:
        """Offsets in their chunks, and fields, of the messages of a row group."""
        key = reader.listed.file, group, tuple(columns)
        with self._lock:
            found = self._kept.get(key)
        if found is None:
            table = reader.table(group, ["ref.off", *columns])
            counts.files.add(str(reader.file.path))
            counts.row_groups += 1
            offsets = table.column("ref").combine_chunks().field("off").to_numpy()
            found = offsets, records_of(table, kind)
            with self._lock:
                while len(self._kept) >= _MAX_GROUPS:
                    del self._kept[next(iter(self._kept))]
                self._kept[key] = found
        return found
