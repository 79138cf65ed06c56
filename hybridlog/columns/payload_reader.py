"""Reads files of payloads: content of chunks byte for byte, and columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from hybridlog.columns.clouds import PointLayout
from hybridlog.columns.column_file import FIRST, LAST, ChunkFile, TablePart
from hybridlog.columns.layout import TopicCounts
from hybridlog.columns.parquet_file import leaves
from hybridlog.columns.payload_rows import NEEDED, Rebuilder, rows_of
from hybridlog.columns.topic_table import TopicTable
from hybridlog.columns.zones import Zone
from hybridlog.schema.arrow_types import converted, has_empty
from hybridlog_storage.errors import StoreError
from hybridlog_storage.stopping import check_wanted

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.column_file import OpenFiles
    from hybridlog.columns.payload_rows import Rebuilt
    from hybridlog.query.question import RecordedChannel


class PayloadReader(ChunkFile):
    """One file of payloads; see `ChunkFile`.

    Attributes:
        is_ordered: True if rows are in order of time and arrival.
    """

    def _take(self, values: Mapping[str, Any]) -> None:
        super()._take(values)
        layout = values["layout"]
        self._order = [str(path) for path in values["order"]]
        self._rebuilder = Rebuilder(
            str(values["wire"]),
            self._order,
            None if layout is None else PointLayout.from_json(layout),
        )
        self.is_ordered = bool(values["is_ordered"])
        self._zones = [
            {str(path): Zone.from_json(zone) for path, zone in group.items()}
            for group in values["zones"]
        ]
        if len(self._zones) != self.groups:
            raise ValueError("its row groups and its zones differ")

    @property
    def zones(self) -> Sequence[Mapping[str, Zone]]:
        """For each row group the zones of its arrays."""
        return self._zones

    def rebuilt(self, group: int) -> Rebuilt:
        """The message records of a row group.

        Raises:
            StoreError: It is damaged.
        """
        return self.cache.made(
            "rebuilt",
            self.number,
            group,
            make=lambda: self._rebuild(group),
            size_of=lambda one: int(one.data.nbytes + one.offset.nbytes),
        )

    def _rebuild(self, group: int) -> Rebuilt:
        check_wanted()
        try:
            table = self.read(group, self.choose(self._order, NEEDED))
            return self._rebuilder.records(*rows_of(table))
        except (ValueError, pa.ArrowException) as error:
            raise StoreError(f"The payload file {self.path} is invalid: {error}.") from error


class ArrayTable(TopicTable):
    """The files of a topic of a recording as a table, with arrays in full."""

    def __init__(
        self, channel: RecordedChannel, readers: Sequence[PayloadReader], opened: OpenFiles
    ) -> None:
        parts = [part for reader in readers for part in reader.parts(0, reader.listed.messages)]
        counts = TopicCounts(sum(part.rows for part in parts))
        super().__init__(channel.channel.topic, parts, counts, opened)
        self._channel = channel
        self._readers = readers

    def _find_type(self, paths: Collection[str] | None) -> Any:
        return pa.nulls(0, self._channel.arrow_type(paths))

    def _fitted(self, records: Any, kind: Any) -> Any:
        try:
            return converted(records, kind.type)
        except pa.ArrowException as error:
            raise StoreError(f"Columns of {self.topic} have another type: {error}.") from error

    def covers(self, paths: Collection[str] | None) -> bool:
        """True if the files have all of some fields; points of clouds are other columns."""
        kind = self.empty(paths).type
        names = [".".join(leaf.names) for leaf in leaves(pa.schema(list(kind)))]
        return not has_empty(kind) and all(map(self.has, names))

    def at(
        self,
        place: tuple[int, int],
        offset: NDArray[np.int64],
        paths: Collection[str] | None,
        note: Callable[[Path, int], None],
    ) -> Any:
        """Fields of some messages of a chunk.

        Args:
            place: Numbers of the segment and the chunk.
            offset: int64[n], where each lies in the content of the chunk.
            paths: Dotted paths of the fields; None for all.
            note: Called with the file and the number of each row group that is read.

        Returns:
            n rows, typed as the codec's; None if the columns do not have all of it.
        """
        if not self.covers(paths):
            return None
        kind = self.empty(paths)
        for reader in self._readers:
            found = reader.places.get(place)
            if found is None:
                continue
            part = TablePart(reader, *found, FIRST, LAST)
            note(reader.path, part.group)
            try:
                own, records = self.read(part, paths, {"ref"})
                fields = self._fitted(records, kind)
            except StoreError:
                return None  # the chunk, or its error, tells
            known = own["ref"].field("off").to_numpy()
            rows = np.minimum(np.searchsorted(known, offset), len(known) - 1)
            if (known[rows] == offset).all():
                return fields.take(pa.array(rows))
        return None
