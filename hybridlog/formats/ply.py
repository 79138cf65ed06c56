"""Writes point clouds and scans as PLY, a file a message, binary, with all fields."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.arrays.message_arrays import to_numpy
from hybridlog.arrays.point_arrays import point_columns, positions
from hybridlog.formats.raw import Directory
from hybridlog.formats.writing import path_of
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.formats.answer import Answer
    from hybridlog.formats.writing import Target
    from hybridlog.schema.codec import Codec
    from hybridlog_storage.messages import Channel

_TYPES: Final = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
"""Names of PLY's numbers."""
_NO_WORD: Final = re.compile(r"\W", re.ASCII)


def write_ply(answer: Answer, target: Target) -> None:
    """Write a directory with a PLY file a message."""
    with Directory(path_of(target, "ply", "a directory")) as folder:
        for points, topic, kind, time in chain(answer.points, _points(answer)):
            about = {"topic": topic, "type": kind, "log_time_ns": time, "points": points.size}
            folder.add(ply_of(points), ".ply", about)


def _points(answer: Answer) -> Iterator[tuple[NDArray[Any], str, str, int]]:
    codecs: dict[Channel, Codec] = {}
    for batch, channels in answer.batches:
        for row in range(len(batch)):
            channel = channels[int(batch.channel[row])]
            if channel not in codecs:
                codecs[channel] = codec_for(channel)
            name = channel.schema.name if channel.schema else ""
            points = to_numpy(name, codecs[channel].decode(batch.payload(row)))
            yield points, channel.topic, name, int(batch.log_time[row])


def ply_of(points: NDArray[Any]) -> bytes:
    """A PLY file of records with `x`, `y` and `z`, or with `range` and `angle`, of any shape.

    Fields of several numbers become as many properties.
    """
    names = points.dtype.names or ()
    columns: dict[str, NDArray[Any]] = {}
    if "x" not in names and {"range", "angle"} <= set(names):
        place = positions(points).reshape(-1, 3).astype(points["range"].dtype)
        columns = dict(zip("xyz", place.T, strict=True))
    elif not {"x", "y", "z"} <= set(names):
        raise UsageError("ply takes clouds and scans: messages with points.")
    for name, values in point_columns(points).items():
        own = _NO_WORD.sub("_", name)
        while own in columns:
            own += "_"
        columns[own] = values
    types = [(name, _little(column.dtype)) for name, column in columns.items()]
    rows = np.empty(points.size, types)
    for name, column in columns.items():
        rows[name] = column
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {points.size}",
        *(f"property {_TYPES[kind.str[1:]]} {name}" for name, kind in types),
        "end_header\n",
    ]
    return "\n".join(lines).encode("ascii") + rows.tobytes()


def _little(kind: np.dtype[Any]) -> np.dtype[Any]:
    """The type of PLY for numbers; those of 64 bits become doubles."""
    return kind.newbyteorder("<") if kind.str[1:] in _TYPES else np.dtype("<f8")
