"""A store in a bucket as a place that recordings are copied to.

A file becomes one object, which is created when its last byte has arrived. Nobody there reads
it, so it is checked here before it is sent. What a cut has left is found by the next attempt,
and not sent again. The next list names all of a recording: only from then on is it in the store.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.columns.folders import Addition, TableFolders, files_of
from hybridlog.columns.layout import IN_TYPE, SHARED, SUFFIX
from hybridlog.entries import describe, take_inventory
from hybridlog.maintenance.opening import open_catalog
from hybridlog.maintenance.places import (
    Begun,
    Copied,
    CopiedFile,
    RefusedError,
    adopted_line,
    check_proven,
    content_of,
    copied_of,
    pieces_of,
    problems_of,
)
from hybridlog.schema.states import expired_messages
from hybridlog_storage import journal
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import PAYLOADS
from hybridlog_storage.errors import ObjectExistsError, StoreError, unreadable
from hybridlog_storage.journal import JOURNAL
from hybridlog_storage.remote import TRIES
from hybridlog_storage.remote.bucket import Upload, path_of
from hybridlog_storage.remote.lists import RECORDINGS, TABLES, ListedRecording
from hybridlog_storage.segments.segment_file import sealed_name

if TYPE_CHECKING:
    from hybridlog.columns.tables import Tables
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.journal import JournalState
    from hybridlog_storage.messages import Buffer
    from hybridlog_storage.remote.bucket import Object
    from hybridlog_storage.remote.store import RemoteDirectory

_PIECE: Final = 1 << 20


class BucketPlace:
    """A store in a bucket: as of `Place`.

    Args:
        target: The store.
        catalog: The catalog of the store that is copied from, with what decoding found out.
        tables: The fields in that store.
    """

    proves = False

    def __init__(self, target: RemoteDirectory, catalog: Catalog, tables: Tables) -> None:
        self.name = target.place
        self._target = target
        self._catalog = catalog
        self._tables = tables
        self._own = open_catalog(target)
        self._recording = ""
        self._there: dict[str, Object] = {}  # by path below the recording
        self._proven: dict[str, CopiedFile] = {}
        self._upload: Upload | None = None

    def sees(self, mark: str) -> bool:
        """As of `Place`."""
        return False

    def have(self, recordings: Sequence[str]) -> dict[str, Copied]:
        """As of `Place`; what has lost objects lacks payloads."""
        self._target.refresh()
        labels = self._target.labels_by_id()
        return {one: self._copied(labels[one], one) for one in recordings if one in labels}

    def _copied(self, label: str, recording: str) -> Copied:
        self._target.source.compare(recording)
        row = self._own.recording(recording)
        if row is None or expired_messages(row[1]):
            found = copied_of(self._target, label)
        else:
            found = Copied(label, content=content_of(_digests(row[1])))
        return replace(found, lacks_payloads=True) if self._target.is_damaged(label) else found

    def segments(self, recording: str) -> dict[int, str]:
        """As of `Place`."""
        row = self._own.recording(recording)
        return {} if row is None else _digests(row[1])

    def begin(self, recording: str, *, wants_payloads: bool) -> Begun:
        """As of `Place`."""
        self.leave()
        known = self.have([recording]).get(recording)
        listed: set[str] = set()
        if known is not None:
            if not (known.lacks_payloads and wants_payloads):
                return Begun(known)
            listed = {one.name for one in self._target.files_of(known.label).values()}
        self._recording = recording
        bucket, folder = self._target.source.bucket, f"{RECORDINGS}/{recording}/"
        for one in sorted(bucket.objects(folder), key=lambda one: one.modified):
            if one.name in listed or bucket.is_young(one):
                self._there[path_of(one.name[len(folder) :])] = replace(one, modified=0)
        sizes = {path.removeprefix(f"{PAYLOADS}/"): o.size for path, o in self._there.items()}
        return Begun(sizes=sizes)

    def digest(self, file: CopiedFile, length: int) -> str:
        """As of `Place`, but for the kind of digest; empty if it has another length."""
        about = self._there[_path(file)]
        return self._target.source.bucket.digest(about) if about.size == length else ""

    def append(self, file: CopiedFile, at: int, data: Buffer) -> None:
        """As of `Place`; from the first byte on."""
        if at == 0 or self._upload is None:
            name = f"{RECORDINGS}/{self._recording}/{_path(file)}"
            self._upload = Upload(self._target.source.bucket, name, file.bytes)
        self._upload.write(data)

    def prove(self, file: CopiedFile) -> bool:
        """True if it has arrived as a whole: it was checked before it was sent."""
        if self._upload is not None:
            upload, self._upload = self._upload, None
            self._there[_path(file)] = upload.close()
        about = self._there.get(_path(file))
        if about is None or about.size != file.bytes:
            return False
        self._proven[file.file] = file
        return True

    def publish(self, label: str, lines: bytes, *, lacks_payloads: bool) -> str:
        """As of `Place`."""
        target, recording, state = self._target, self._recording, journal.parse(lines)
        check_proven(state, recording, self._proven)
        found = {_path(file): self._there[_path(file)] for file in self._proven.values()}
        lines += journal.encode(adopted_line(target, state, lacks_payloads=lacks_payloads))
        row = self._catalog.recording(recording)
        entry = None if row is None else row[1]
        fields = {} if entry is None else self._bring_fields(entry)
        for _ in range(TRIES):
            with suppress(ObjectExistsError), target.changing():
                known = self.have([recording]).get(recording)
                there = {} if known is None else target.files_of(known.label)
                if known is not None and not known.lacks_payloads:  # another process was faster
                    # Of large files the last one to come replaced what the other one had sent.
                    newer = {path: o for path, o in found.items() if _replaces(o, there.get(path))}
                    listed = {**there, **newer}
                else:
                    bucket, name = target.source.bucket, f"{RECORDINGS}/{recording}/{JOURNAL}"
                    listed = {**self._kept(there, state), **found}
                    listed[JOURNAL] = bucket.create_beside(name, lines)
                label = known.label if known is not None else target.free_label(label)
                if listed != there:
                    target.add_recording(label, ListedRecording(recording, listed), fields)
                    self._describe(label, entry)
                self.leave()
                return label
        raise StoreError(f"{self.name} changes all the time. Copy again.")

    def _kept(self, there: Mapping[str, Object], state: JournalState) -> dict[str, Object]:
        """What was added there to a recording: lines of its journal, and segments of marks.

        Raises:
            RefusedError: It was marked here, too.
        """
        notes = {path: one for path, one in there.items() if path.startswith(f"{JOURNAL}.")}
        added = self._target.source.read([one for _, one in sorted(notes.items())])
        marks = {
            line["segment"]
            for _, line in journal.read_lines(added)
            if line is not None and line["event"] == journal.SEALED
        }
        if marks & state.sealed.keys():
            raise RefusedError(
                f"Recording {state.name!r} was marked here and in {self.name}, where it lacks "
                "payloads: note the mark there, `hybridlog mark --remove` it, copy again, and set "
                "it again."
            )
        names = {sealed_name(number) for number in marks} & there.keys()
        return {**notes, **{name: there[name] for name in names}}

    def _describe(self, label: str, entry: RecordingEntry | None) -> None:
        """Make the row of the catalog from what is there, as it is read back."""
        if entry is not None:  # what decoding found out, too
            found = []
            for number, digest in _digests(entry).items():
                rows = self._catalog.decoded_table(entry, number)[1]
                if rows is not None:
                    found.append((number, digest, rows))
            self._own.put_stamps(entry.id, found)
            self._own.put_damage(entry.id, self._catalog.damage(entry.id))
        inventory = take_inventory(self._target, label)
        if inventory.misfits or not inventory.is_proven:
            raise StoreError(f"What was copied of recording {label!r} does not fit together.")
        self._own.put(describe(self._own, inventory))

    def hold(self) -> bool:
        """True: what a list names is not deleted, and the list after it is another state."""
        return True

    def drop(self) -> None:
        """As of `Place`; objects that no list names go when the bucket is tidied."""
        self.leave()

    def leave(self) -> None:
        """As of `Place`."""
        self._recording, self._upload = "", None
        self._there.clear()
        self._proven.clear()

    def problems(self, recording: str) -> list[str]:
        """As of `Place`."""
        return problems_of(self._target, self._target.labels_by_id().get(recording))

    def _bring_fields(self, entry: RecordingEntry) -> dict[str, Object]:
        """Create the objects of a recording's fields; each file has no other recording."""
        found: dict[str, Object] = {}
        with tempfile.TemporaryDirectory(prefix="hybridlog-") as place:
            for folder, paths in self._fields(entry, Path(place)).items():
                for number, path in enumerate(paths):
                    name = f"{folder}/{entry.id}-{number}{SUFFIX}"
                    found[name] = self._sent(path, f"{TABLES}/{name}")
        return found

    def _sent(self, path: Path, name: str) -> Object:
        try:
            size = files.status(path, depth=IN_TYPE).st_size
        except OSError as error:
            raise unreadable(error, path) from error
        upload = Upload(self._target.source.bucket, name, size)
        for piece in pieces_of(path, 0, size, _PIECE, depth=IN_TYPE):
            upload.write(piece)
        return upload.close()

    def _fields(self, entry: RecordingEntry, root: Path) -> Mapping[str, Sequence[Path]]:
        """Files with its fields by folder; of shared ones its rows alone, below `root`."""
        found: dict[str, list[Path]] = {}
        for file, begin, section in self._tables.sections_of(entry):
            folder = file.path.parent.name
            if not section.segments.items() <= entry.digests.items():
                continue  # they are of what it was before
            if not file.path.name.startswith(SHARED):
                found.setdefault(folder, []).append(file.path)
                continue
            with suppress(StoreError):  # what is damaged is left out: messages answer, too
                rows = file.table().slice(begin, section.rows)
                TableFolders(root, entry.id).add({folder: Addition(rows, section)})
        for reader in files_of(root):
            found.setdefault(reader.path.parent.name, []).append(reader.path)
        return found


def _path(file: CopiedFile) -> str:
    """The path of a file below its recording."""
    return file.below(Path()).as_posix()


def _digests(entry: RecordingEntry) -> dict[int, str]:
    return {int(number): digest for number, digest in entry.digests.items()}


def _replaces(one: Object, other: Object | None) -> bool:
    return other is not None and other.name == one.name and other.version != one.version
