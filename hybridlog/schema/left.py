"""Fields of messages whose payloads are gone, from the rows that are left of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from hybridlog.schema.codec import Decoded, Unreadable, no_rows
from hybridlog.schema.column import Records
from hybridlog.schema.objects import Objects
from hybridlog.schema.states import CAUSES, State
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec
    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Batch, Buffer, Left


class LeftFields(Objects):
    """Fields of messages whose payloads are gone.

    Args:
        places: Where their rows are; parts are `hybridlog.columns.left_rows.LeftRows`.
        fields: Dotted paths of those wanted in `arrow`, each with all below it; None for all.
        empty: No messages, as the codec of the payloads decodes them.
    """

    def __init__(self, places: Left, fields: Collection[str] | None, empty: Decoded) -> None:
        super().__init__([], fields)
        self._places = places
        self._empty = empty

    def __len__(self) -> int:
        """Number of messages."""
        return len(self._places.row)

    @property
    def is_typed(self) -> bool:
        """True if a definition fixes the types of the fields."""
        return isinstance(self._empty.records, Records)

    def take(self, rows: NDArray[np.bool_]) -> LeftFields:
        """Select messages."""
        return LeftFields(self._places.take(rows), self.fields, self._empty)

    def plain(self, *, whole: bool) -> list[dict[str, object]]:
        """The messages as plain values, long arrays and bytes as summaries."""
        return self._documents(summaries=True)

    def _documents(self, *, summaries: bool) -> list[dict[str, object]]:
        found: list[dict[str, object]] = [{}] * len(self)
        for part, own, rows in self._places.by_part():
            made = part.documents(rows, typed=self.is_typed, summaries=summaries)
            for at, one in zip(own.tolist(), made, strict=True):
                found[at] = one
        return found

    def arrow(self) -> pa.StructArray:
        """The messages as an Arrow array; arrays of which only a summary is left are null."""
        if not self.is_typed:
            from hybridlog.schema.arrow_objects import objects_array

            return objects_array(self._documents(summaries=False), self.wanted())
        found = [part.records(rows) for part, _, rows in self._places.by_part()]
        return _placed(self._places, found, self._empty.arrow().type)

    def columns(self) -> pa.StructArray:
        """The messages as columns of tables.

        Raises:
            UnfitError: They have no common type.
        """
        return self._joined(lambda part, rows: part.columns(rows))

    def summarised(self) -> pa.StructArray:
        """The messages as an Arrow array in which arrays are summaries.

        Raises:
            UnfitError: They have no common type.
        """
        return self._joined(lambda part, rows: part.records(rows, None))

    def _joined(self, made: Callable[[Any, NDArray[np.int64]], pa.StructArray]) -> pa.StructArray:
        from hybridlog.columns.fields import joined

        found = [made(part, rows) for part, _, rows in self._places.by_part()]
        return _in_order(self._places, joined(found))

    def statistic(self, path: str, what: str) -> pa.Array[Any] | None:
        """One number of the summary of an array in each message; None if there is none.

        Args:
            path: Dotted path of the array.
            what: `n`, `min`, `max` or `mean`.
        """
        from hybridlog.schema.arrow_types import part_of_summary

        found = [
            part_of_summary(part.records(rows, {path}), path.split("."), what)
            for part, _, rows in self._places.by_part()
        ]
        kinds = [one.type for one in found if one is not None]
        return _placed(self._places, found, kinds[0]) if kinds else None

    def lacking(self, but: Collection[str] = ()) -> NDArray[np.bool_]:
        """bool[n], True for messages of which a wanted array has only its summary left.

        Args:
            but: Dotted paths of arrays of which only summaries are wanted.
        """
        found = np.zeros(len(self), np.bool_)
        for part, own, rows in self._places.by_part():
            found[own] = part.lacking(rows, self.fields, but)
        return found


def _placed(places: Left, found: Sequence[Any], kind: Any) -> Any:
    """Values of each part as one array of a type, in the order of the messages."""
    import pyarrow as pa

    from hybridlog.schema.arrow_types import narrowed

    arrays = [pa.nulls(0, kind)]
    for array, (_, own, _) in zip(found, places.by_part(), strict=True):
        arrays.append(pa.nulls(len(own), kind) if array is None else narrowed(array, kind))
    return _in_order(places, pa.concat_arrays(arrays))


def _in_order(places: Left, whole: Any) -> Any:
    """Values of one part after the other, in the order of the messages."""
    import pyarrow as pa

    order = [own for _, own, _ in places.by_part()]
    if len(order) < 2:
        return whole
    row = np.empty(len(whole), np.int64)
    row[np.concatenate(order)] = np.arange(len(whole))
    return whole.take(pa.array(row))


class LeftCodec:
    """Codec of messages whose payloads are gone.

    Args:
        original: The codec of the payloads.
        state: Why they are gone.
    """

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
        if self.state is State.REDUCED and self.indexed:
            from hybridlog.columns.left_rows import with_rows

            batch = with_rows(batch)
        places = batch.left
        if places is None:
            return self.columns(b"", no_rows(), no_rows(), fields)
        bad: dict[str, list[NDArray[np.intp]]] = {}
        is_good = np.ones(len(places.row), np.bool_)
        has_surplus = np.zeros(len(places.row), np.bool_)
        for part, own, rows in places.by_part():
            has_surplus[own] = part.surplus(rows)
            for of, reason in part.errors(rows):
                bad.setdefault(reason, []).append(own[of])
                is_good[own[of]] = False
        empty = self.original.columns(b"", no_rows(), no_rows(), fields)
        records = LeftFields(places.take(is_good), fields, empty)
        unreadable = [Unreadable(np.sort(np.concatenate(r)), text) for text, r in bad.items()]
        return Decoded(np.flatnonzero(is_good), records, unreadable, np.flatnonzero(has_surplus))

    def decode(self, payload: Buffer) -> NoReturn:
        """Refuses.

        Raises:
            PayloadError: Always.
        """
        raise PayloadError(f"its payload was {CAUSES[self.state]}; only its fields are stored")


def missing_payload(state: State, size: int, digest: bytes) -> PayloadError:
    """Tells that a payload is gone, and what is known of it."""
    return PayloadError(
        f"its payload was {CAUSES[state]}; only its fields are stored "
        f"({size} bytes, SHA-256 {digest.hex()})"
    )


def without_lacking(decoded: Decoded) -> tuple[Decoded, int]:
    """Decoded messages but for those that lack a wanted value, and how many these are."""
    records = decoded.records
    if not isinstance(records, LeftFields):
        return decoded, 0
    is_complete = ~records.lacking()
    left = Decoded(
        decoded.rows[is_complete],
        records.take(is_complete),
        decoded.unreadable,
        decoded.surplus,
    )
    return left, int((~is_complete).sum())
