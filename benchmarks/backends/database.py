"""What the backends that keep decoded messages have in common."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.backends.base import Backend
from benchmarks.backends.conversion import Converter, converter_for

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel, Schema


def schema_of(channel: Channel) -> Schema:
    """The definition of a channel's messages: all loads have them."""
    assert channel.schema is not None
    return channel.schema


class DatabaseBackend(Backend):
    """A backend whose messages are decoded first."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._channels: Sequence[Channel] = ()
        self._converters: list[Converter] = []

    def _take_channels(self, channels: Sequence[Channel]) -> None:
        """Compile the decoders, so that no message has to wait for that."""
        self._channels = channels
        self._converters = [converter_for(schema_of(channel)) for channel in channels]

    def _topics(self) -> dict[str, list[tuple[str, ...]]]:
        """Topics in order, and the groups of fields to be indexed in each."""
        found: dict[str, list[tuple[str, ...]]] = {}
        for channel, converter in zip(self._channels, self._converters, strict=True):
            groups = found.setdefault(channel.topic, [])
            groups.extend(group for group in converter.indexed if group not in groups)
        return found
