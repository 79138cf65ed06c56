"""The folders of a recording that hold files of payloads."""

from __future__ import annotations

import stat
from contextlib import suppress
from typing import TYPE_CHECKING

from hybridlog.payloads.layout import IN_PAYLOADS, PARTS, PAYLOADS
from hybridlog_storage import durability, files

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from hybridlog_storage.journal import PayloadFile


def names_of(recording: Path, folder: str = PAYLOADS) -> list[str]:
    """Paths of all files below `payloads`, or below the folder of unfinished files.

    Args:
        recording: The recording's directory.
        folder: Name of the folder.

    Raises:
        OSError: It cannot be read.
    """
    found = []
    with suppress(FileNotFoundError):
        for topic, about in files.names(recording / folder, depth=files.IN_RECORDING).items():
            if not stat.S_ISDIR(about.st_mode):
                found.append(topic)
                continue
            inside = files.names(recording / folder / topic, depth=IN_PAYLOADS - 1)
            found += [f"{topic}/{name}" for name in inside]
    return sorted(found)


def publish(recording: Path, listed: Mapping[str, PayloadFile]) -> None:
    """Give finished files their names, and remove the folder of unfinished files.

    Args:
        recording: The recording's directory, locked by this process.
        listed: The files that the journal lists.

    Raises:
        HybridlogError: A file cannot be renamed or removed.
    """
    parts, final = recording / PARTS, recording / PAYLOADS
    try:
        names = names_of(recording, PARTS)
        moved = [name for name in names if name in listed]
        for name in moved:
            folder = (final / name).parent
            files.make_folders(folder, depth=IN_PAYLOADS - 1)
            files.rename(parts / name, final / name, depth=IN_PAYLOADS, new_depth=IN_PAYLOADS)
            files.sync_folder(folder, depth=IN_PAYLOADS - 1)
        if moved:
            files.sync_folder(final, depth=files.IN_RECORDING)
            files.sync_folder(recording)
        files.remove_tree(parts, depth=files.IN_RECORDING)
    except OSError as error:
        raise durability.explain(error, final, "moving payloads to") from error
