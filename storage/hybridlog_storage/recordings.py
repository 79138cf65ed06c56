"""The recordings of a store in a directory: how they begin, grow, end, and are brought up to date.

A file is listed by its manifest once it is complete under its final name. A complete log that no
manifest lists is valid as well: its recorder was killed, or the disk too full to say so. Whoever
may write the recording next lists it, and seals what was left open.
"""

from __future__ import annotations

import re
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, cast

from blake3 import blake3
from msgspec import convert

from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import (
    HybridlogError,
    RecordingGoneError,
    SegmentError,
    StoreError,
    unreadable,
)
from hybridlog_storage.manifest import (
    Channel,
    File,
    Loss,
    Manifest,
    Part,
    Source,
    free_name,
    loss_of,
    new_id,
    replace,
    with_totals,
)
from hybridlog_storage.manifests import DiskManifests
from hybridlog_storage.schemas import Schemas
from hybridlog_storage.segments.recovery import recover_segment
from hybridlog_storage.segments.segment_file import OPEN_SUFFIX, sealed_channels
from hybridlog_storage.segments.segment_format import channel_record
from hybridlog_storage.segments.segment_reader import SegmentReader, SegmentSummary

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
    from pathlib import Path

Change: TypeAlias = "Callable[[Manifest], Manifest]"
"""Makes the new manifest of the newest one, perhaps several times."""
_RECORDINGS: Final = "recordings"
_LOG: Final = re.compile(r"[0-9]{6}\.mcap(\.open)?")
_PIECE: Final = 4 << 20  # bytes read at once
_RETRY_S: Final = 1.0  # after a change that failed


@dataclass(frozen=True, slots=True)
class Content:
    """The files of a recording, compared with its manifest.

    Attributes:
        open: Names of logs that were never sealed.
        unlisted: Names of sealed logs that the manifest does not list.
        missing: Listed files that are missing, or have another size.
        left_over: Names of files that were being written when somebody died.
    """

    open: Sequence[str]
    unlisted: Sequence[str]
    missing: Sequence[File]
    left_over: Sequence[str]


@dataclass(slots=True)
class Repaired:
    """What was done for a recording whose recorder was killed.

    Attributes:
        sealed: Names of logs that were sealed, or only listed.
        cut_bytes: Bytes that were cut off: records not yet whole.
        damage: What else was wrong, in words.
        is_removed: Whether the recording went, since it was empty or being removed.
    """

    sealed: list[str] = field(default_factory=list)
    cut_bytes: int = 0
    damage: list[str] = field(default_factory=list)
    is_removed: bool = False


@dataclass(frozen=True, slots=True)
class Log:
    """A complete log as a manifest lists it: the file, its channels, its losses, and the end."""

    file: File
    channels: Mapping[int, Channel]
    losses: Sequence[Loss]
    end: Mapping[str, Any] | None


