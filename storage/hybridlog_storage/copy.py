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

from hybridlog_storage.copy_places import RefusedError, Sending, folder_of
from hybridlog_storage.errors import RecordingExistsError, StoreError
from hybridlog_storage.manifest import File, Manifest, replace
from hybridlog_storage.manifests import MANIFEST_LOCK, MANIFEST_OLD, WRITER_LOCK
from hybridlog_storage.stopping import pause, safe_point

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
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
        try:
            return _Copy(source, target, here, how or How()).run()
        except RefusedError:  # a file that has expired meanwhile is no damage
            if attempt + 1 == _TRIES or source.manifests.read(recording) == here:
                raise
    raise AssertionError


class _Copy:
    """The steps of a copy."""

    def __init__(self, source: Source, target: Place, here: Manifest, how: How) -> None:
        self._source, self._target, self._here, self._how = source, target, here, how
        self._others = source  # has the files that are not here
        self._must_prove = how.check or how.proved is not None
        self._done = self._total = 0
        self._due = 0.0  # time from which more may be sent
        self._proved: dict[str, str] = {}  # digests by path
        self._sizes: dict[str, int] = {}  # of the files that are there

    def run(self) -> Copied:
        here, target = self._here, self._target
        there = self._look()
        if there is not None and self._is_known(there):
            return Copied(there, lacking=_lacking(here, there))  # found without a lock
        if here.status == "unproven":
            raise RefusedError(
                f"{here.name} is not copied: its manifest was lost and made again, so nothing "
                f"says that it is whole. Copy it from a store that has lost nothing of it."
            )
        with target.working(here.id), ExitStack() as stack:
            there = self._look()
            if there is None:
                self._check_lost()
            logs = self._wanted(there)
            if logs and self._how.prepare is not None:
                here, self._others = stack.enter_context(self._how.prepare(here, logs))
                logs = [here.logs[log.number] for log in logs]
            numbers = {log.number for log in logs}
            self._copied = Copied(here, there is None, lacking=_lacking(here, there))
            self._bring(here, there, numbers)
            self._copied.manifest = now = self._publish(here, there, numbers)
            self._clear(there, now)
            if self._how.proved is not None:
                self._how.proved(self._proved_logs(here))
        return self._copied

    def _look(self) -> Manifest | None:
        there = self._target.manifests.find(self._here.id)
        check_origin(self._here, there)
        self._sizes = self._target.sizes(folder_of(self._here.id))
        return there

    def _wanted(self, there: Manifest | None) -> list[File]:
        return wanted(self._here, there, awaited=self._how.prepare is None)

    def _is_known(self, there: Manifest) -> bool:
        """True if there is nothing to copy, and nothing to prove."""
        if self._must_prove or there.status == "unproven" or self._wanted(there):
            return False
        return all(self._sizes.get(name) == one.bytes for name, one in there.present.items())

    def _check_lost(self) -> None:
        """Raise if a recording has lost its manifest, and may have more than is known here."""
        here, sizes = self._here, self._sizes
        logs = {f"{number:06d}": log.bytes for number, log in here.logs.items() if log.is_here}
        is_begun = WRITER_LOCK in sizes and MANIFEST_LOCK not in sizes  # by a stopped copy
        more = [
            path
            for path in sorted(sizes)
            if path == MANIFEST_OLD
            or (not is_begun and path.endswith(".mcap") and sizes[path] > logs.get(path[:6], -1))
        ]
        if more:
            raise RefusedError(
                f"{here.name} in {self._target.address} has lost its manifest, and may have what "
                f"is not here, in {', '.join(more)}. It stays as it is: run `hybridlog verify "
                "--repair` there, then copy again."
            )

    def _bring(self, here: Manifest, there: Manifest | None, numbers: Collection[int]) -> None:
        """Send what is lacking, or lost, and prove what has to be."""
        ours, copied, sizes = here.present, self._copied, self._sizes
        listed = {} if there is None else there.present
        kept = merged(here, there, numbers).present
        old = [listed[name] for name in kept if name in listed]
        wanted = [one for one in ours.values() if one.number in numbers]
        wanted += [one for one in old if self._must_prove or sizes.get(one.name) != one.bytes]
        copied.bytes = self._total = sum(one.bytes for one in wanted)
        for one in wanted:
            is_there = sizes.get(one.name) == one.bytes
            sent, target = self._sending(one), self._target
            if one.name not in ours or ours[one.name].digest != one.digest:
                if is_there:  # nothing here tells more of it than its size
                    self._count(one.bytes, False)
                else:
                    copied.lost.append(one.name)
                continue
            if is_there and target.has(sent.name, sent):
                self._count(one.bytes, False)
            else:
                target.send(sent)
                copied.sent.append(one.name)
            self._proved[one.name] = one.digest

    def _sending(self, file: File) -> Sending:
        source = self._source if file.name in self._here.present else self._others
        folder = folder_of(self._here.id)
        return Sending(source, folder, file.name, file.bytes, file.digest, self._sizes, self._count)

    def _count(self, size: int, is_sent: bool) -> None:  # noqa: FBT001 - as of Sending
        """Note bytes that were sent, or were there; wait as long as the limit of the rate asks."""
        safe_point()
        self._done += size
        self._how.progress(min(self._done, self._total), self._total)
        if is_sent:
            self._copied.sent_bytes += size
        if is_sent and self._how.limit_rate is not None:
            now = time.monotonic()
            self._due = max(self._due, now) + size / self._how.limit_rate
            pause(max(self._due - now, 0.0))

    def _publish(
        self, here: Manifest, there: Manifest | None, brought: Collection[int]
    ) -> Manifest:
        manifests, target = self._target.manifests, self._target
        new = {one.name for one in here.present.values() if one.number in brought}
        if new and not new <= target.sizes(folder_of(here.id)).keys():
            raise StoreError(  # a removal that ends takes them along
                f"Files of {here.name} have gone from {target.address} meanwhile. Copy again."
            )
        if there is None:
            # Another process may be faster.
            with suppress(RecordingExistsError), manifests.creating() as create:
                made = replace(here, name=self._how.named(here.name))
                create(made)
                return made
        return manifests.change(here.id, lambda now: merged(here, now, brought))

    def _clear(self, there: Manifest | None, now: Manifest) -> None:
        """Delete files that others have replaced, and what was left of stopped copies."""
        known = self._sizes.keys() - {MANIFEST_LOCK, WRITER_LOCK}
        left = {path for path in known if path.endswith(".part")}
        left |= known if there is None else there.present.keys()
        for path in left - now.present.keys():
            self._target.drop(f"{folder_of(now.id)}/{path}")

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
