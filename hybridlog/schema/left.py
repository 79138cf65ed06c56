"""Fields of messages whose payloads are gone, from the rows that are left of them."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from hybridlog.schema.codec import Codec, Decoded, no_rows, unreadable
from hybridlog.schema.column import Records
from hybridlog.schema.objects import Objects
from hybridlog.schema.states import CAUSES, State
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Batch, Buffer


class LeftFields(Objects):
    """Fields of messages whose payloads are gone.

    Args:
        parts: Columns of tables, those of one type together; a struct has all of them.
        order: int64[n], the row of each message among those of all parts.
        fields: Dotted paths of those wanted in `arrow`, each with all below it; None for all.
        empty: No messages, as the codec of the payloads decodes them.
    """

    def __init__(
        self,
        parts: Sequence[pa.StructArray],
        order: NDArray[np.int64],
        fields: Collection[str] | None,
        empty: Decoded,
    ) -> None:
        super().__init__([], fields)
        self._parts = parts
        self._order = order
        self._empty = empty

    def __len__(self) -> int:
        """Number of messages."""
        return len(self._order)

    @property
    def is_typed(self) -> bool:
        """True if a definition fixes the types of the fields."""
        return isinstance(self._empty.records, Records)

    def take(self, rows: NDArray[np.bool_]) -> LeftFields:
        """Select messages."""
        return LeftFields(self._parts, self._order[rows], self.fields, self._empty)

    def plain(self, *, whole: bool) -> list[dict[str, object]]:
        """The messages as plain values, long arrays and bytes as summaries."""
        return self._documents(summaries=True)

    def _documents(self, *, summaries: bool) -> list[dict[str, object]]:
        from hybridlog.columns.left_rows import documents

        made = (documents(p, typed=self.is_typed, summaries=summaries) for p in self._parts)
        found = [one for part in made for one in part]
        return [found[row] for row in self._order.tolist()]

    def arrow(self) -> pa.StructArray:
        """The messages as an Arrow array; arrays of which only a summary is left are null."""
        if not self.is_typed:
            from hybridlog.schema.arrow_columns import objects_array

            return objects_array(self._documents(summaries=False), self.wanted())
        return self._narrowed(self._records(()), self._empty.arrow().type)

    def columns(self) -> pa.StructArray:
        """The messages as columns of tables."""
        return self._joined(self._parts)

    def summarised(self) -> pa.StructArray:
        """The messages as an Arrow array; those arrays are summaries of which one is left."""
        from hybridlog.columns.left_rows import summarised_in

        return self._joined(self._records({one for p in self._parts for one in summarised_in(p)}))

    def _joined(self, parts: Sequence[pa.StructArray]) -> pa.StructArray:
        from hybridlog.columns.fields import joined

        return joined(parts).take(self._order)

    def _records(self, summarised: Collection[str]) -> list[pa.StructArray]:
        """The fields of each part; arrays at some paths are summaries."""
        from hybridlog.columns.fields import records_of

        return [records_of(p, lambda path: ".".join(path) in summarised) for p in self._parts]

    def _narrowed(self, parts: Sequence[pa.Array[Any] | None], kind: Any) -> Any:
        """Values of each part, or None, as one array of a type."""
        import pyarrow as pa

        from hybridlog.schema.arrow_types import converted

        arrays = [
            pa.nulls(len(part), kind) if one is None else converted(one, kind, drops=True)
            for one, part in zip(parts, self._parts, strict=True)
        ]
        return pa.concat_arrays([pa.nulls(0, kind), *arrays]).take(self._order)

    def statistics(self, paths: Iterable[str]) -> dict[str, pa.Array[Any]]:
        """`n`, `min`, `max` or `mean` of arrays by path (`ranges.min`), of those that have one."""
        from hybridlog.schema.arrow_types import part_of_summary

        made = {}
        for path in paths:
            array, _, what = path.rpartition(".")
            names = array.split(".")
            found = [part_of_summary(part, names, what) for part in self._records({array})]
            kind = next((one.type for one in found if one is not None), None)
            if kind is not None:
                made[path] = self._narrowed(found, kind)
        return made

    def lacking(self, but: Collection[str] = ()) -> NDArray[np.bool_]:
        """bool[n], True where a wanted array, none of `but`, has only its summary left."""
        from hybridlog.columns.left_rows import lacking

        found = [lacking(part, self.fields, but) for part in self._parts]
        return np.concatenate([np.zeros(0, np.bool_), *found])[self._order]


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

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None = None,
    ) -> Decoded:
        """No messages, since none has a payload; see `Codec.columns`."""
        return self.original.columns(buffer, offset, length, fields)

    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """The fields that are left; see `Codec.columns`."""
        from hybridlog.columns.left_rows import fields_in, with_rows

        if self.state is State.REDUCED and self.indexed:
            batch = with_rows(batch)
        places = batch.left
        if places is None:
            return self.columns(b"", no_rows(), no_rows(), fields)
        parts: list[pa.StructArray] = []
        order = np.zeros(len(places.row), np.int64)
        bad: dict[str, list[int]] = {}
        surplus: list[NDArray[np.intp]] = [no_rows()]
        for part, own, rows in places.by_part():
            found = part.take(rows)
            order[own] = np.arange(len(own)) + sum(map(len, parts))
            parts.append(fields_in(found))
            error = found.field("error")
            for row, reason in zip(own.tolist(), error.to_pylist(), strict=True):
                if reason is not None:
                    bad.setdefault(reason, []).append(row)
            has_surplus = found.field("ref").field("surplus").to_numpy(zero_copy_only=False)
            surplus.append(own[has_surplus])
        good = np.setdiff1d(np.arange(len(order)), [*chain.from_iterable(bad.values())])
        empty = self.original.columns(b"", no_rows(), no_rows(), fields)
        records = LeftFields(parts, order[good], fields, empty)
        return Decoded(good, records, unreadable(bad), np.sort(np.concatenate(surplus)))

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