class Recordings:
    """The recordings of a store in a directory.

    Args:
        path: The store.

    Attributes:
        manifests: What they are.
        schemas: Definitions of their messages.
    """

    def __init__(self, path: Path) -> None:
        self.manifests = DiskManifests(path)
        self.schemas = Schemas(path)
        self._path = path / _RECORDINGS

    def folder(self, recording: str) -> Path:
        """The folder of a recording."""
        return self._path / recording

    def begin(
        self,
        name: str,
        taken: Callable[[], Collection[str]],
        *,
        tags: Mapping[str, str] | None = None,
        source: Source | None = None,
    ) -> Manifest:
        """Begin a recording; its name gets a number if it is taken.

        Args:
            name: What people call it.
            taken: Returns the names of all recordings, while nobody else can begin one; it may
                raise to refuse this one.
            tags: Its tags.
            source: Where it comes from.

        Raises:
            HybridlogError: It cannot be written.
        """
        recording = new_id(name)
        with self.manifests.creating() as create:
            made = Manifest(
                recording,
                free_name(name, taken()),
                time.time_ns(),
                source=source or Source(),
                tags=dict(tags or {}),
            )
            create(made)
        return made

    def content(self, manifest: Manifest) -> Content:
        """Compare the files of a recording with its manifest.

        Raises:
            StoreError: They cannot be read.
        """
        folder = self.folder(manifest.id)
        try:
            found = files.names(folder)
        except FileNotFoundError:
            found = {}
        except OSError as error:
            raise unreadable(error, folder) from error
        listed = {file.name for file in manifest.files}
        logs = [name for name in sorted(found) if _LOG.fullmatch(name) and name not in listed]
        return Content(
            [name for name in logs if name.endswith(OPEN_SUFFIX)],
            [name for name in logs if not name.endswith(OPEN_SUFFIX)],
            [file for file in manifest.files if file.is_here and not _is_there(file, found)],
            [name for name in sorted(found) if name.startswith(".")],
        )

    def add(self, recording: str, name: str, digest: str = "") -> Manifest:
        """List a complete log of a recording.

        Args:
            recording: Its id.
            name: The name of the file.
            digest: BLAKE3 of its bytes; empty to work it out.

        Raises:
            SegmentError: The file is not whole, or of another recording.
            RecordingGoneError: The recording was removed.
            HybridlogError: The manifest cannot be written.
        """
        return self.manifests.change(recording, listing(self.log(recording, name, digest)))

    def log(self, recording: str, name: str, digest: str = "") -> Log:
        """What a manifest lists of a complete log; its definitions are in the store then.

        Raises:
            SegmentError: The file is not whole, or of another recording.
            HybridlogError: It cannot be read, or a definition cannot be stored.
        """
        number, path = int(name[:6]), self.folder(recording) / name
        with SegmentReader(path, number) as reader:
            summary, size = reader.summary(), reader.size
            self._check(summary, path, recording, number)
            digest = digest or _digest_of(reader)
        counts = sealed_channels(summary.table.as_stored(), summary.channels)
        file = File(
            number,
            number,
            name,
            "log",
            size,
            digest,
            time.time_ns(),
            min((one.first for one in counts), default=None),
            max((one.last for one in counts), default=None),
            {one.id: Part(one.messages, one.payload_bytes, one.first, one.last) for one in counts},
        )
        channels = {n: self._channel(n, summary) for n in summary.schema_ids}
        return Log(file, channels, [loss_of(row) for row in summary.losses], summary.end)

    def _check(self, summary: SegmentSummary, path: Path, recording: str, number: int) -> None:
        said = summary.recording.get("id"), summary.recording.get("segment")
        if said != (recording, number):
            raise SegmentError(f"{path} is file {said[1]} of recording {said[0]}.")

    def _channel(self, number: int, summary: SegmentSummary) -> Channel:
        channel = summary.channels[number]
        schema = channel.schema
        return Channel(
            channel.topic,
            channel.message_encoding,
            "" if schema is None else schema.name,
            "" if schema is None else self.schemas.put(schema),
            dict(channel_record(number, 0, channel).metadata),
        )

    def bring_up(self, recording: str) -> Repaired:
        """Seal and list what a killed recorder has left; the caller holds the recording.

        Raises:
            RecordingGoneError: There is no such recording.
            DiskFullError: There is no room; nothing is lost.
            HybridlogError: Something cannot be read or written.
        """
        done = Repaired()
        try:
            now = self.manifests.read(recording)
        except RecordingGoneError:
            self.manifests.remove(recording)  # finishes a removal, or says that there is none
            done.is_removed = True
            return done
        found = self.content(now)
        self._unlink(recording, found.left_over)
        names = [*found.unlisted]
        for name in found.open:
            names += self._seal(now, name, done)
        adopted = [self._adopted(now, name, done) for name in sorted(names)]
        logs = [log for log in adopted if log is not None]
        if not (logs or now.files) and now.status == "open":
            self.manifests.remove(recording)
            done.is_removed = True
        elif logs or now.status == "open":
            done.sealed = [log.file.name for log in logs]
            self.manifests.change(recording, lambda now: _brought_up(now, logs, done))
        return done

    def _seal(self, now: Manifest, name: str, done: Repaired) -> list[str]:
        """Seal an open log; its name then, unless nothing was in it."""
        said = {"id": now.id, "name": now.name, "tags": now.tags, "created": now.created}
        path = self.folder(now.id) / name
        result = recover_segment(path, recording={**said, "source": source_values(now.source)})
        done.cut_bytes += result.cut_bytes
        done.damage += result.damage
        return [] if result.path is None else [result.path.name]

    def _adopted(self, now: Manifest, name: str, done: Repaired) -> Log | None:
        """A sealed log that is not listed yet; one that is not whole is sealed once more."""
        try:
            return self.log(now.id, name)
        except SegmentError:
            path = self.folder(now.id) / name
            again = path.with_name(f"{name[:6]}{OPEN_SUFFIX}")
            try:
                files.rename(path, again)
            except OSError as error:
                raise durability.explain(error, path, "recovering") from error
            (left,) = self._seal(now, again.name, done) or [""]
            return self.log(now.id, left) if left else None

    def _unlink(self, recording: str, names: Iterable[str]) -> None:
        for name in names:
            path = self.folder(recording) / name
            try:
                files.remove_tree(path)
            except OSError as error:
                raise durability.explain(error, path, "removing") from error

    def restore(self, recording: str) -> Manifest:
        """Make a lost or damaged manifest again, of the one before and of the files.

        Returns:
            The manifest; the one that is there if it can be read.

        Raises:
            StoreError: Nothing says what recording it is.
            HybridlogError: It cannot be written.
        """

        def make(old: Manifest | None) -> Manifest:
            made = old or self._described(recording)
            found = self.content(made)
            for name in found.unlisted:
                with suppress(SegmentError):
                    made = listing(self.log(recording, name))(made)
            return replace(made, changes=made.changes + 1)

        return self.manifests.restore(recording, make)

    def _described(self, recording: str) -> Manifest:
        """What the logs of a recording say of it, without the files."""
        names = (name for name in sorted(files.names(self.folder(recording))))
        for name in names:
            if _LOG.fullmatch(name) and not name.endswith(OPEN_SUFFIX):
                with (
                    suppress(SegmentError, ValueError),
                    SegmentReader(self.folder(recording) / name, int(name[:6])) as reader,
                ):
                    said = reader.summary().recording
                    if said.get("id") == recording:
                        known = {key: said[key] for key in ("name", "created", "tags", "source")}
                        return convert({"id": recording, **known}, Manifest)
        raise StoreError(
            f"Nothing readable says which recording {recording} is. Restore its files, or remove "
            "the folder."
        )


