"""The store's directory: its layout and its locks.

```
<store>/
  hybridlog.toml        format version, id of the store, settings
  recordings/<label>/   one recording: journal, segments, columns; writer.lock while it is written
  catalog.sqlite        derived: recordings and channels
  mongod/               derived: data of the embedded MongoDB
```

The label of a recording is for people. The journal identifies the recording.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import secrets
import stat
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar, Final

from hybridlog_storage import journal
from hybridlog_storage.cells import Cells
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import HeldError, SegmentError, StoreError, TopicError, unreadable
from hybridlog_storage.journal import JOURNAL
from hybridlog_storage.segments.segment_file import OPEN_SUFFIX, SEALED_SUFFIX
from hybridlog_storage.settings import NAME as SETTINGS
from hybridlog_storage.settings import StoreSettings, read_settings, write_settings
from hybridlog_storage.stopping import pause

LOCK: Final = "writer.lock"
LOCK_WAIT_S: Final = 10.0
"""Seconds that a command waits for another one that holds its recording."""
PAYLOADS: Final = "payloads"
"""Folder of a recording that holds the fields of its expired messages."""
REMOVED: Final = ".removed-"
"""Prefix of the directory of a recording that is being deleted."""
SENDING: Final = ".copying-"
"""Prefix of the folder of a copy out of the store, while it is under way."""
IMPORTING: Final = ".importing-"
"""Prefix of the directory of a recording that is being imported."""
_RECORDINGS: Final = "recordings"
_TICK_NS: Final = 50_000_000
_POLL_S = 0.02
_RECORDER_WAIT_S = 0.5  # a reader's look at a lock must not pass for a recorder
_MAX_HOLDER = 256  # bytes of the line in a lock
_TRIES = 10


@dataclass(frozen=True, slots=True)
class Holder:
    """The process that holds a recording's lock, by its own account.

    Attributes:
        name: Its id and its command, for messages.
        is_recording: Whether it records, instead of changing an ended recording.
    """

    name: str
    is_recording: bool


@dataclass(frozen=True, slots=True)
class Listing:
    """Content of a recording's directory.

    Attributes:
        journal: Whether it has a journal.
        sealed: Names of sealed segments, by number.
        open: Names of segments that were never sealed, by number.
        others: All other names.
        payloads: Sizes of files of fields, by path below `payloads`.
        look: As of `StoreDirectory.looks`, before the names were read.
        print: A value that changes whenever a relevant file changes.
    """

    journal: bool
    sealed: Mapping[int, str]
    open: Mapping[int, str]
    others: tuple[str, ...]
    payloads: Mapping[str, int]
    look: str
    print: str


class StoreDirectory:
    """A store's directory.

    Args:
        path: The directory.
        read_only: Behave as if this user could not write it.

    Attributes:
        is_remote: Whether it stands for a place in a bucket, see `remote.store`.

    Raises:
        StoreError: It is not a store, has another format, or cannot be read.
    """

    is_remote: ClassVar[bool] = False

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self.path = path
        self.read_only = read_only
        self.settings = read_settings(path)

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        mongo: str | None = None,
        cache_mb: int | None = None,
    ) -> StoreDirectory:
        """Create a store, or open an existing one.

        Args:
            path: The directory.
            mongo: URI of the MongoDB to use instead of the embedded one; without a password.
            cache_mb: Size of the embedded MongoDB's cache in MiB; for a new store only.

        Raises:
            StoreError: The directory holds other files, or cannot be written.
        """
        if path.exists() and not path.is_dir():
            raise StoreError(f"{path} is a file; a store is a directory. Choose another name.")
        try:
            if not (path / SETTINGS).exists():
                path.mkdir(parents=True, exist_ok=True)
                # Of several processes, one creates the store and the others open it.
                with files.locked_folder(path):
                    settings = StoreSettings(secrets.token_hex(16), mongo=mongo, cache_mb=cache_mb)
                    cls._make(path, settings)
            store = cls(path)
            try:
                files.make_folder(path / _RECORDINGS)
            except FileExistsError:
                pass
            else:
                files.sync_folder(path)
        except OSError as error:
            raise durability.explain(error, path, "making the store") from error
        return store

    @staticmethod
    def _make(path: Path, settings: StoreSettings) -> None:
        names = {entry.name for entry in path.iterdir()}
        if SETTINGS in names:
            return
        # A temporary settings file left by a crash here does not count.
        if any(not name.startswith(f".{SETTINGS}.") for name in names):
            raise StoreError(
                f"{path} holds files and is not a hybridlog store. "
                "Choose an empty or a new directory with --store."
            )
        write_settings(path, settings)

    @property
    def is_writable(self) -> bool:
        """True if this user may change the store."""
        if self.read_only:
            return False
        return os.access(self.path / _RECORDINGS, os.W_OK | os.X_OK) and os.access(
            self.path, os.W_OK | os.X_OK
        )

    def check_writable(self) -> None:
        """Raise if the store cannot be written.

        Raises:
            StoreError: It is read-only for this user.
        """
        if not self.is_writable:
            raise StoreError(
                f"The store {self.path} is read-only. Check its owner and mount, or choose "
                "another with --store."
            )

    def check_changes(self) -> None:
        """Raise if what users change by their commands cannot be changed; see `check_writable`."""
        self.check_writable()

    def require(self, feature: str) -> None:
        """Note in the settings that only readers that know a feature may read the store.

        Raises:
            StoreError: They cannot be written.
        """
        if feature not in self.settings.requires:
            others = [one for one in read_settings(self.path).requires if one != feature]
            self.change_settings(requires=(*others, feature))

    def change_settings(self, **changes: Any) -> None:
        """Change settings of the store.

        Raises:
            StoreError: They cannot be written.
        """
        with self.alone():
            settings = replace(read_settings(self.path), **changes)
            try:
                write_settings(self.path, settings)
            except OSError as error:
                raise durability.explain(error, self.path, "writing settings of") from error
            self.settings = settings

    @property
    def recordings(self) -> Path:
        """Directory of all recordings."""
        return self.path / _RECORDINGS

    def recording(self, label: str) -> Path:
        """Directory of a recording."""
        return self.recordings / label

    def labels(self) -> list[str]:
        """Labels of all recordings that have a directory, sorted."""
        return [name for name in self._folders() if not name.startswith(".")]

    def names(self) -> list[str]:
        """All names below `recordings`, sorted; some may not be recordings.

        Raises:
            StoreError: It cannot be read.
        """
        try:
            with files.folder(self.recordings) as fd:
                return sorted(os.listdir(fd))  # noqa: PTH208 - of a handle
        except FileNotFoundError:
            return []
        except OSError as error:
            raise unreadable(error, self.path, f"The store {self.path}") from error

    def changed(self) -> tuple[int, bool]:
        """Time at which a recording got or lost its name last, ns, and if that is a while ago.

        Within a tick of the file system's clock another change would show the same time.
        """
        try:
            changed = files.status(self.recordings).st_mtime_ns
        except OSError:
            return 0, False
        return changed, _is_a_tick_ago(changed)

    def looks(self, names: Sequence[str]) -> dict[str, str]:
        """The look of each recording's directory, by label.

        It changes whenever a file gets or loses its name, and when the journal grows. A
        change inside a segment shows only in `Listing.print`.

        Args:
            names: From `names`.

        Raises:
            StoreError: They cannot be read.
        """
        found: dict[str, str] = {}
        try:
            with files.folder(self.recordings) as fd:
                for name in names:
                    if not name.startswith("."):
                        with suppress(OSError):
                            about = os.stat(name, dir_fd=fd, follow_symlinks=False)
                            if stat.S_ISDIR(about.st_mode):
                                found[name] = _look(about, f"{name}/{JOURNAL}", fd)
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise unreadable(error, self.path, f"The store {self.path}") from error
        return found

    def _look_of(self, label: str) -> str:
        """The look of one recording."""
        with files.folder(self.recording(label)) as fd:
            return _look(os.fstat(fd), JOURNAL, fd)

    @property
    def address(self) -> str:
        """The address by which another process opens it."""
        return str(self.path.absolute())

    @property
    def place(self) -> str:
        """The store's place, for people."""
        return str(self.path)

    @property
    def when_empty(self) -> str:
        """The sentence for a store without recordings."""
        return "The store is empty: `hybridlog record FILE` fills it."

    def catalog_cells(self) -> Cells | None:
        """The cells of the catalog; None for those in its file here."""
        return None

    def append(self, label: str, *lines: journal.Event) -> None:
        """Append lines to the journal of a recording that this process has locked.

        Raises:
            StoreError: It cannot be written.
        """
        journal.Journal(self.recording(label)).append(*lines)

    @contextmanager
    def at_hand(self, label: str, segments: Collection[int] = ()) -> Iterator[StoreDirectory]:
        """A directory where files of a recording can be changed, within `writing`: this one."""
        yield self

    def has(self, label: str) -> bool:
        """True if this name exists below `recordings`."""
        try:
            files.status(self.recording(label))
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def _folders(self) -> list[str]:
        try:
            found = files.names(self.recordings)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise unreadable(error, self.path, f"The store {self.path}") from error
        return sorted(name for name, about in found.items() if stat.S_ISDIR(about.st_mode))

    def look_closely(self) -> bool:
        """Compare a list of files with the files; True if some are missing. Here is no list."""
        return False

    def lost_of(self, label: str) -> Collection[str]:
        """Files that a list says to be there, and are not; here nothing says so."""
        return ()

    def listing(self, label: str) -> Listing:
        """Read the content of a recording's directory.

        Raises:
            StoreError: It cannot be read.
        """
        path = self.recording(label)
        look, found, payloads = "", {}, {}
        try:
            look = self._look_of(label)
            found = files.names(path)
            if PAYLOADS in found:
                payloads = payload_names(path)
        except FileNotFoundError:
            pass
        except OSError as error:
            raise unreadable(error, path) from error
        sealed: dict[int, str] = {}
        opened: dict[int, str] = {}
        others = []
        looks = hashlib.blake2b(digest_size=16)
        for name, about in sorted(found.items()):
            number, kind = _numbered(name)
            if kind == OPEN_SUFFIX:
                opened[number] = name
                looks.update(f"{name}\n".encode())
            elif kind == SEALED_SUFFIX:
                sealed[number] = name
            elif name != JOURNAL:
                others.append(name)
                continue
            if kind != OPEN_SUFFIX:
                looks.update(
                    f"{name} {about.st_size} {about.st_mtime_ns} {about.st_ctime_ns} "
                    f"{about.st_ino}\n".encode()
                )
        for name, about in sorted(payloads.items()):
            looks.update(
                f"{name} {about.st_size} {about.st_mtime_ns} {about.st_ctime_ns} "
                f"{about.st_ino}\n".encode()
            )
        return Listing(
            JOURNAL in found,
            dict(sorted(sealed.items())),
            dict(sorted(opened.items())),
            tuple(others),
            {name: about.st_size for name, about in sorted(payloads.items())},
            look,
            looks.hexdigest(),
        )

    def segments(self, label: str) -> list[tuple[int, Path]]:
        """Number and path of each sealed segment of a recording, in order."""
        path = self.recording(label)
        return [(number, path / name) for number, name in self.listing(label).sealed.items()]

    @property
    def mongod(self) -> Path:
        """Directory of the embedded MongoDB."""
        return self.path / "mongod"

    def new_recording(self, name: str) -> str:
        """Create a directory for a new recording; return its label, made from the name."""
        base = label_of(name)
        number = 1
        while True:
            label = _numbered_label(base, number)
            try:
                files.make_folder(self.recording(label))
            except FileExistsError:
                number = self._free_number(base, number)
            except OSError as error:
                raise durability.explain(error, self.path, "starting a recording in") from error
            else:
                self._sync()
                return label

    def _free_number(self, base: str, taken: int) -> int:
        """A free number after a taken one; a thousand recordings of one name cost ten looks."""
        free = taken + 1
        while self.has(_numbered_label(base, free)):
            taken, free = free, free * 2
        while free - taken > 1:
            middle = (taken + free) // 2
            if self.has(_numbered_label(base, middle)):
                taken = middle
            else:
                free = middle
        return free

    def is_beginning(self, label: str) -> bool:
        """True if a process may be about to lock this empty recording.

        A process that begins a recording locks `recordings` until the recording itself is
        locked. Without that lock, an empty recording is left from a crash.
        """
        try:
            with files.locked_folder(self.recordings, 0):
                return False
        except OSError:
            return True

    def free_label(self, name: str, *, but: str = "") -> str:
        """A free label made from a name; the label of one recording may count as free."""
        base = label_of(name)
        taken = set(self._folders()) - {but}
        number = 1
        while (label := _numbered_label(base, number)) in taken:
            number += 1
        return label

    def move(self, old: str, new: str) -> None:
        """Durably rename a directory below `recordings`."""
        try:
            files.rename(self.recording(old), self.recording(new))
            self._sync()
        except OSError as error:
            raise durability.explain(error, self.recording(old), "renaming") from error

    def hide(self, label: str) -> str:
        """Durably give a recording a hidden name, and return that name."""
        hidden = f"{REMOVED}{label}-{secrets.token_hex(4)}"
        self.move(label, hidden)
        return hidden

    def remove(self, label: str) -> None:
        """Hide a recording's directory, then delete its files."""
        self.sweep(self.hide(label))

    def sweep(self, name: str) -> None:
        """Delete a hidden directory below `recordings`."""
        path = self.recording(name)
        try:
            files.remove_tree(path)
            self._sync()
        except OSError as error:
            raise durability.explain(error, path, "removing") from error

    def _sync(self) -> None:
        files.sync_folder(self.recordings)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Lock `recordings`, so that no other process starts a recording; for moments only."""
        try:
            with files.locked_folder(self.recordings):
                yield
        except OSError as error:
            raise durability.explain(error, self.path, "locking") from error

    @contextmanager
    def retaining(self) -> Iterator[bool]:
        """Lock out other passes of retention; yields False if another process makes one."""
        with ExitStack() as held:
            try:
                held.enter_context(files.locked_folder(self.path, 0))
            except BlockingIOError:
                yield False
                return
            except OSError as error:
                raise unreadable(error, self.path) from error
            yield True

    def id_of(self, label: str) -> str:
        """The id of a recording: by its journal, else by most of its segments.

        Returns:
            Empty if it has no segments yet that could say it.

        Raises:
            StoreError: Nothing says it, or it cannot be read.
        """
        from hybridlog_storage.segments.segment_reader import SegmentReader

        path, listing = self.recording(label), self.listing(label)
        state = journal.read(path) if listing.journal else None
        if state is not None and state.id:
            return state.id
        found: Counter[str] = Counter()
        for number, name in listing.sealed.items():
            with suppress(SegmentError), SegmentReader(path / name, number) as reader:
                found[str(reader.summary().recording.get("id", ""))] += 1
        if not found and (listing.sealed or listing.open):
            raise StoreError(f"Nothing readable says which recording {label!r} is.")
        return found.most_common(1)[0][0] if found else ""

    def labels_of(self, recording: str) -> list[str]:
        """Labels of a recording, by its id; several are copies of one."""
        found: list[str] = []
        for _ in range(_TRIES):
            looks = self.looks(self.labels())
            found = [label for label in looks if self.has_label(label, recording)]
            # One that is renamed meanwhile must not be missed.
            if found or self.looks(self.labels()) == looks:
                break
        return found

    def label_now(self, label: str, recording: str) -> str:
        """The present label of a recording that had a label.

        Raises:
            TopicError: It is gone, or several copies of it are left.
        """
        if self.has(label) and self.has_label(label, recording):
            return label
        found = self.labels_of(recording) if recording else []
        if len(found) == 1:
            return found[0]
        raise TopicError(f"Recording {label!r} is no longer in the store.")

    def has_label(self, label: str, recording: str) -> bool:
        """True if a recording, by its id, has a label; empty for any recording."""
        try:
            return not recording or self.id_of(label) == recording
        except StoreError:
            return False

    @contextmanager
    def writing(
        self, label: str, recording: str = "", *, wait_s: float = 0.0, records: bool = False
    ) -> Iterator[str]:
        """Lock a recording for writing.

        Nobody gives a locked recording another label, so the label is right until the end.

        Args:
            label: Its label when it was chosen.
            recording: Its id. If the label belongs to another recording by now, it is looked
                for. Empty for any recording that has the label.
            wait_s: Seconds to wait for another command that holds it. A recorder may hold it
                for hours, so it is not waited for.
            records: Whether this process records it.

        Yields:
            Its present label.

        Raises:
            HeldError: Another process holds it.
            TopicError: It is gone.
        """
        begun = time.monotonic()
        while True:
            try:
                fd = files.open_file(self.recording(label) / LOCK, os.O_RDWR | os.O_CREAT)
            except FileNotFoundError:
                label = self.label_now(label, recording)
                continue
            except OSError as error:
                raise durability.explain(error, self.recording(label) / LOCK, "locking") from error
            is_mine = False
            try:
                with suppress(BlockingIOError):
                    fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    is_mine = True
                if not self._is_lock_of(fd, label, recording):
                    label = self.label_now(label, recording)
                    continue
                if is_mine:
                    _say_holder(fd, records=records)
                    try:
                        yield label
                    finally:
                        with suppress(OSError):
                            files.system.truncate(fd, 0)
                    return
                holder = _read_holder(fd)
            finally:
                os.close(fd)
            most = min(wait_s, _RECORDER_WAIT_S) if holder.is_recording else wait_s
            if time.monotonic() - begun >= most:
                what = "being written" if holder.is_recording else "being changed"
                raise HeldError(
                    f"Recording {label!r} is {what} by {holder.name}. Wait until it is done, or "
                    "stop it.",
                    is_recording=holder.is_recording,
                )
            pause(_POLL_S)

    def _is_lock_of(self, fd: int, label: str, recording: str) -> bool:
        """True if an open lock is that of a label, and the label that of a recording."""
        path = self.recording(label) / LOCK
        try:
            there = files.status(path)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise durability.explain(error, path, "locking") from error
        return os.path.samestat(os.fstat(fd), there) and self.has_label(label, recording)

    def holder(self, label: str) -> Holder | None:
        """The process that holds a recording's lock at this moment."""
        try:
            fd = files.open_file(self.recording(label) / LOCK, os.O_RDONLY | os.O_NONBLOCK)
        except OSError:
            return None
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return _read_holder(fd)
        finally:
            os.close(fd)
        return None

    def is_recorded(self, label: str) -> bool:
        """True if a process records into a directory at this moment."""
        holder = self.holder(label)
        return holder is not None and holder.is_recording


