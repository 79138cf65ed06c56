"""A pandas column whose cells are numpy arrays, without a Python object a row.

The cells lie in one flat array and are made, as read-only views, when they are looked
at. Rows may share elements, so that a million equal covariances take the room of one.
"""

from __future__ import annotations

import builtins
import operator
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import pandas as pd
from pandas.api.extensions import ExtensionArray, ExtensionDtype, register_extension_dtype
from pandas.api.indexers import check_array_indexer

from hybridlog.frames.ragged import Ragged

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from typing import Self

    import pyarrow as pa
    from numpy.typing import ArrayLike, DTypeLike, NDArray

_SHOWN = 3  # elements of a cell that are printed


@register_extension_dtype
class ArrayDtype(ExtensionDtype):
    """Type of an `ArrayColumn`, written `array[float32]`.

    Args:
        item: Type of the elements: numbers, booleans, datetime64[ns] or timedelta64[ns].
    """

    na_value = None
    _metadata: ClassVar[tuple[str, ...]] = ("item",)

    def __init__(self, item: DTypeLike = np.float64) -> None:
        self.item = np.dtype(item)
        if self.item.kind not in "biufmM":
            raise TypeError(f"arrays of {self.item} cannot be a column")

    @property
    def name(self) -> str:  # type: ignore[override]
        """`array[...]`."""
        return f"array[{self.item.name}]"

    @property
    def type(self) -> builtins.type[np.ndarray[Any, Any]]:  # type: ignore[override]
        """Class of the cells."""
        return np.ndarray

    @classmethod
    def construct_from_string(cls, string: str) -> ArrayDtype:
        """The type of that name.

        Raises:
            TypeError: It is not the name of such a type.
        """
        if not (isinstance(string, str) and string.startswith("array[") and string[-1:] == "]"):
            raise TypeError(f"cannot construct an ArrayDtype from {string!r}")
        return cls(np.dtype(string[6:-1]))

    @classmethod
    def construct_array_type(cls) -> builtins.type[ArrayColumn]:
        """The class of columns of this type."""
        return ArrayColumn

    def __from_arrow__(self, array: pa.Array[Any] | pa.ChunkedArray[Any]) -> ArrayColumn:
        """A column out of an Arrow column of lists."""
        import pyarrow.compute as pc

        chunks = getattr(array, "chunks", None)
        pieces = []
        for chunk in [array] if chunks is None else chunks:
            missing = chunk.is_null().to_numpy(zero_copy_only=False)
            length = pc.fill_null(pc.list_value_length(chunk), 0).to_numpy(zero_copy_only=False)
            values = pc.list_flatten(chunk).to_numpy(zero_copy_only=False)
            offset = np.zeros(len(chunk) + 1, np.int64)
            np.cumsum(length, out=offset[1:])
            rows = Ragged.from_offsets(np.ascontiguousarray(values, self.item), offset)
            pieces.append(ArrayColumn(rows.without(missing)))
        return ArrayColumn.concatenated(pieces) if pieces else ArrayColumn.empty(self.item)


