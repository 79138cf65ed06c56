"""A store in a bucket as a place that recordings are copied to.

A file becomes one object, which is created when its last byte has arrived. Nobody there reads
it, so it is checked here before it is sent. What a cut has left is found by the next attempt,
and not sent again. The next list names all of a recording: only from then on is it in the store.
"""

from __future__ import annotations

import platform
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.columns.folders import Addition, TableFolders, files_of
from hybridlog.columns.layout import SHARED, SUFFIX
from hybridlog.entries import describe, free_name_in, made_again, put_entry, take_inventory
from hybridlog.maintenance.copying import at_work
from hybridlog.maintenance.keep import pin_of
from hybridlog.maintenance.opening import is_at_work, open_catalog
from hybridlog.maintenance.places import (
    Begun,
    Copied,
    CopiedFile,
    CopiedSegment,
    RefusedError,
    content_of,
    copied_file,
    copied_of,
    digests_of,
    has_lost,
    manifest_of,
    marked_there,
    merged,
    pieces_of,
    problems_of,
    proven_manifest,
    segments_of,
)
from hybridlog.schema.states import expired_messages
from hybridlog_storage import manifest as truth
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import PAYLOADS, SENDING
from hybridlog_storage.errors import (
    HeldError,
    ManifestError,
    ObjectChangedError,
    ObjectExistsError,
    SegmentError,
    StoreError,
    unreadable,
)
from hybridlog_storage.manifest import Manifest, Mark, Note, encode, new_random
from hybridlog_storage.remote import TRIES
from hybridlog_storage.remote.bucket import Upload, other_name, path_of
from hybridlog_storage.remote.lists import MANIFEST, RECORDINGS, TABLES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from hybridlog.columns.tables import Tables
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.messages import Buffer
    from hybridlog_storage.remote.bucket import Object
    from hybridlog_storage.remote.store import RemoteDirectory

_PIECE: Final = 1 << 20