def _say_holder(fd: int, *, records: bool) -> None:
    """Write into a lock who holds it. Of arguments only words: options may hold passwords."""
    program = Path(sys.argv[0] if sys.argv else "")
    name = program.parent.name if program.name == "__main__.py" else program.name
    name = "python" if name in {"", "-c"} else name
    words = takewhile(lambda word: not word.startswith("-"), sys.argv[1:])
    command = " ".join([name, *(words if name == "hybridlog" else ())]).encode("ascii", "replace")
    line = f"{os.getpid()} {int(records)} ".encode() + command
    with suppress(OSError):  # a full disk must not keep a recording from being removed
        files.system.pwritev(fd, [memoryview(line[:_MAX_HOLDER].ljust(_MAX_HOLDER))], 0)


def _read_holder(fd: int) -> Holder:
    """The last holder of a lock, from its line; the store may come from another user."""
    line = os.pread(fd, _MAX_HOLDER, 0).decode("ascii", "replace").strip()
    found = re.fullmatch(r"(\d+) ([01]) (.*)", line)
    if found is None or not line.isprintable():
        return Holder("another process", is_recording=False)
    return Holder(f"process {found[1]} ({found[3]})", is_recording=found[2] == "1")


def _numbered_label(base: str, number: int) -> str:
    return base if number == 1 else f"{base}-{number}"


