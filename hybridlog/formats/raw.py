"""Writes one file a message: unchanged payloads here, pictures in `pictures`.

The directory holds `index.jsonl`, with a line for each message (file, topic, type, times,
sequence, length). Each topic has a directory with files `<log time in ns>.bin`. A second
message of the same nanosecond is `<log time>-1.bin`. Topic directories are named like the
index's collections, so no topic leads outside and no two share a directory. On a stream the
payloads follow each other without separators.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from hybridlog.formats.answer import Answer
from hybridlog.formats.writing import Sink, Target, Whole, failures, new_directory
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
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
