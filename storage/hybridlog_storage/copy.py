"""Copies a recording from a store to another one: its files, then its manifest.

What is there already is not sent. Into a manifest that is there go files, channels, losses and the
status; who copies from an older one takes nothing back. All that people said of the recording there
stays, and so do its logs, which are compared by number: one that has expired there is not brought
again, one that was left elsewhere is.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field

from hybridlog_storage.copy_places import RefusedError, Sending
from hybridlog_storage.errors import RecordingExistsError, StoreError
from hybridlog_storage.manifest import File, Manifest, replace
from hybridlog_storage.manifests import MANIFEST_LOCK, MANIFEST_OLD, RECORDINGS, WRITER_LOCK
from hybridlog_storage.stopping import pause, safe_point

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from contextlib import AbstractContextManager

    from hybridlog_storage.copy_places import Place, Source

_TRIES: Final = 3  # of a recording whose files expire meanwhile
Prepared = tuple[Manifest, "Source"]
"""A manifest to send, and the store that has the files which are in no other one."""


class How(Struct, frozen=True):
    """The way in which recordings are copied.

    Attributes:
        prepare: Makes of a manifest, and of those of its logs that are to be sent, what is sent in
            its place; None to send the files as they are.
        check: Prove what is there already, too, and send it again if it is wrong.
        limit_rate: Bytes a second, at most; None for no limit.
        named: Makes a free name there of the name here. Meanwhile nobody else begins a recording,
            where there are locks.
        progress: Called with the bytes done, and those in all.
        proved: Called with the numbers of logs that were proved there just now; where there are
            locks, nobody changes the copy meanwhile.
    """

    prepare: Callable[[Manifest, list[File]], AbstractContextManager[Prepared]] | None = None
    check: bool = False
    limit_rate: float | None = None
    named: Callable[[str], str] = lambda name: name
    progress: Callable[[int, int], None] = lambda *_: None
    proved: Callable[[Collection[int]], None] | None = None


class Copied(Struct):
    """A recording after it was copied.

    Attributes:
        manifest: As it is there now.
        bytes: Of the files that were sent, or proved.
        sent: Paths of the files that were sent, below the recording.
        sent_bytes: Bytes of them, without those that an interrupted copy had sent.
        lacking: Numbers of logs of which payloads have expired there, and are here.
        lost: Paths of files that the copy has lost, and that are not here.
    """

    manifest: Manifest
    is_new: bool = False
    bytes: int = 0
    sent: list[str] = field(default_factory=list)
    sent_bytes: int = 0
    lacking: list[int] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


def copy(source: Source, target: Place, recording: str, how: How | None = None) -> Copied:
    """Copy a recording. What an interrupted copy has left is used by the next one.

    After a `RefusedError` (it is damaged, or another recording there has its id) others can be
    copied; after any error, what was copied stays.
    """
    for attempt in range(_TRIES):
        here = source.manifests.read(recording)
        work = _Copy(source, target, here, how or How())
        try:
            return work.known() or work.run()
        except RefusedError:  # a file that has expired meanwhile is no damage
            if attempt + 1 == _TRIES or source.manifests.read(recording) == here:
                raise
    raise AssertionError


class _Copy:
    """The steps of a copy."""

    def __init__(self, source: Source, target: Place, here: Manifest, how: How) -> None:
        self._source, self._target, self._here, self._how = source, target, here, how
        self._own = {*here.present}
        self._others = source  # has the files that are not in `_own`
        self._must_prove = how.check or how.proved is not None
        self._done = self._total = 0
        self._sent_bytes = 0
        self._due = 0.0  # time from which more may be sent
        self._new: set[str] = set()  # paths of files that the manifest there did not list
        self._proved: dict[str, str] = {}  # digests by path

    def known(self) -> Copied | None:
        """The result if there is nothing to copy, found without a lock; None if there is."""
        here, target = self._here, self._target
        if self._must_prove:
            return None
        there = target.manifests.find(here.id)
        check_origin(here, there)
        if there is None or there.status == "unproven" or self._wanted(there):
            return None
        sizes = target.sizes(here.id)
        if any(sizes.get(name) != one.bytes for name, one in there.present.items()):
            return None
        return Copied(there, lacking=_lacking(here, there))

    def run(self) -> Copied:
        here, target = self._here, self._target
        if here.status == "unproven":
            raise RefusedError(
                f"{here.name} is not copied: its manifest was lost and made again, so nothing "
                f"says that it is whole. Copy it from a store that has lost nothing of it."
            )
        with target.working(here.id), ExitStack() as stack:
            sizes = target.sizes(here.id)
            there = self._find(sizes)
            check_origin(here, there)
            logs = self._wanted(there)
            if logs and self._how.prepare is not None:
                here, self._others = stack.enter_context(self._how.prepare(here, logs))
                logs = [here.logs[log.number] for log in logs]
            copied = Copied(here, there is None, lacking=_lacking(here, there))
            self._bring(here, there, logs, sizes, copied)
            copied.manifest = self._publish(here, there, {log.number for log in logs})
            self._clear(there, copied.manifest, sizes)
            if self._how.proved is not None:
                self._how.proved(self._proved_logs(here))
        return copied

    def _wanted(self, there: Manifest | None) -> list[File]:
        return wanted(self._here, there, awaited=self._how.prepare is None)

    def _is_whole(self, file: File, sizes: Mapping[str, int]) -> bool:
        reads = file.name not in self._new
        is_there = sizes.get(file.name) == file.bytes
        return is_there and self._target.is_whole(self._sending(file), reads=reads)

    def _find(self, sizes: Mapping[str, int]) -> Manifest | None:
        """The manifest there; a recording that has lost more than is known here is left alone."""
        there, lost = self._target.manifests.find(self._here.id), ""
        if there is None and MANIFEST_OLD in sizes:
            lost = ": run `hybridlog verify --repair` there, then copy again"
        is_begun = WRITER_LOCK in sizes and MANIFEST_LOCK not in sizes  # by a stopped copy
        if there is None and not is_begun and (more := self._more(sizes)):
            lost = f", and has payloads that are not here, in {', '.join(more)}. It stays as it is"
        if lost:
            name, address = self._here.name, self._target.address
            raise RefusedError(f"{name} in {address} has lost its manifest{lost}.")
        return there

    def _more(self, sizes: Mapping[str, int]) -> list[str]:
        """Logs there that are larger than those of their numbers here."""
        logs = self._here.logs.items()
        here = {f"{number:06d}": log.bytes for number, log in logs if log.is_here}
        return sorted(
            path
            for path, size in sizes.items()
            if path.endswith(".mcap") and size > here.get(path[:6], -1)
        )

    def _bring(
        self,
        here: Manifest,
        there: Manifest | None,
        logs: list[File],
        sizes: Mapping[str, int],
        copied: Copied,
    ) -> None:
        """Send what is lacking, or lost, and prove what has to be."""
        target = self._target
        ours = here.present
        listed = {} if there is None else there.present
        numbers = {log.number for log in logs}
        new = [one for one in ours.values() if one.number in numbers]
        kept = merged(here, there, numbers)
        old = [listed[name] for name in kept.present if name in listed]
        self._new = {one.name for one in new}
        doubtful = [one for one in old if self._must_prove or sizes.get(one.name) != one.bytes]
        self._total = sum(one.bytes for one in (*new, *doubtful))
        for one in (*new, *doubtful):
            if self._is_whole(one, sizes):
                self._count(one.bytes, False)
            elif one.name in ours and ours[one.name].digest == one.digest:
                target.send(self._sending(one))
                copied.sent.append(one.name)
            else:
                copied.lost.append(one.name)
                continue
            self._proved[one.name] = one.digest
        copied.bytes, copied.sent_bytes = self._total, self._sent_bytes

    def _sending(self, file: File) -> Sending:
        source = self._source if file.name in self._own else self._others
        about = file.name, file.bytes, file.digest
        return Sending(source, self._here.id, *about, self._count)

    def _count(self, size: int, is_sent: bool) -> None:  # noqa: FBT001 - as of Sending
        """Note bytes that were sent, or were there; wait as long as the limit of the rate asks."""
        safe_point()
        self._done += size
        self._how.progress(min(self._done, self._total), self._total)
        if is_sent:
            self._sent_bytes += size
        if is_sent and self._how.limit_rate is not None:
            now = time.monotonic()
            self._due = max(self._due, now) + size / self._how.limit_rate
            pause(max(self._due - now, 0.0))

    def _publish(self, here: Manifest, there: Manifest | None, brought: set[int]) -> Manifest:
        manifests = self._target.manifests
        self._check_files()
        if there is None:
            # Another process may be faster.
            with suppress(RecordingExistsError), manifests.creating() as create:
                made = merged(here, there, brought)
                made = replace(made, name=self._how.named(made.name))
                create(made)
                return made
        return manifests.change(here.id, lambda now: merged(here, now, brought))

    def _check_files(self) -> None:
        """Raise if files are no longer there: a removal that ends takes them along."""
        if self._new and not self._new <= self._target.sizes(self._here.id).keys():
            raise StoreError(
                f"Files of {self._here.name} have gone from {self._target.address} meanwhile. "
                "Copy again."
            )

    def _clear(self, there: Manifest | None, now: Manifest, sizes: Mapping[str, int]) -> None:
        """Delete files that others have replaced, and what has arrived of those not to come."""
        listed = now.present.keys()
        left = set() if there is None else there.present.keys() - listed
        if self._how.prepare is None:  # or else the next copy goes on with them
            arrived = {path for path in sizes if path.endswith(".part")}
            all_else = sizes.keys() - {MANIFEST_LOCK, WRITER_LOCK} - listed
            left |= all_else if there is None else arrived
        for path in left:
            self._target.drop(f"{RECORDINGS}/{now.id}/{path}")

    def _proved_logs(self, here: Manifest) -> set[int]:
        """Numbers of logs whose copies were proved, and that are still listed there."""
        there = self._target.manifests.read(here.id).logs
        return {
            number
            for number, log in here.logs.items()
            if log.is_here
            and number in there
            and there[number].is_here
            and self._proved.get(there[number].name) == log.digest
        }


def _lacking(here: Manifest, there: Manifest | None) -> list[int]:
    known = {} if there is None else there.logs
    return [
        number
        for number, log in here.logs.items()
        if log.is_here and number in known and known[number].gone == "expired"
    ]


def wanted(here: Manifest, there: Manifest | None, *, awaited: bool = True) -> list[File]:
    """The logs that a copy lacks; of those that are gone here, the rows are sent.

    `there` is the manifest of the copy so far, None if it is new; `awaited` adds those that were
    left for later.
    """
    known = {} if there is None else there.logs
    return [
        log
        for number, log in here.logs.items()
        if number not in known
        or (awaited and known[number].gone == "elsewhere" and log.gone != "elsewhere")
    ]


def merged(here: Manifest, there: Manifest | None, brought: Collection[int]) -> Manifest:
    """The manifest of a copy; `there` is the one so far, None if it is new.

    `brought` has the numbers of the logs that are there now, whole, or with their rows.
    """
    if there is None:
        return here
    check_origin(here, there)
    new = {log.number: log for log in wanted(here, there) if log.number in brought}
    rows = [f for f in there.files if f.kind == "rows" and f.number not in new]
    rows += [f for f in here.files if f.kind == "rows" and f.number in new]
    channels = {
        number: channel
        for number, channel in here.channels.items()
        if number not in there.channels or channel.messages >= there.channels[number].messages
    }
    is_newer = _messages(here) >= _messages(there)
    has_status = is_newer and (here.status != "open" or there.status == "open")
    return replace(
        there,
        files=(*{**there.logs, **new}.values(), *rows),
        channels={**there.channels, **channels},
        losses=here.losses if is_newer else there.losses,
        status=here.status if has_status else there.status,
    )


def _messages(manifest: Manifest) -> int:
    """Messages that a recording has had; with a ring, those that went, too."""
    gone = 0 if manifest.let_go is None else manifest.let_go.messages
    return gone + sum(channel.messages for channel in manifest.channels.values())


def check_origin(here: Manifest, there: Manifest | None) -> None:
    """Raise `RefusedError` if two manifests of one id are not of one recording."""
    if there is None:
        return
    logs, channels = there.logs, there.channels
    is_one = (
        here.created == there.created
        and all(
            channels[number].topic == one.topic
            for number, one in here.channels.items()
            if number in channels
        )
        and all(
            logs[number].parts == log.parts for number, log in here.logs.items() if number in logs
        )
    )
    if not is_one:
        raise RefusedError(
            f"{here.name} is not copied: another recording, {there.name}, has its id {here.id} "
            "there."
        )