class ArrayColumn(ExtensionArray):
    """Arrays of numbers, one a row.

    `column[i]` is a read-only view, None where a row is missing; `column.flat` is all
    elements and `column.stack()` all rows as one two-dimensional array, without a copy
    where they lie side by side.

    Args:
        rows: The cells.

    Attributes:
        rows: The cells; their elements are read-only.
    """

    def __init__(self, rows: Ragged) -> None:
        values = rows.values.view()
        values.flags.writeable = False
        self.rows = Ragged(values, rows.start, rows.length)
        self._dtype = ArrayDtype(values.dtype)

    @classmethod
    def empty(cls, item: DTypeLike) -> Self:
        """A column without rows."""
        none = np.empty(0, np.int64)
        return cls(Ragged(np.empty(0, item), none, none))

    @classmethod
    def _from_sequence(
        cls,
        scalars: Iterable[ArrayLike | None],
        *,
        dtype: ExtensionDtype | str | None = None,
        copy: bool = False,
    ) -> Self:
        if isinstance(dtype, str):
            dtype = ArrayDtype.construct_from_string(dtype)
        item = dtype.item if isinstance(dtype, ArrayDtype) else None
        if isinstance(scalars, cls) and item in {None, scalars.dtype.item}:
            return scalars.copy()
        cells = [None if _is_missing(cell) else np.asarray(cell, item) for cell in scalars]
        if any(cell is not None and cell.ndim != 1 for cell in cells):
            raise TypeError("each cell is a one-dimensional array or missing")
        there = [cell for cell in cells if cell is not None]
        if item is None:
            filled = [cell.dtype for cell in there if len(cell)]
            item = np.result_type(*filled) if filled else np.dtype(np.float64)
        length = np.array([-1 if cell is None else len(cell) for cell in cells], np.int64)
        start = np.cumsum(np.maximum(length, 0)) - np.maximum(length, 0)
        values = np.concatenate([np.empty(0, item), *there]).astype(item, copy=False)
        return cls(Ragged(values, start, length))

    @classmethod
    def _from_scalars(cls, scalars: Iterable[Any], *, dtype: ExtensionDtype) -> Self:
        """Only what is arrays already; a result of numbers stays numbers."""
        cells = list(scalars)
        if not all(cell is None or isinstance(cell, np.ndarray) for cell in cells):
            raise TypeError("not all cells are arrays")
        return cls._from_sequence(cells, dtype=dtype)

    @classmethod
    def _from_factorized(cls, values: NDArray[np.object_], original: ArrayColumn) -> Self:
        item = original.dtype.item
        cells = [None if raw is None else np.frombuffer(raw, item) for raw in values]
        return cls._from_sequence(cells, dtype=original.dtype)

    def _values_for_factorize(self) -> tuple[NDArray[np.object_], None]:
        keys = np.empty(len(self), object)
        for place, cell in enumerate(self):
            keys[place] = None if cell is None else cell.tobytes()
        return keys, None

    def duplicated(self, keep: Literal["first", "last", False] = "first") -> NDArray[np.bool_]:
        """Which rows have the elements of another; by their bytes."""
        keys = pd.Series(self._values_for_factorize()[0])
        return keys.duplicated(keep=keep).to_numpy(bool)

    def unique(self) -> Self:
        """The first of each set of equal rows."""
        return type(self)(self.rows.take(~self.duplicated()))

    def _values_for_argsort(self) -> NDArray[Any]:
        raise TypeError("arrays have no order; sort by another column")

    @classmethod
    def _concat_same_type(cls, to_concat: Sequence[ArrayColumn]) -> Self:
        return cls.concatenated(to_concat)

    @classmethod
    def concatenated(cls, to_concat: Sequence[ArrayColumn]) -> Self:
        """Columns of one type, at least one, one after the other."""
        if len(to_concat) == 1:
            return cls(to_concat[0].rows)
        parts = [column.rows for column in to_concat if len(column)]
        if not parts:
            return cls.empty(to_concat[0].dtype.item)
        first = parts[0]
        if all(part.values is first.values for part in parts):
            rows = [part.start for part in parts], [part.length for part in parts]
            return cls(Ragged(first.values, np.concatenate(rows[0]), np.concatenate(rows[1])))
        flats = [_tight(part) for part in parts]
        shift = np.cumsum([0, *(len(flat.values) for flat in flats)])
        return cls(
            Ragged(
                np.concatenate([flat.values for flat in flats]),
                np.concatenate([f.start + by for f, by in zip(flats, shift, strict=False)]),
                np.concatenate([flat.length for flat in flats]),
            )
        )

    @property
    def dtype(self) -> ArrayDtype:
        """`array[...]`."""
        return self._dtype

    @property
    def nbytes(self) -> int:
        """Bytes held; rows that are equal throughout count once."""
        return self.rows.nbytes

    @property
    def flat(self) -> NDArray[Any]:
        """All elements, row after row, read-only; a view where they lie so."""
        values = self.rows.compact()[0].view()
        values.flags.writeable = False
        return values

    def lengths(self) -> NDArray[np.int64]:
        """Elements of each row, int64[n]; -1 for missing rows."""
        return self.rows.length.copy()

    def stack(self) -> NDArray[Any]:
        """The rows as one array of shape (n, width), read-only; a view where possible.

        Raises:
            ValueError: Rows differ in length, or some are missing.
        """
        stacked = self.rows.stacked()
        if stacked is None:
            raise ValueError("the rows differ in length or some are missing; see lengths()")
        stacked = stacked.view()
        stacked.flags.writeable = False
        return stacked

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def __iter__(self) -> Iterator[NDArray[Any] | None]:
        """The cells; pandas' own way looks each up by itself."""
        return iter(self.rows)

    def __getitem__(self, item: Any) -> Any:
        """A cell, or the chosen rows as a column over the same elements."""
        if isinstance(item, tuple) and len(item) == 2 and item[0] is Ellipsis:
            item = item[1]  # pandas asks its blocks so
        if hasattr(item, "__index__") and not isinstance(item, np.ndarray):
            index = operator.index(item)
            if not -len(self) <= index < len(self):
                raise IndexError(f"row {index} of {len(self)}")
            return self.rows.row(index)
        if not isinstance(item, slice):
            item = check_array_indexer(self, item)
        return type(self)(self.rows.take(item))

    def __setitem__(self, key: Any, value: Any) -> None:
        """Not possible.

        Raises:
            TypeError: Always.
        """
        raise TypeError("cells of an array column cannot be assigned; assign a new column")

    def __eq__(self, other: object) -> Any:
        """Which rows have the same elements; a single array is compared with every row."""
        if isinstance(other, (pd.Series, pd.Index, pd.DataFrame)):
            return NotImplemented
        if isinstance(other, ArrayColumn):
            return _equal(self.rows, other.rows)
        if isinstance(other, np.ndarray) and other.ndim == 1 and other.dtype != object:
            return _equal(self.rows, Ragged.repeated(other, len(self)))
        if isinstance(other, (list, np.ndarray)) and len(other) == len(self):
            return _equal(self.rows, self._from_sequence(other).rows)
        return NotImplemented

    def __ne__(self, other: object) -> Any:
        """The opposite of `==`."""
        same = self.__eq__(other)
        return same if same is NotImplemented else ~same

    __hash__ = None  # type: ignore[assignment]

    def equals(self, other: object) -> bool:
        """Whether type, missing rows and elements are the same; NaN equals NaN."""
        if not isinstance(other, ArrayColumn) or other.dtype != self.dtype:
            return False
        if len(self) != len(other):
            return False
        if not np.array_equal(self.rows.length, other.rows.length):
            return False
        return np.array_equal(self.flat, other.flat, equal_nan=self.dtype.item.kind in "fmM")

    def isna(self) -> NDArray[np.bool_]:
        """Which rows are missing."""
        return self.rows.missing

    def take(self, indices: Any, *, allow_fill: bool = False, fill_value: Any = None) -> Self:
        """The rows of those numbers; -1 gives a missing row with `allow_fill`.

        Raises:
            IndexError: There is no such row.
            ValueError: A number below -1 with `allow_fill`, or a fill value that is an
                array.
        """
        index = np.asarray(indices, np.intp)
        if not allow_fill:
            if len(index) and not len(self):
                raise IndexError("cannot do a non-empty take from an empty axes.")
            return type(self)(self.rows.take(index))
        if (index < -1).any():
            raise ValueError("a row number is below -1")
        if not _is_missing(fill_value):
            raise ValueError("only missing rows can be filled in")
        absent = index == -1
        if not len(self):
            if not absent.all():
                raise IndexError("cannot do a non-empty take from an empty axes.")
            zero = np.zeros(len(index), np.int64)
            return type(self)(Ragged(self.rows.values, zero, zero - 1))
        return type(self)(self.rows.take(np.where(absent, 0, index)).without(absent))

    def copy(self) -> Self:
        """The same cells. They are read-only, so they may be shared."""
        return type(self)(self.rows)

    def astype(self, dtype: Any, copy: bool = True) -> Any:  # noqa: FBT001, FBT002
        """Another type: other elements (`array[float64]`), objects, strings."""
        wanted = pd.api.types.pandas_dtype(dtype)
        if isinstance(wanted, ArrayDtype):
            rows = self.rows
            values = rows.values.astype(wanted.item, copy=False)
            return type(self)(Ragged(values, rows.start, rows.length))
        if wanted == np.dtype(object):
            return self.to_numpy()
        return super().astype(wanted, copy)

    def to_numpy(
        self,
        dtype: Any = None,
        copy: bool = False,  # noqa: FBT001, FBT002
        na_value: object = None,
    ) -> NDArray[Any]:
        """An object array of the cells; `stack()` gives one of numbers.

        Args:
            dtype: None or object.
            copy: Nothing is shared but the cells' elements.
            na_value: What stands for missing rows.

        Raises:
            TypeError: Another dtype.
        """
        if dtype is not None and np.dtype(dtype) != np.dtype(object):
            raise TypeError("cells are arrays: ask for object, or use .array.stack()")
        if na_value is pd.api.extensions.no_default:
            na_value = None
        cells = np.empty(len(self), object)
        for place, cell in enumerate(self):
            cells[place] = na_value if cell is None else cell
        return cells

    def __array__(
        self,
        dtype: DTypeLike | None = None,
        copy: bool | None = None,  # noqa: FBT001
    ) -> NDArray[Any]:
        """An object array of the cells."""
        return self.to_numpy(dtype)

    def __arrow_array__(self, type: pa.DataType | None = None) -> pa.ChunkedArray[Any]:  # noqa: A002
        """An Arrow column of lists."""
        from hybridlog.frames.accumulate import Lists
        from hybridlog.frames.arrow import lists

        kinds = {"M": "time", "m": "duration"}
        rows = self.rows
        kind = kinds.get(rows.values.dtype.kind, "number")
        if kind != "number":
            rows = Ragged(rows.values.view(np.int64), rows.start, rows.length)
        column = lists(Lists(rows, kind, None))  # type: ignore[arg-type]
        return column if type is None else column.cast(type)

    def _formatter(self, boxed: bool = False) -> Callable[[Any], str]:  # noqa: FBT001, FBT002
        return _shown


