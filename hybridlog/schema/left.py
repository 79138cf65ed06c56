"""Fields of messages whose payloads are gone, from the rows that are left of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from hybridlog.schema.codec import Codec, Decoded, no_messages, no_rows, unreadable
from hybridlog.schema.column import Records
from hybridlog.schema.objects import Objects
from hybridlog.schema.states import CAUSES, State
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Batch, Buffer


class LeftFields(Objects):
    """Fields of messages whose payloads are gone.

    Args:
        columns: Columns of tables, one row for each message.
        fields: Dotted paths of those wanted in `arrow`, each with all below it; None for all.
        empty: No messages, as the codec of the payloads decodes them.
    """

    def __init__(
        self, columns: pa.StructArray, fields: Collection[str] | None, empty: Decoded
    ) -> None:
        super().__init__([], fields)
        self._columns = columns
        self._empty = empty

    def __len__(self) -> int:
        """Number of messages."""
        return len(self._columns)

    @property
    def is_typed(self) -> bool:
        """True if a definition fixes the types of the fields."""
        return isinstance(self._empty.records, Records)

    def take(self, rows: NDArray[np.bool_]) -> LeftFields:
        """Select messages."""
        return LeftFields(self._columns.filter(rows), self.fields, self._empty)

    def plain(self) -> list[dict[str, object]]:
        """The messages as plain values, long arrays and bytes as summaries."""
        from hybridlog.columns.left_rows import documents

        return documents(self._columns, typed=self.is_typed)

    def arrow(self) -> pa.StructArray:
        """The messages as an Arrow array; arrays of which only a summary is left are null."""
        from hybridlog.columns.fields import records_of
        from hybridlog.columns.left_rows import documents
        from hybridlog.schema.arrow_columns import objects_array
        from hybridlog.schema.arrow_types import converted

        if not self.is_typed:
            found = documents(self._columns, typed=False, summaries=False)
            return objects_array(found, self.wanted())
        return converted(records_of(self._columns), self._empty.arrow().type, drops=True)

    def columns(self) -> pa.StructArray:
        """The messages as columns of tables."""
        return self._columns

    def statistics(self, paths: Iterable[str]) -> dict[str, pa.Array[Any]]:
        """`n`, `min`, `max` or `mean` of arrays by path (`ranges.min`), of those that have one."""
        from hybridlog.columns.fields import names_of, records_of
        from hybridlog.schema.arrow_types import part_of_summary

        made = {}
        for path in paths:
            *array, what = names_of(path)
            records = records_of(self._columns, (*array,).__eq__)
            found = part_of_summary(records, array, what)
            if found is not None:
                made[path] = found
        return made

    def lacking(self, but: Collection[str] = ()) -> NDArray[np.bool_]:
        """bool[n], True where a wanted array, none of `but`, has only its summary left."""
        from hybridlog.columns.left_rows import lacking

        return lacking(self._columns, self.fields, but)


class LeftCodec(Codec):
    """Codec of messages whose payloads are gone; `state` says why."""

    def __init__(self, original: Codec, state: State) -> None:
        self.original = original
        self.state = state
        self.indexed = original.indexed
        self.reason = original.reason

    def paths(self) -> list[FieldPath]:
        """The fields of the messages."""
        return self.original.paths()

    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """The fields that are left; see `Codec.columns_of`."""
        from hybridlog.columns.fields import joined
        from hybridlog.columns.left_rows import fields_in, with_rows
        from hybridlog.schema.arrow_columns import structs

        if self.state is State.REDUCED and self.indexed:
            batch = with_rows(batch)
        places = batch.left
        if places is None:
            return self.original.columns_of(no_messages(), fields)
        parts: list[pa.StructArray] = []
        rows: list[NDArray[np.intp]] = []
        bad: dict[str, list[int]] = {}
        surplus: list[NDArray[np.intp]] = [no_rows()]
        for part, own, taken in places.by_part():
            found = part.take(taken)
            error = found.field("error")
            for row, reason in zip(own.tolist(), error.to_pylist(), strict=True):
                if reason is not None:
                    bad.setdefault(reason, []).append(row)
            there = error.is_null().to_numpy(zero_copy_only=False)
            parts.append(fields_in(found if there.all() else found.filter(there)))
            rows.append(own[there])
            has_surplus = found.field("ref").field("surplus").to_numpy(zero_copy_only=False)
            surplus.append(own[has_surplus])
        order = np.argsort(good := np.concatenate([no_rows(), *rows]))
        empty = self.original.columns_of(no_messages(), fields)
        columns = joined(parts) if parts else structs({}, 0)
        columns = columns.take(order) if len(parts) > 1 else columns
        records = LeftFields(columns, fields, empty)
        return Decoded(good[order], records, unreadable(bad), np.sort(np.concatenate(surplus)))

    def decode(self, payload: Buffer) -> NoReturn:
        """Refuses with PayloadError."""
        raise PayloadError(f"its payload was {CAUSES[self.state]}; only its fields are stored")


def missing_payload(state: State, size: int, digest: bytes) -> PayloadError:
    """Tells that a payload is gone, and what is known of it."""
    return PayloadError(
        f"its payload was {CAUSES[state]}; only its fields are stored "
        f"({size} bytes, SHA-256 {digest.hex()})"
    )


def without_lacking(decoded: Decoded, but: Collection[str] = ()) -> tuple[Decoded, int]:
    """Decoded messages but for those that lack a wanted value, and how many these are."""
    records = decoded.records
    if not isinstance(records, LeftFields):
        return decoded, 0
    is_complete = ~records.lacking(but)
    left = Decoded(
        decoded.rows[is_complete],
        records.take(is_complete),
        decoded.unreadable,
        decoded.surplus,
    )
    return left, int((~is_complete).sum())
