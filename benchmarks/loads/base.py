"""A load: the channels, when each message is due, and the payloads in one file."""

from __future__ import annotations

import json
import mmap
from base64 import b64decode, b64encode
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import asdict

from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

PAYLOADS = "payloads.bin"
_COLUMNS = "columns.npz"
_ABOUT = "load.json"


@dataclass(frozen=True, slots=True, eq=False)
class Load:
    """Messages to be published, in the order in which they are due.

    Rows may share a payload: a stream of many messages needs a file of only a few.

    Attributes:
        seed: From which it was made.
        channels: One a topic.
        channel: int32[n], index into `channels`.
        due: int64[n], ns after the start, ascending.
        log_time: int64[n], ns since the epoch: what the log says, or would have said.
        offset: int64[n], byte in the payload file.
        length: int64[n], bytes of the payload.
        payloads: The payload file.
    """

    seed: int
    channels: tuple[Channel, ...]
    channel: NDArray[np.int32]
    due: NDArray[np.int64]
    log_time: NDArray[np.int64]
    offset: NDArray[np.int64]
    length: NDArray[np.int64]
    payloads: Path

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.due)

    @property
    def payload_bytes(self) -> int:
        """Sum of all payload lengths."""
        return int(self.length.sum())

    @property
    def duration_s(self) -> float:
        """Seconds from the start until the last message is due."""
        return float(self.due[-1]) / 1e9 if len(self) else 0.0

    def map(self) -> memoryview:
        """The payload file, mapped."""
        with self.payloads.open("rb") as stream:
            return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))

    def save(self, directory: Path) -> None:
        """Write everything but the payload file, which must lie in `directory` already."""
        assert self.payloads == directory / PAYLOADS
        np.savez(
            directory / _COLUMNS,
            channel=self.channel,
            due=self.due,
            log_time=self.log_time,
            offset=self.offset,
            length=self.length,
        )
        about = {
            "seed": self.seed,
            "channels": [_channel_to_json(channel) for channel in self.channels],
        }
        (directory / _ABOUT).write_text(json.dumps(about, indent=1), encoding="utf-8")

    @classmethod
    def open(cls, directory: Path) -> Load:
        """A load that was saved."""
        about = json.loads((directory / _ABOUT).read_text(encoding="utf-8"))
        with np.load(directory / _COLUMNS) as columns:
            return cls(
                seed=about["seed"],
                channels=tuple(_channel_from_json(value) for value in about["channels"]),
                payloads=directory / PAYLOADS,
                **{name: columns[name] for name in columns.files},
            )


def _channel_to_json(channel: Channel) -> dict[str, Any]:
    value = {**asdict(channel), "metadata": dict(channel.metadata)}
    if channel.schema is not None:
        data = b64encode(channel.schema.data).decode("ascii")
        value["schema"] = {**asdict(channel.schema), "data": data}
    return value


def _channel_from_json(value: dict[str, Any]) -> Channel:
    schema = value.pop("schema")
    if schema is not None:
        schema = Schema(**{**schema, "data": b64decode(schema["data"])})
    return Channel(schema=schema, **value)


_BUFFER = 1 << 20

_Columns = tuple["NDArray[np.int32]", "NDArray[np.int64]", "NDArray[np.int64]", "NDArray[np.int64]"]


class Spool:
    """A load that is being written.

    Messages may come in any order. Payloads do not stay in memory, only 28 bytes a
    message do.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._at = 0
        self._columns: list[_Columns] = []
        self._file = (directory / PAYLOADS).open("wb", buffering=_BUFFER)

    def messages(
        self,
        channel: NDArray[np.int32],
        payloads: Iterable[bytes | memoryview],
        log_time: NDArray[np.int64],
    ) -> None:
        """Add messages of any length."""
        length = np.fromiter(map(self._file.write, payloads), np.int64, len(log_time))
        ends = self._at + np.cumsum(length)
        self._at += int(length.sum())
        if len(log_time):
            columns = (channel.astype(np.int32), log_time.astype(np.int64), ends - length, length)
            self._columns.append(columns)

    def finish(
        self,
        seed: int,
        channels: Sequence[Channel],
    ) -> Load:
        """Order what was added by log time, and save it.

        A message is due as long after the first one as its log time is after that of the
        first one. Of equal log times, the one that was added first comes first.
        """
        self._file.close()
        channel, log_time, offset, length = (
            np.concatenate(parts) for parts in zip(*self._columns, strict=True)
        )
        order = np.argsort(log_time, kind="stable")
        due = log_time[order] - log_time[order[0]]
        load = Load(
            seed=seed,
            channels=tuple(channels),
            channel=channel[order],
            due=due,
            log_time=log_time[order],
            offset=offset[order],
            length=length[order],
            payloads=self._directory / PAYLOADS,
        )
        load.save(self._directory)
        return load
