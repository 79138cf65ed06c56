"""Writes a load: payloads to the flat file as they come, columns at the end."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.loads.base import PAYLOADS, Load

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel

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
