"""Arrays over the bytes of a message, which are checked first."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_EMPTY: Final = 1 << 31
"""Greatest size of an empty array beside a size of zero."""


def byte_array(data: Any) -> NDArray[np.uint8]:
    """The bytes of a uint8 sequence, as a view if it is an array or a buffer.

    Text is base64, as in JSON.
    """
    if isinstance(data, str):
        data = base64.b64decode(data, validate=True)
    if isinstance(data, (bytes, bytearray, memoryview)):
        return np.frombuffer(data, np.uint8)
    if isinstance(data, list):
        return np.asarray(data, np.uint8)
    return np.ascontiguousarray(data).view(np.uint8).reshape(-1)


def check_rows(what: str, shape: tuple[int, int], row: int, step: int, size: int) -> None:
    """Check that rows of `row` bytes, `step` bytes apart, lie within `size` bytes."""
    height, width = shape
    if height < 0 or width < 0:
        raise PayloadError(f"{what} cannot have {width} columns and {height} rows")
    if height and step < row:
        raise PayloadError(f"{what} has rows of {step} bytes, and {width} columns need {row}")
    if height and width and (height - 1) * step + row > size:
        raise PayloadError(
            f"{what} of {width} x {height} needs {(height - 1) * step + row} bytes and has {size}"
        )


def view_of(
    data: NDArray[np.uint8],
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    strides: tuple[int, ...],
) -> NDArray[Any]:
    """An array over `data`; `check_rows` has checked that it lies inside."""
    if 0 in shape:
        # If one size is zero, the others are unchecked; numpy refuses those it cannot multiply.
        return np.empty(tuple(min(size, MAX_EMPTY) for size in shape), dtype)
    array: NDArray[Any] = np.ndarray(shape, dtype, data.data, 0, strides)
    return array