def _look(about: os.stat_result, journal: str, fd: int) -> str:
    """The look of a recording.

    Args:
        about: The status of its directory.
        journal: Path of its journal.
        fd: Handle of the folder that the path begins in.
    """
    look = f"{about.st_ino} {about.st_mtime_ns} {about.st_ctime_ns}"
    try:
        lines = os.stat(journal, dir_fd=fd, follow_symlinks=False)
    except OSError:
        return look
    return f"{look} {lines.st_ino} {lines.st_size} {lines.st_mtime_ns} {lines.st_ctime_ns}"


def is_stable(look: str) -> bool:
    """False if the look is so new that it would be the same after another change."""
    times = look.split()[2::4]  # of the directory, and of the journal if there is one
    return all(_is_a_tick_ago(int(one)) for one in times)


def _is_a_tick_ago(changed: int) -> bool:
    """True if another change by now would show another time than this one, ns."""
    return abs(time.time_ns() - changed) > _TICK_NS


def payload_names(recording: Path, folder: str = PAYLOADS) -> dict[str, os.stat_result]:
    """Files of fields of a recording, by path below their folder.

    Raises:
        OSError: It cannot be read.
    """
    found: dict[str, os.stat_result] = {}
    with suppress(FileNotFoundError):
        for topic, about in files.names(recording / folder).items():
            if not stat.S_ISDIR(about.st_mode):
                found[topic] = about
                continue
            inside = files.names(recording / folder / topic)
            found.update({f"{topic}/{name}": status for name, status in inside.items()})
    return found


def label_of(name: str) -> str:
    """Turn a name into a valid label."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.")[:80] or "recording"


def _numbered(name: str) -> tuple[int, str]:
    """Number and suffix of a segment's file; an empty suffix for other files."""
    for suffix in (OPEN_SUFFIX, SEALED_SUFFIX):
        stem = name.removesuffix(suffix)
        if stem != name and stem.isascii() and stem.isdigit() and len(stem) <= 9:
            if f"{int(stem):06d}" == stem:
                return int(stem), suffix
            return 0, ""
    return 0, ""