def _is_missing(cell: object) -> bool:
    return cell is None or cell is pd.NA or (isinstance(cell, float) and cell != cell)  # noqa: PLR0124


def _tight(rows: Ragged) -> Ragged:
    """The rows over no more elements than they use."""
    used = int(np.maximum(rows.length, 0).sum())
    if used >= len(rows.values):
        return rows
    values, offset = rows.compact()
    return Ragged(values, offset[:-1], rows.length)


def _equal(one: Ragged, other: Ragged) -> NDArray[np.bool_]:
    if len(one) != len(other):
        raise ValueError("Lengths must match to compare")
    same: NDArray[np.bool_] = (one.length == other.length) & (one.length >= 0)
    rows = np.flatnonzero(same)
    left, offset = one.take(rows).compact()
    right = other.take(rows).compact()[0]
    wrong = np.flatnonzero(left != right)
    same[rows[np.searchsorted(offset, wrong, side="right") - 1]] = False
    return same


def _shown(cell: Any) -> str:
    """A cell in a line: `[0.1 0.2 0.3 … n=1081]`."""
    if not isinstance(cell, np.ndarray):
        return "None" if cell is None else str(cell)
    plain = cell.dtype.kind in "mM"
    head = [str(value) if plain else f"{value:g}" for value in cell[:_SHOWN]]
    if len(cell) > _SHOWN:
        head.append(f"… n={len(cell)}")
    return f"[{' '.join(head)}]"
