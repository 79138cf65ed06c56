"""Writes one file a message: unchanged payloads, pictures, or points as PLY (binary, all fields).

The directory holds `index.jsonl`, with a line for each message (file, topic, type, times,
sequence, length). Each topic has a directory with files `<log time in ns>.bin`. A second
message of the same nanosecond is `<log time>-1.bin`. Topic directories are named like the
index's collections, so no topic leads outside and no two share a directory. On a stream the
payloads follow each other without separators. A single picture may be a stream or a file.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from hybridlog.arrays.message_arrays import point_columns, positions
from hybridlog.drawing.images import Picture, picture
from hybridlog.formats.writing import Answer, Sink, Target, Whole, failures, new_directory, path_of
from hybridlog_storage.errors import DefinitionError, PayloadError, UsageError
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog_storage.messages import Buffer

INDEX = "index.jsonl"
"""The file that describes each file. No topic's directory has a dot."""
PICTURE_SUFFIXES = (".jpg", ".png", ".webp", ".gif", ".avif", ".bmp", ".tif", ".jp2", ".jxl")


def write_raw(answer: Answer, target: Target) -> None:
    """Write a directory of payloads for a path, consecutive payloads for a stream."""
    if not isinstance(target, str | os.PathLike):
        with Sink(target) as sink:
            for batch, _ in answer.batches:
                for row in range(len(batch)):
                    sink.write(batch.payload(row))
        return
    with Directory(target) as folder:
        for batch, channels in answer.batches:
            for row in range(len(batch)):
                channel = channels[int(batch.channel[row])]
                about = {
                    "topic": channel.topic,
                    "type": channel.schema.name if channel.schema else "",
                    "encoding": channel.message_encoding,
                    "log_time_ns": int(batch.log_time[row]),
                    "publish_time_ns": int(batch.publish_time[row]),
                    "sequence": int(batch.sequence[row]),
                    "length": int(batch.length[row]),
                }
                folder.add(batch.payload(row), ".bin", about)


class Directory(Whole):
    """A directory with a file a message."""

    def __init__(self, target: str | os.PathLike[str]) -> None:
        self._name = os.fspath(target)
        with failures(self._name):
            self._final, self._unfinished = new_directory(target, "messages go into a directory")
            self._temporary = self._unfinished.path
            self._index = (self._temporary / INDEX).open("x", encoding="ascii")
        self._last: dict[str, tuple[int, int]] = {}

    def add(self, data: Buffer, suffix: str, about: Mapping[str, object]) -> None:
        """Write a file named by `topic` and `log_time_ns` of `about`, its line of the index.

        The suffix has its dot.
        """
        with failures(self._name):
            name = self._write(str(about["topic"]), int(str(about["log_time_ns"])), suffix, data)
            self._index.write(json.dumps({"file": name, **about}) + "\n")

    def _write(self, topic: str, log_time: int, suffix: str, data: Buffer) -> str:
        folder = collection_of(topic)
        last, number = self._last.get(folder, (-1, 0))
        if folder not in self._last:
            (self._temporary / folder).mkdir()
        number = number + 1 if last == log_time else 0
        while True:
            name = f"{folder}/{log_time}{f'-{number}' if number else ''}{suffix}"
            try:
                file = (self._temporary / name).open("xb")
            except FileExistsError:  # the same time again, after other times
                number += 1
                continue
            with file:
                file.write(data)
            self._last[folder] = (log_time, number)
            return name

    def commit(self) -> None:
        """Sync, and give the directory its name."""
        with failures(self._name):
            self._index.close()
            # One sync for all: thousands of separate ones take minutes on a slow disk.
            os.sync()
            self._unfinished.publish(self._final)

    def abort(self) -> None:
        """Remove the directory."""
        with suppress(OSError):
            self._index.close()
        self._unfinished.remove()


_Form = Literal["png", "jpg"]


def _write(form: _Form, answer: Answer, target: Target) -> None:
    """Write one image to a stream or a name with the suffix of one; else a directory."""
    suffix = suffix_of(target) if isinstance(target, str | os.PathLike) else None
    if suffix is None and isinstance(target, str | os.PathLike):
        with Directory(target) as folder:
            for message, made in _pictures(form, answer):
                about = {
                    "topic": message.topic,
                    "type": message.type,
                    "media_type": made.media_type,
                    "recording": message.recording,
                    "log_time_ns": message.log_time_ns,
                    "publish_time_ns": message.publish_time_ns,
                    "sequence": message.sequence,
                    "length": len(made.data),
                }
                folder.add(made.data, made.suffix, about)
        return
    with Sink(target) as sink:
        for _, made in _pictures(form, answer):
            if sink.tell():
                raise UsageError(
                    "There are several images: name a directory for them, without a suffix, or "
                    "choose one with --at or --limit 1."
                )
            if suffix not in {None, made.suffix}:
                raise UsageError(
                    f"The image is {made.media_type}: end the name of the file in {made.suffix}, "
                    f"not {suffix}."
                )
            sink.write(made.data)
        if not sink.tell():
            raise UsageError("There is no image in this answer.")


def _pictures(form: _Form, answer: Answer) -> Iterator[tuple[Message, Picture]]:
    for message in answer.messages:
        try:
            made = picture(message, form=form)
        except (PayloadError, DefinitionError) as error:
            answer.unreadable.append(error)
        else:
            yield message, made


def suffix_of(target: str | os.PathLike[str]) -> str | None:
    """The suffix that an image must have for a file of that name; None for a directory."""
    suffix = Path(target).suffix.lower()
    suffix = {".jpeg": ".jpg", ".tiff": ".tif"}.get(suffix, suffix)
    return suffix if suffix in PICTURE_SUFFIXES else None


write_png: Final = partial(_write, "png")
write_jpg: Final = partial(_write, "jpg")


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
        for points, topic, kind, time in answer.points:
            about = {"topic": topic, "type": kind, "log_time_ns": time, "points": points.size}
            folder.add(ply_of(points), ".ply", about)


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
