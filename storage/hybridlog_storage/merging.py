"""What the manifest of a recording becomes where the recording is copied to.

Files, channels, losses and the status come with the copy; who copies from an older one takes
nothing back. All that people said of the recording there stays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog_storage.copy_places import RefusedError
from hybridlog_storage.manifest import File, Manifest, replace

if TYPE_CHECKING:
    from collections.abc import Mapping


def merged(
    here: Manifest, there: Manifest | None, *, brought: Mapping[str, File], address: str
) -> Manifest:
    """The manifest of a copy.

    Args:
        here: That of the source.
        there: That of the copy so far; None if it is new.
        brought: Files that were sent, or proved there, by name.
        address: Of the source, where other files stay.

    Raises:
        RefusedError: They are of two recordings.
    """
    known = files_of(there)
    files = {file.name: _file(file, known.get(file.name), brought, address) for file in here.files}
    if there is None:
        return replace(here, files=tuple(files.values()))
    check_origin(here, there)
    files |= {name: file for name, file in known.items() if name not in files}
    channels = {
        number: channel
        for number, channel in here.channels.items()
        if number not in there.channels or channel.messages >= there.channels[number].messages
    }
    is_newer = _messages(here) >= _messages(there)
    has_status = is_newer and (here.status != "open" or there.status == "open")
    return replace(
        there,
        files=tuple(files.values()),
        channels={**there.channels, **channels},
        losses=here.losses if is_newer else there.losses,
        status=here.status if has_status else there.status,
    )


def _file(file: File, known: File | None, brought: Mapping[str, File], address: str) -> File:
    if file.name in brought and (known is None or known.gone != "expired"):
        return brought[file.name]
    if known is not None:
        return known
    return replace(file, gone="elsewhere", copy=address) if file.is_here else file


def files_of(manifest: Manifest | None) -> dict[str, File]:
    """The files of a manifest by name."""
    return {} if manifest is None else {file.name: file for file in manifest.files}


def _messages(manifest: Manifest) -> int:
    return sum(channel.messages for channel in manifest.channels.values())


def check_origin(here: Manifest, there: Manifest | None) -> None:
    """Raise if two manifests of one id are not of one recording.

    Raises:
        RefusedError: They are not.
    """
    if there is None:
        return
    known, channels = files_of(there), there.channels
    is_one = (
        here.created == there.created
        and all(
            channels[number].topic == one.topic and channels[number].schema == one.schema
            for number, one in here.channels.items()
            if number in channels
        )
        and all(
            known[file.name].digest == file.digest
            for file in here.files
            if file.kind == "log" and file.name in known
        )
    )
    if not is_one:
        raise RefusedError(
            f"{here.name} is not copied: another recording, {there.name}, has its id {here.id} "
            "there."
        )
