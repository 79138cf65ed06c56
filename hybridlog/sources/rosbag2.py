"""ROS 2 bag directories: `metadata.yaml` and the files it lists."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.sources.base import Damage, cannot_open
from hybridlog.sources.rosbag2_metadata import MAX_BYTES, NAME, BagMetadata, parse_metadata
from hybridlog.sources.yaml_values import YamlError

if TYPE_CHECKING:
    from pathlib import Path

_MOST_MISSING = 100  # files that are reported one by one


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
    try:
        return parse_metadata(data.decode(errors="replace"))
    except YamlError as error:
        reason = f"the metadata cannot be used ({error}); the files beside it are read without it"
        return Damage(path, 0, len(data), reason, 0)


def locate(folder: Path, metadata: BagMetadata) -> tuple[dict[Path, int | None], list[Damage]]:
    """Find the files that the metadata lists.

    Returns:
        The existing files, in order, with their number of messages as listed; and the damage
        for missing ones.

    Raises:
        SourceError: The folder cannot be read.
    """
    files: dict[Path, int | None] = {}
    absent: list[str] = []
    for name in metadata.files:
        path = folder / name
        # Some recorders list compressed files under their name before compression, and early
        # ones with the folder's name before it.
        choices = [
            choice
            for each in dict.fromkeys((path, folder / path.name))
            for choice in (each, each.with_name(f"{each.name}.zstd"), each.with_name(plain(each)))
        ]
        try:
            found = next((choice for choice in choices if choice.is_file()), None)
        except OSError as error:
            raise cannot_open(path, error) from error
        if found is not None:
            files.setdefault(found, metadata.counts.get(name))
        else:
            absent.append(name)
    return files, _missing(folder, metadata, absent)


def plain(path: Path) -> str:
    """Name of a file before it was compressed."""
    return path.name.removesuffix(".zstd")


def _missing(folder: Path, metadata: BagMetadata, names: list[str]) -> list[Damage]:
    """The damage for missing files; many are counted together."""
    damage = [
        Damage(
            folder / name,
            None,
            None,
            f"the file is missing; {NAME} lists it",
            metadata.counts.get(name),
        )
        for name in names[:_MOST_MISSING]
    ]
    if more := names[_MOST_MISSING:]:
        counts = [metadata.counts.get(name) for name in more]
        known = [count for count in counts if count is not None]
        lost = sum(known) if len(known) == len(counts) else None
        reason = f"{len(more)} more files that it lists are missing"
        damage.append(Damage(folder / NAME, None, None, reason, lost))
    return damage
