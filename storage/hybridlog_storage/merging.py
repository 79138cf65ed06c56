"""The manifest that a recording gets where it is copied to.

Files, channels, losses and the status come with the copy; who copies from an older one takes
nothing back. All that people said of the recording there stays, and so do its logs, which are
compared by number: one that has expired there is not brought again, one that was left elsewhere
is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog_storage.copy_places import RefusedError
from hybridlog_storage.manifest import File, Manifest, replace

if TYPE_CHECKING:
    from collections.abc import Collection


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