class Changes:
    """Changes the manifest of a recording in progress, on a thread of its own.

    A change that fails is made again with the next one, and at the end: what it says is in the
    files as well.

    Args:
        manifests: Those of the store.
        recording: The recording's id.
    """

    def __init__(self, manifests: DiskManifests, recording: str) -> None:
        self._manifests = manifests
        self._recording = recording
        self._queue: SimpleQueue[Any] = SimpleQueue()
        self._failure: HybridlogError | None = None
        self._thread = threading.Thread(target=self._run, name="hybridlog-manifest", daemon=True)
        self._thread.start()

    def submit(self, how: Change) -> None:
        """Change the manifest soon, after the changes before this one."""
        self._queue.put(how)

    def close(self) -> None:
        """Return once all changes are made.

        Raises:
            RecordingGoneError: The recording was removed.
            HybridlogError: They cannot be made.
        """
        self._queue.put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        waiting: list[Change] = []
        is_over = False
        while not is_over:
            how = self._queue.get()
            is_over = how is None
            waiting += [] if how is None else [how]
            while not self._queue.empty():
                how = self._queue.get()
                is_over |= how is None
                waiting += [] if how is None else [how]
            if not waiting:
                continue

            def change(now: Manifest, all_of: Sequence[Any] = tuple(waiting)) -> Manifest:
                for one in all_of:
                    now = one(now)
                return now

            try:
                self._manifests.change(self._recording, change)
            except HybridlogError as error:
                self._failure = error
            else:
                self._failure = None
                waiting = []


def listing(log: Log) -> Change:
    """The change that lists a log, unless somebody else has done it."""

    def how(now: Manifest) -> Manifest:
        if any(file.name == log.file.name for file in now.files):
            return now
        channels = {**log.channels, **now.channels}
        losses = (*now.losses, *log.losses)
        files = (*now.files, log.file)
        return with_totals(replace(now, files=files, channels=channels, losses=losses))

    return how


def ending(
    status: Literal["complete", "damaged", "recovered"], losses: Iterable[Loss] = ()
) -> Change:
    """The change that ends a recording.

    Args:
        status: How it ended.
        losses: Those that no log says.
    """
    rows = tuple(losses)

    def how(now: Manifest) -> Manifest:
        if now.status != "open":
            return now
        return replace(now, status=status, losses=(*now.losses, *rows))

    return how


def _brought_up(now: Manifest, logs: Iterable[Log], done: Repaired) -> Manifest:
    last: Mapping[str, Any] | None = None
    for log in logs:
        now = listing(log)(now)
        last = log.end or last
    if now.status == "open":
        said = (last or {}).get("status")
        known = said if said in {"complete", "damaged"} else "recovered"
        status = cast("Literal['complete', 'damaged', 'recovered']", known)
        rows = (
            []
            if status == "recovered"
            else [loss_of(one) for one in (last or {}).get("losses", ())]
        )
        now = ending(status, rows)(now)
    return replace(
        now,
        cut_bytes=now.cut_bytes + done.cut_bytes,
        damage=(*now.damage, *(one for one in done.damage if one not in now.damage)),
    )


def source_values(source: Source) -> dict[str, Any]:
    """A source as logs describe it."""
    return {name: getattr(source, name) for name in source.__struct_fields__}


def _is_there(file: File, found: Mapping[str, os.stat_result]) -> bool:
    return file.name in found and found[file.name].st_size == file.bytes


def _digest_of(reader: SegmentReader) -> str:
    hasher = blake3()
    for at in range(0, reader.size, _PIECE):
        hasher.update(reader.read(at, min(_PIECE, reader.size - at)))
    return hasher.hexdigest()
