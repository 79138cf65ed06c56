"""The state of a running recorder, in a file of the store that it replaces once a second.

Other processes read the file. A recorder runs as long as its recording is locked.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct, field

from hybridlog.record.losses import Cause
from hybridlog_storage.disk import files
from hybridlog_storage.errors import HybridlogError, StoreError, UsageError
from hybridlog_storage.stopping import pause

if TYPE_CHECKING:
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import Manifest

_FOLDER: Final = "recorders"
_SUFFIX: Final = ".json"
_MAX_BYTES: Final = 1 << 26


class RecorderState(Struct, frozen=True):
    """State of a recorder at one time; `docs/live.md` says what each field is."""

    name: str
    elapsed_s: float
    topics: Sequence[TopicState]
    messages: int
    stored: int
    lost: Mapping[str, int]
    filled: float
    lag: int
    index_failure: str
    free_bytes: int
    stored_bytes: int
    stalled_s: float = 0.0
    incidents: int = 0
    let_go: int | None = None
    taken: Mapping[str, int] = field(default_factory=dict)
    silent: Sequence[str] = ()
    breaches: int = 0
    clock_set_s: float = 0.0
    sim_time: int | None = None
    hz: float = 0.0
    bytes_per_s: float = 0.0


class StateFile:
    """The file with the state of a recorder.

    Files that killed recorders have left are removed.
    """

    def __init__(self, directory: StoreDirectory, recording: str) -> None:
        self._path = _path(directory.path, recording)
        self._over = False
        with suppress(OSError, HybridlogError):
            for file in files.names(self._path.parent):
                other = file.removesuffix(_SUFFIX)
                if other != file and not directory.is_recorded(other):
                    files.unlink(self._path.parent / file)

    def write(self, state: RecorderState) -> None:
        """Replace it, until it is removed; on a full disk the last one stays."""
        if self._over:
            return
        with suppress(OSError):
            with suppress(FileExistsError):
                files.make_folder(self._path.parent)
            files.write_file(self._path, msgspec.json.encode(state), sync=False)

    def remove(self) -> None:
        """Remove it: the recorder ends."""
        self._over = True
        with suppress(OSError):
            files.unlink(self._path)


def read(store: Path, recording: str) -> RecorderState:
    """The last state of a recorder, by the id of its recording.

    Raises:
        StoreError: It has just begun or ended, or the file is damaged.
    """
    try:
        content = files.read_file(_path(store, recording), _MAX_BYTES)
        return msgspec.json.decode(content, type=RecorderState)
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(f"The recorder of {recording} has not said how it is.") from error


def running(directory: StoreDirectory) -> dict[str, str]:
    """Names of the recordings that recorders write, by their ids, in the order of their start."""
    found: list[Manifest] = []
    with suppress(OSError):
        for file in files.names(directory.path / _FOLDER):
            recording = file.removesuffix(_SUFFIX)
            # A recorder that was killed leaves its file behind.
            with suppress(HybridlogError):
                if directory.is_recorded(recording):
                    found.append(directory.manifests.read(recording))
    return {one.id: one.name for one in sorted(found, key=attrgetter("created"))}


def states(directory: StoreDirectory, recording: str, every_s: float) -> Iterator[RecorderState]:
    """Poll the state of a recorder until it ends."""
    while directory.is_recorded(recording):
        started = time.monotonic()
        with suppress(StoreError):  # it has just started
            yield read(directory.path, recording)
        pause(max(every_s - (time.monotonic() - started), 0))


def choose(directory: StoreDirectory, named: Sequence[str]) -> list[str]:
    """The ids of recordings that recorders write, by ids or names; without names, the only one.

    UsageError if no recorder runs, or a name fits none, or none is named of several.
    """
    names = running(directory)
    if not names:
        raise UsageError("No recorder runs on this store; start one with `hybridlog record`.")
    unknown = [name for name in named if name not in {*names, *names.values()}]
    if unknown or (not named and len(names) > 1):
        what = f"{unknown[0]!r} is no running recorder" if unknown else "Several recorders run"
        raise UsageError(f"{what}: name one of {', '.join(names.values())}.")
    return [one for one, known in names.items() if not named or {one, known} & {*named}]


def _path(store: Path, recording: str) -> Path:
    return store / _FOLDER / f"{recording}{_SUFFIX}"


_NS = 1e9


class Tally(Struct):
    """Counters of one channel; one thread at a time updates them. Times in ns."""

    messages: int = 0
    payload_bytes: int = 0
    last: int = 0

    def add(self, size: int, received: int) -> None:
        """Count a message."""
        self.last = received
        self.messages += 1
        self.payload_bytes += size


class TopicState(Struct, frozen=True):
    """Statistics of a topic at one time."""

    topic: str
    type: str
    messages: int
    payload_bytes: int
    hz: float
    bytes_per_s: float
    silent_s: float | None
    thinned: int
    lost: int


class TopicCounts(Struct):
    """Counts of messages of a topic that were received and lost."""

    topic: str
    type: str = ""
    is_present: bool | None = None  # has publishers; None: has never had any
    tallies: list[Tally] = field(default_factory=list)
    lost: Counter[str] = field(default_factory=Counter)
    _messages: int = 0
    _bytes: int = 0

    @property
    def has_come(self) -> bool:
        """True if it has had publishers or messages; not of what is lost alone."""
        return bool(self.tallies) or self.is_present is not None

    def look(self, elapsed_s: float, now: int) -> TopicState:
        """The topic's statistics since the last call."""
        messages = sum(tally.messages for tally in self.tallies)
        size = sum(tally.payload_bytes for tally in self.tallies)
        hz = (messages - self._messages) / elapsed_s
        rate = (size - self._bytes) / elapsed_s
        self._messages, self._bytes = messages, size
        last = max((tally.last for tally in self.tallies), default=0)
        thinned = self.lost[Cause.THROTTLE]
        return TopicState(
            self.topic,
            self.type,
            messages,
            size,
            hz,
            rate,
            max(now - last, 0) / _NS if last else None,
            thinned,
            sum([*self.lost.values()]) - thinned,
        )