class BucketPlace:
    """A store in a bucket: as of `Place`.

    Args:
        target: The store.
        source: The store that is copied from.
        catalog: Its catalog, with what decoding found out.
        tables: Its fields.
    """

    proves = False

    def __init__(
        self, target: RemoteDirectory, source: StoreDirectory, catalog: Catalog, tables: Tables
    ) -> None:
        self.name = target.place
        self._target = target
        self._source = source
        store = sha256(f"{source.settings.store_id} {platform.node()}".encode()).hexdigest()
        self._mine = f"copy-{store[:8]}-"  # begins the ids of pins that copies of this store set
        self._catalog = catalog
        self._tables = tables
        self._own = open_catalog(target)
        self._recording = ""
        self._is_mending = False
        self._pins: set[tuple[str, str]] = set()  # ids of recordings, and of their pins
        self._held = ExitStack()
        self._damaged: set[Object] = set()
        self._there: dict[str, Object] = {}  # by path below the recording
        self._proven: dict[str, CopiedFile] = {}
        self._upload: Upload | None = None

    def sees(self, mark: str) -> bool:
        """As of `Place`."""
        return False

    def have(self, recordings: Sequence[str]) -> dict[str, Copied]:
        """As of `Place`."""
        self._target.refresh()
        return {one: self._copied(one) for one in recordings if self._target.has(one)}

    def _copied(self, recording: str) -> Copied:
        self._target.source.compare(recording)
        self._target.source.bucket.lost.update(self._damaged)
        row = self._own.recording(recording)
        for pin in [] if row is None else row[1].pins:  # a copy that was stopped has left some
            own, _, name = pin["id"].partition(self._mine)
            if not own and name and not is_at_work(self._source, SENDING + name):
                self._pins.add((recording, pin["id"]))
        if row is None or expired_messages(row[1]):
            found = copied_of(self._target, recording)
            found = found if row is None else replace(found, name=row[1].name)
        else:
            found = Copied(row[1].name, content=content_of(_digests(row[1])))
        return replace(found, is_damaged=bool(self._target.lost_of(recording)))

    def segments(self, recording: str) -> dict[int, CopiedSegment]:
        """As of `Place`."""
        return segments_of(manifest_of(self._target, recording))

    def begin(self, recording: str, *, wants_payloads: bool) -> Begun:
        """As of `Place`."""
        self.leave()
        known = self.have([recording]).get(recording)
        listed: set[str] = set()
        lost: list[CopiedFile] | None = None
        if known is not None:
            if not (wants_payloads and (known.lacks_payloads or known.is_damaged)):
                return Begun(known)
            listed = {one.name for one in self._target.files_of(recording).values()}
            has_manifest = manifest_of(self._target, recording) is not None
            self._is_mending = has_manifest and not known.lacks_payloads
            lost = [*self._lost(recording).values()] if self._is_mending else None
        self._recording = recording
        bucket, folder = self._target.source.bucket, f"{RECORDINGS}/{recording}/"
        damaged = {one.name for one in self._damaged}  # whatever their entity tags say
        for one in sorted(bucket.objects(folder), key=lambda one: one.modified):
            if one.name in listed or (bucket.is_young(one) and one.name not in damaged):
                self._there[path_of(one.name[len(folder) :])] = replace(one, modified=0)
        sizes = {path.removeprefix(f"{PAYLOADS}/"): o.size for path, o in self._there.items()}
        return Begun(sizes=sizes, lost=lost)

    def _lost(self, recording: str) -> dict[str, CopiedFile]:
        """The files of a recording whose objects are lost, as its manifest lists them."""
        manifest = manifest_of(self._target, recording)
        if manifest is None:
            return {}
        found = {f"{PAYLOADS}/{one.file}": copied_file(one) for one in manifest.fields}
        for log in manifest.logs.values():
            found[log.name] = CopiedFile(log.name, log.bytes, log.digest)
        lost = self._target.lost_of(recording)
        return {path: file for path, file in found.items() if path in lost}

    def digest(self, file: CopiedFile, length: int) -> str:
        """As of `Place`, but for the kind of digest; empty if it has another length."""
        about = self._there[_path(file)]
        return self._target.source.bucket.digest(about) if about.size == length else ""

    def append(self, file: CopiedFile, at: int, data: Buffer) -> None:
        """As of `Place`; from the first byte on."""
        if at == 0 or self._upload is None:
            name = f"{RECORDINGS}/{self._recording}/{_path(file)}"
            if any(one.name == name for one in self._damaged):
                name = other_name(name)
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

    def publish(self, data: bytes) -> str:
        """As of `Place`."""
        if self._is_mending:
            return self._mend()
        target, recording = self._target, self._recording
        new = proven_manifest(data, recording, self._proven)
        found = {_path(file): self._there[_path(file)] for file in self._proven.values()}
        entry = self._entry(recording)
        fields = {} if entry is None else self._bring_fields(entry)
        for _ in range(TRIES):
            with suppress(ObjectExistsError), target.changing():
                known = self.have([recording]).get(recording)
                there = {} if known is None else target.files_of(recording)
                is_whole = known is not None and not (known.lacks_payloads or known.is_damaged)
                if known is not None and is_whole:  # another process was faster
                    # Of large files the last one to come replaced what the other one had sent.
                    names = {one.name for one in there.values()}
                    listed = {**there, **{p: o for p, o in found.items() if o.name in names}}
                    name = known.name
                else:
                    if known is None:
                        name = free_name_in(self._own, new.name, recording)
                        made = truth.replace(new, name=name)
                    else:
                        made = self._merged(new)
                        name = made.name
                    bucket, path = target.source.bucket, f"{RECORDINGS}/{recording}/{MANIFEST}"
                    marks = {log: there[log] for log in marked_there(made, new) if log in there}
                    listed = {**marks, **found}
                    if known is not None and manifest_of(target, recording) is None:
                        self._check_holds_more(there, listed, new.name)
                    listed[MANIFEST] = bucket.create_beside(path, encode(made))
                if listed != there:
                    target.add_recording(recording, listed, fields)
                    self._describe(recording, entry)
                break
        else:
            raise StoreError(f"{self.name} changes all the time. Copy again.")
        if is_whole and has_lost(self.segments(recording), segments_of(new)):
            raise HeldError(
                f"another process has copied it into {self.name} at this moment, with fewer "
                "payloads.",
                is_recording=False,
            )
        return name

    def _entry(self, recording: str) -> RecordingEntry | None:
        """The entry of a recording in the store that is copied, as its files are now."""
        row = self._catalog.recording(recording)
        if row is None:
            return None
        return describe(self._catalog, take_inventory(self._source, recording)).entry

    def _mend(self) -> str:
        """List what was sent in the place of what was lost; the rest stays as it is.

        Raises:
            RefusedError: More is lost than was sent.
        """
        target, recording, proven = self._target, self._recording, {*self._proven.values()}
        entry, fields = self._entry(recording), None
        for _ in range(TRIES):
            with suppress(ObjectExistsError), target.changing():
                known = self.have([recording]).get(recording)
                if known is None:
                    raise RefusedError(f"It was removed from {self.name} meanwhile. Copy again.")
                found = {
                    path: self._there[path]
                    for path, file in self._lost(recording).items()
                    if file in proven
                }
                target.look_closely()
                if any(path.startswith(f"{TABLES}/") for path in target.lost_of(recording)):
                    fields = fields or ({} if entry is None else self._bring_fields(entry))
                if found or fields is not None:
                    target.mend(recording, found, fields)
                    self._own.put(describe(self._own, take_inventory(target, recording)))
                left = target.lost_of(recording)
                break
        else:
            raise StoreError(f"{self.name} changes all the time. Copy again.")
        if left:
            raise RefusedError(
                f"{known.name} in {self.name} has lost {', '.join(sorted(left))}, which this "
                "store does not have either: their payloads were deleted here, or were never "
                "here. All else of it stays as it is. Another store may have them."
            )
        return known.name

    def _merged(self, new: Manifest) -> Manifest:
        """What is sent, with what users have said of it there."""
        return merged(manifest_of(self._target, new.id) or self._known(new), new)

    def _known(self, new: Manifest) -> Manifest:
        """A copy there that has lost its manifest, by its segments and its row of the catalog."""
        row = self._own.recording(new.id)
        if row is None:
            return new
        there = new
        with suppress(SegmentError):  # all segments are lost, too
            there = made_again(take_inventory(self._target, new.id), None)
        sent = {*digests_of(new).values()}
        logs = {number: log for number, log in there.logs.items() if log.digest not in sent}
        marks = [
            Mark(new_random(), one["time"], one["text"], one["tags"], one.get("end"), log.number)
            for one in row[1].marks
            if (log := logs.get(one["segment"])) is not None
        ]
        pins = [
            pin_of(one["id"], (one["from"], one["to"]), one["topics"], one["reason"])
            for one in row[1].pins
        ]
        return truth.replace(
            there,
            name=row[1].name,
            tags=row[1].tags,
            notes=tuple(Note(note["at"], note["text"]) for note in row[1].notes),
            marks=tuple(marks),
            pins=tuple(pins),
        )

    def _check_holds_more(
        self, there: Mapping[str, Object], found: Mapping[str, Object], name: str
    ) -> None:
        """Raise if segments there have payloads that those sent lack: they are shorter then.

        Raises:
            RefusedError: Some have, or were not sent.
        """
        more = [
            path
            for path, one in there.items()
            if path.endswith(".mcap") and (path not in found or found[path].size < one.size)
        ]
        if more:
            raise RefusedError(
                f"Recording {name!r} in {self.name} has lost its manifest, and has payloads that "
                f"are not here, in {', '.join(sorted(more))}. It stays as it is."
            )

    def _describe(self, recording: str, entry: RecordingEntry | None) -> None:
        """Make the row of the catalog from what is there, as it is read back."""
        if entry is not None:  # what decoding found out, too
            found = []
            for number, digest in _digests(entry).items():
                rows = self._catalog.decoded_table(entry, number)[1]
                if rows is not None:
                    found.append((number, digest, rows))
            self._own.put_stamps(entry.id, found)
            self._own.put_damage(entry.id, self._catalog.damage(entry.id))
        inventory = take_inventory(self._target, recording)
        if inventory.misfits or not inventory.is_proven:
            raise StoreError(f"What was copied of recording {recording!r} does not fit together.")
        self._own.put(describe(self._own, inventory))

    def hold(self, recordings: Sequence[str]) -> bool:
        """Pin the recordings there: a bucket has no locks. Always true.

        Pins that a crash leaves go with the next copy of this store.
        """
        self.leave()
        folder = self._held.enter_context(at_work(self._source))
        name = self._mine + folder.name.removeprefix(SENDING)
        self._pins = {(recording, name) for recording in recordings}
        reason = "held for a copy that deletes payloads at its source; unpin it if none runs"
        pin = pin_of(name, (None, None), None, reason)

        def pinned(now: Manifest) -> Manifest:
            others = [one for one in now.pins if one.id != name]
            return truth.replace(now, pins=(*others, pin))

        self._change(recordings, pinned)
        return True

    def _change(self, recordings: Iterable[str], how: Callable[[Manifest], Manifest]) -> None:
        """Change the manifests of recordings at once; lost ones are left out."""
        target = self._target
        for _ in range(TRIES):
            with suppress(ObjectExistsError), target.changing():
                for recording in recordings:
                    if target.has(recording):
                        with suppress(ManifestError):
                            target.change(recording, how)
                            put_entry(target, self._own, recording)
                return
        raise StoreError(f"{self.name} changes all the time. Copy again.")

    def drop(self) -> None:
        """As of `Place`; objects that no list names go when the bucket is tidied."""
        self.leave()

    def leave(self) -> None:
        """As of `Place`."""
        pins, self._pins = self._pins, set()
        with self._held:
            if pins:
                ids = {pin for _, pin in pins}
                self._change(
                    {one for one, _ in pins},
                    lambda now: truth.replace(
                        now, pins=tuple(pin for pin in now.pins if pin.id not in ids)
                    ),
                )
        self._recording, self._upload, self._is_mending = "", None, False
        self._there.clear()
        self._proven.clear()

    def problems(self, recording: str) -> list[str]:
        """As of `Place`; damaged objects count as lost from here on."""
        self._target.look_closely()
        objects = self._target.files_of(recording) if self._target.has(recording) else {}

        def is_whole(file: CopiedFile) -> bool:
            """True if an object is, whatever was kept of it here."""
            with tempfile.TemporaryDirectory(prefix="hybridlog-") as place:
                try:
                    self._target.fetch(objects[_path(file)], file.below(Path(place)))
                except (KeyError, FileNotFoundError, ObjectChangedError):
                    return False
                if not file.is_whole(Path(place)):
                    self._damaged.add(objects[_path(file)])
                    return False
            return True

        return problems_of(self._target, recording, is_whole)

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
            size = files.status(path).st_size
        except OSError as error:
            raise unreadable(error, path) from error
        pieces = pieces_of(path, 0, size, _PIECE)
        return self._target.source.bucket.send(name, size, pieces)

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
