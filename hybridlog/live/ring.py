"""A ring: of a recording that goes on, groups of files go that ended longer ago than a time.

The time is what has passed, never that of a clock. A group stays while a pin touches it; a file
stays while it has the latched messages that a late subscriber would receive.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Collection, Hashable
from typing import TYPE_CHECKING, Final

from hybridlog.maintenance.expiry import let_go
from hybridlog.maintenance.retention import is_pinned
from hybridlog.query.latching import depth_of, publisher_of

if TYPE_CHECKING:
    from hybridlog.follow.child import FollowerProcess
    from hybridlog.live.recording import LiveRecording
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import File, Manifest

GROUPS: Final = 10
"""Groups of files in the time of a ring, about."""
_LATE_S: Final = 1.0  # a signal may come so long after what it is about


class Ring:
    """Lets the oldest groups of a recording go, once triggers have seen them."""

    def __init__(
        self,
        directory: StoreDirectory,
        recording: LiveRecording,
        span_s: float,
        follower: FollowerProcess | None = None,
    ) -> None:
        self.messages = 0
        self._directory = directory
        self._recording = recording
        self._span_s = span_s + _LATE_S
        self._follower = follower
        self._seen = 0
        self._ended: dict[int, float] = {}  # when each group was first seen sealed
        self._files: dict[int, set[int]] = {}  # their numbers, by group
        self._kept: set[int] = set()  # must stay, as long as no other group is sealed

    def due(self, now: float) -> set[int]:
        """The groups whose time is over."""
        sealed = self._recording.sealed
        if sealed != self._seen:
            logs = self._directory.manifests.read(self._recording.id).logs.values()
            seen = time.monotonic()
            self._ended = {log.group: self._ended.get(log.group, seen) for log in logs}
            self._files = defaultdict(set)
            for log in logs:
                self._files[log.group].add(log.number)
            self._seen, self._kept = sealed, set()
        old = {group for group, at in self._ended.items() if now - at >= self._span_s}
        judged = None if self._follower is None else self._follower.judged
        if judged is not None:
            old = {group for group in old if self._files[group].issubset(judged)}
        return old - self._kept

    def let_go(self, groups: Collection[int]) -> None:
        """Delete the files of some groups, except those that must stay.

        Raises:
            StoreError: The manifest cannot be changed, or a file cannot be deleted.
        """
        changed = let_go(self._directory, self._recording.id, lambda now: self._going(now, groups))
        self._kept.update(groups)  # what is left of them stays, until another group is sealed
        self.messages = 0 if changed.let_go is None else changed.let_go.messages

    def _going(self, now: Manifest, groups: Collection[int]) -> list[File]:
        logs = [log for log in now.logs.values() if log.group in groups]
        pinned = {log.group for log in logs if is_pinned(log, now)}
        in_force = self._in_force(now)
        return [
            file
            for file in now.files
            if file.group in groups and file.group not in pinned and file.number not in in_force
        ]

    def _in_force(self, now: Manifest) -> set[int]:
        """Numbers of the files with latched messages that no later ones have replaced."""
        found: set[int] = set()
        newer: Counter[Hashable] = Counter()
        for number, log in sorted(now.logs.items(), reverse=True):
            came: Counter[Hashable] = Counter()
            for one, part in log.parts.items():
                channel = self._recording.capture.writer.channels.get(one)
                depth = 0 if channel is None else depth_of(channel)
                if channel is not None and depth and part.messages:
                    publisher = publisher_of(channel)
                    came[publisher] += part.messages
                    if newer[publisher] < depth:
                        found.add(number)
            newer += came
        return found
