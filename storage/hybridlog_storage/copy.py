"""Copies a recording from a store to another one: its definitions, its files, its manifest last.

What is there already is not sent. Into a manifest that is there go files, channels, losses and
the status; what people said of the recording there stays.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from hybridlog_storage.copy_places import (
    RECORDINGS,
    SCHEMAS,
    RefusedError,
    Sending,
    digest_of,
)
from hybridlog_storage.errors import RecordingExistsError, StoreError, UsageError
from hybridlog_storage.manifest import File, Manifest, replace
from hybridlog_storage.merging import check_origin, files_of, merged
from hybridlog_storage.stopping import pause, safe_point

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog_storage.copy_places import Place, Source

_MAX_DEFINITION: Final = 64 << 20
_TRIES: Final = 3  # of a recording whose files expire meanwhile


@dataclass(frozen=True, slots=True)
class CopyOptions:
    """Options of a copy.

    Attributes:
        only_fields: Leave files for later that have the fields of others beside them: only the
            first file of each group goes, and those of kind `rows`.
        check: Prove what is there already, too, and send it again if it is wrong.
        limit_rate: Bytes a second, at most; None for no limit.
        address: Of the source, for files that stay there; empty if others cannot reach it.
        settings: Content of `hybridlog.toml`, for a place that has none.
    """

    only_fields: bool = False
    check: bool = False
    limit_rate: float | None = None
    address: str = ""
    settings: bytes = b""


@dataclass(slots=True)
class Copied:
    """The result of `copy`.

    Attributes:
        manifest: As it is there now.
        is_new: Whether the recording was not there before.
        sent: Names of the files that were sent.
        lacking: Names of files that have expired there, and are here.
        sent_bytes: Bytes of them, without those that an interrupted copy had sent.
    """

    manifest: Manifest
    is_new: bool
    sent: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    sent_bytes: int = 0


def copy(
    source: Source,
    target: Place,
    recording: str,
    options: CopyOptions | None = None,
    *,
    progress: Callable[[int, int], None] = lambda *_: None,
    named: Callable[[str], str] = lambda name: name,
    then_expire: Callable[[frozenset[int]], None] | None = None,
) -> Copied:
    """Copy a recording. What an interrupted copy has left is used by the next one.

    Args:
        source: The store that has it.
        target: Where it goes.
        recording: Its id.
        options: How it is copied.
        progress: Called with the bytes done, and those in all.
        named: Makes a free name there of its name here, if it is not there yet.
        then_expire: Called with the numbers of the files that are here, and were proved there
            just now.

    Raises:
        RefusedError: It is damaged, or another recording there has its id; others can be copied.
        UsageError: Files are to expire, and the target is this very store.
        RecordingGoneError: It is not here, or is being removed there.
        HybridlogError: A store does not answer, or cannot be written; what was copied stays.
    """
    for attempt in range(_TRIES):
        here = source.manifests.read(recording)
        try:
            return _Copy(source, target, options or CopyOptions(), progress, then_expire).run(
                here, named
            )
        except RefusedError:  # a file that has expired meanwhile is no damage
            if attempt + 1 == _TRIES or source.manifests.read(recording).files == here.files:
                raise
    raise AssertionError


class _Copy:
    """The steps of a copy."""

    def __init__(
        self,
        source: Source,
        target: Place,
        options: CopyOptions,
        progress: Callable[[int, int], None],
        then_expire: Callable[[frozenset[int]], None] | None,
    ) -> None:
        self._source = source
        self._options = options
        self._target = target
        self._progress = progress
        self._then_expire = then_expire
        self._done = self._total = 0
        self._sent_bytes = 0
        self._due = 0.0  # time from which more may be sent
        self._here: dict[str, File] = {}  # files that were sent, or proved there

    def run(self, here: Manifest, named: Callable[[str], str]) -> Copied:
        target, recording = self._target, here.id
        self._check_is_other(recording)
        with target.working(recording):
            there = target.manifests.find(recording)
            if there is None and self._options.settings:
                target.put("hybridlog.toml", self._options.settings)
            check_origin(here, there)
            self._bring_definitions(here, there)
            copied = Copied(here, there is None)
            self._bring_files(here, there, copied)
            copied.manifest = self._publish(here, there, named)
            copied.sent_bytes = self._sent_bytes
        if self._then_expire is not None:
            logs = [one for one in target.manifests.read(recording).files if one.kind == "log"]
            proved = [one.is_here and one.name in self._here for one in logs]
            others = {
                one.number for one, is_proved in zip(logs, proved, strict=True) if not is_proved
            }
            numbers = frozenset(one.number for one in logs) - others
            if numbers:
                self._then_expire(numbers)
        return copied

    def _check_is_other(self, recording: str) -> None:
        """Raise if the last copy would be deleted: both are one store, by whatever path."""
        if self._then_expire is not None:
            with self._source.marked(recording) as mark:
                if mark in self._target.sizes(f"{RECORDINGS}/{recording}"):
                    raise UsageError(f"{self._target.address} is this very store.")

    def _bring_definitions(self, here: Manifest, there: Manifest | None) -> None:
        known = {} if there is None else there.channels
        wanted = {one.schema for one in here.channels.values() if one.schema}
        wanted -= {one.schema for one in known.values()}
        if wanted:
            wanted -= self._target.sizes(SCHEMAS).keys()
        for digest in sorted(wanted):
            name = f"{SCHEMAS}/{digest}"
            content = b""
            for piece in self._source.pieces(name, 0, None):
                content += piece
                if len(content) > _MAX_DEFINITION:
                    break
            if digest_of([content]) != digest:
                raise RefusedError(f"{self._source.address}/{name} is damaged.")
            self._target.put(name, content)

    def _bring_files(self, here: Manifest, there: Manifest | None, copied: Copied) -> None:
        target, files, listed = self._target, files_of(here), files_of(there)
        must_prove = self._options.check or self._then_expire is not None
        sizes = target.sizes(f"{RECORDINGS}/{here.id}")
        wanted: list[tuple[Sending, bool]] = []

        def sending(file: File) -> Sending:
            return Sending(self._source, here.id, file, self._count, self._options.limit_rate)

        for file in self._chosen(here):
            known = listed.get(file.name)
            is_listed = known is not None and known.is_here
            if known is not None and known.gone == "expired":
                copied.lacking.append(file.name)
                continue
            expected = known if known is not None and is_listed else file
            has_size = sizes.get(file.name) == expected.bytes
            if is_listed and has_size and not must_prove:
                continue
            wanted.append((sending(expected), has_size))
            self._total += file.bytes
        for sent, has_size in wanted:
            name = sent.file.name
            if has_size and target.is_whole(sent):
                self._count(sent.file.bytes, False)
            else:
                target.send(sending(files[name]))
                copied.sent.append(name)
            self._here[name] = files[name] if name in copied.sent else sent.file
        if not self._options.only_fields:
            for name in sizes.keys() - {f".{name}.part" for name in copied.sent}:
                if name.startswith(".") and name.endswith(".part"):
                    target.drop(f"{RECORDINGS}/{here.id}/{name}")

    def _chosen(self, here: Manifest) -> list[File]:
        """The files that are to be there in the end."""
        first: dict[int, int] = {}
        for file in here.files:
            first[file.group] = min(first.get(file.group, file.number), file.number)
        all_of_it = not self._options.only_fields
        return [
            file
            for file in here.files
            if file.is_here
            and (all_of_it or file.kind == "rows" or file.number == first[file.group])
        ]

    def _count(self, size: int, is_sent: bool) -> None:  # noqa: FBT001 - as of Sending
        """Note bytes that were sent, or were there; wait as long as the limit of the rate asks."""
        safe_point()
        self._done += size
        self._progress(min(self._done, self._total), self._total)
        if is_sent:
            self._sent_bytes += size
        if is_sent and self._options.limit_rate is not None:
            now = time.monotonic()
            self._due = max(self._due, now) + size / self._options.limit_rate
            pause(max(self._due - now, 0.0))

    def _publish(
        self, here: Manifest, there: Manifest | None, named: Callable[[str], str]
    ) -> Manifest:
        manifests, address = self._target.manifests, self._options.address
        if there is None:
            try:
                with manifests.creating() as create:
                    made = merged(here, None, brought=self._here, address=address)
                    made = replace(made, name=named(here.name))
                    self._check_files(made)
                    create(made)
                return made
            except RecordingExistsError:
                pass  # another process was faster
        elif self._here:
            self._check_files(replace(here, files=tuple(self._here.values())))

        return manifests.change(here.id, partial(merged, here, brought=self._here, address=address))

    def _check_files(self, made: Manifest) -> None:
        """Raise if files are no longer there: a removal that ends takes them along."""
        sizes = self._target.sizes(f"{RECORDINGS}/{made.id}")
        if any(sizes.get(file.name) != file.bytes for file in made.files if file.is_here):
            raise StoreError(
                f"Files of {made.name} have gone from {self._target.address} meanwhile. Copy again."
            )
