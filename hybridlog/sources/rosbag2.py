"""ROS 2 bag directories: `metadata.yaml` and the files it lists."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.sources.base import Damage, cannot_open
from hybridlog.sources.rosbag2_metadata import MAX_BYTES, NAME, BagMetadata, parse_metadata
from hybridlog_storage.errors import SourceError

if TYPE_CHECKING:
    from pathlib import Path


def read_metadata(folder: Path) -> BagMetadata | Damage | None:
    """Read the metadata of the bag in a folder.

    Returns:
        The metadata, the damage if it cannot be read, or None without metadata.
    """
    path = folder / NAME
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        return Damage(path, 0, None, f"the metadata cannot be read ({error.strerror})", 0)
    found = parse_metadata(data.decode(errors="replace"))
    if found is None:
        reason = "the metadata is damaged; the files beside it are read without it"
        return Damage(path, 0, len(data), reason, 0)
    return found


def locate(folder: Path, metadata: BagMetadata) -> tuple[list[Path], list[Damage]]:
    """Find the files that the metadata lists.

    Returns:
        The existing files, in order, and the damage for missing ones.

    Raises:
        SourceError: None of them exists.
    """
    files: list[Path] = []
    missing: list[Damage] = []
    for name in metadata.files:
        path = folder / name
        # Some recorders list compressed files under their name before compression.
        choices = (path, path.with_name(path.name + ".zstd"), path.with_suffix(""))
        try:
            found = next((choice for choice in choices if choice.is_file()), None)
        except OSError as error:
            raise cannot_open(path, error) from error
        if found is not None:
            files.append(found)
            continue
        reason = f"the file is missing; {NAME} lists it"
        missing.append(Damage(path, None, None, reason, metadata.counts.get(name)))
    if not files:
        listed = ", ".join(metadata.files[:5]) or "no file"
        raise SourceError(
            f"{folder}: none of the files that its {NAME} lists is there ({listed}); put them "
            "beside it, or give the path of the file itself"
        )
    return files, missing
