"""What the manifest of a recording becomes where the recording is copied to.

Files, channels, losses and the status come with the copy; who copies from an older one takes
nothing back. All that people said of the recording there stays, and so do its logs, which are
compared by number: whatever has expired there is not brought again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog_storage.copy_places import RefusedError
from hybridlog_storage.manifest import File, Manifest, replace

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable


def wanted(here: Manifest, there: Manifest | None, *, awaited: bool = True) -> list[File]:
    """The logs that a copy lacks.

    Args:
        here: The manifest of the source.
        there: That of the copy so far; None if it is new.
        awaited: Those, too, whose payloads were left for later.
    """
    known = {} if there is None else there.logs
    return [
        log
        for number, log in here.logs.items()
        if number not in known or (awaited and _is_awaited(here, log, there, known[number]))
    ]


def _is_awaited(here: Manifest, log: File, there: Manifest | None, known: File) -> bool:
    is_awaited = there is not None and there.lacks_payloads and known.copy != ""
    return is_awaited and not (here.lacks_payloads and log.copy)


def needs_fields(logs: Iterable[File]) -> bool:
    """True if logs have messages whose fields lie in other files."""
    return any(log.expired for log in logs)


def merged(here: Manifest, there: Manifest | None, brought: Collection[str]) -> Manifest:
    """The manifest of a copy.

    Args:
        here: That of the source.
        there: That of the copy so far; None if it is new.
        brought: Names of the logs that are there now, whole.

    Raises:
        RefusedError: They are of two recordings.
    """
    if there is None:
        return here
    check_origin(here, there)
    new = {log.number: log for log in wanted(here, there) if log.name in brought}
    logs = {**there.logs, **new}
    known = {one.file: one for one in there.fields}
    ours = {one.file: one for one in here.fields}
    others = [log for log in logs.values() if log != here.logs.get(log.number)]
    if not needs_fields(others):  # all that has expired there has expired so here
        known = {name: one for name, one in known.items() if name in ours}
    channels = {
        number: channel
        for number, channel in here.channels.items()
        if number not in there.channels or channel.messages >= there.channels[number].messages
    }
    is_newer = _messages(here) >= _messages(there)
    has_status = is_newer and (here.status != "open" or there.status == "open")
    return replace(
        there,
        files=tuple(logs.values()),
        fields=tuple({**(ours if needs_fields(new.values()) else {}), **known}.values()),
        channels={**there.channels, **channels},
        losses=here.losses if is_newer else there.losses,
        status=here.status if has_status else there.status,
        lacks_payloads=any(
            one.lacks_payloads and any(log.copy for log in of.values())
            for one, of in ((here, new), (there, logs))
        ),
    )


def _messages(manifest: Manifest) -> int:
    return sum(channel.messages for channel in manifest.channels.values())


def check_origin(here: Manifest, there: Manifest | None) -> None:
    """Raise if two manifests of one id are not of one recording.

    Raises:
        RefusedError: They are not.
    """
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
