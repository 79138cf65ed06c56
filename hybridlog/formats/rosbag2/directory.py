"""ROS 2 bag directories: `metadata.yaml`, the recorder's description, and the files it lists.

Versions 1 to 9 are parsed alike: every key is optional, and a value of the wrong type
counts as missing. The files themselves take precedence over it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PureWindowsPath
from typing import TYPE_CHECKING

from msgspec import Struct, field

from hybridlog.formats.reading import Damage, cannot_open
from hybridlog.formats.yaml_values import YamlError, parse_yaml

if TYPE_CHECKING:
    from pathlib import Path


def read_metadata(folder: Path) -> BagMetadata | Damage | None:
    """The metadata of the bag in a folder, the damage if it is unreadable, None without any."""
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
    """The listed files that exist, in order, with their listed messages; and damage for others."""
    files: dict[Path, int | None] = {}
    missing: list[Damage] = []
    for name in metadata.files:
        path, count = folder / name, metadata.counts.get(name)
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
            files.setdefault(found, count)
        else:
            missing.append(Damage(path, None, None, f"the file is missing; {NAME} lists it", count))
    return files, missing


def plain(path: Path) -> str:
    """Name of a file before it was compressed."""
    return path.name.removesuffix(".zstd")


NAME = "metadata.yaml"

MAX_BYTES = 64 << 20
"""Largest metadata; that of 65,535 topics has about 40 MB."""

MAX_FILES = 100_000

_NO_FILES = {"", ".", ".."}


class BagMetadata(Struct, frozen=True):
    """The used part of a bag's metadata.

    Attributes:
        files: Paths of its files in order, below the bag's folder.
        counts: Number of messages of each file, if stated.
        message_count: Total number of messages, None if unknown.
    """

    files: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    message_count: int | None = None


def parse_metadata(text: str) -> BagMetadata:
    """Parse the metadata of a bag."""
    if len(text) > MAX_BYTES:
        raise YamlError(f"it has more than {MAX_BYTES >> 20} MiB")
    bag = _mapping(parse_yaml(text))
    bag = _mapping(bag.get("rosbag2_bagfile_information"))
    if not bag:
        raise YamlError("it does not describe a bag")
    listed = _list(bag.get("files"))
    counts: dict[str, int] = {}
    for entry in map(_mapping, listed):
        count = _count(entry.get("message_count"))
        if isinstance(entry.get("path"), str) and count is not None:
            counts[_name(str(entry["path"]))] = count
    paths = [item for item in _list(bag.get("relative_file_paths")) if isinstance(item, str)]
    files = [_name(item) for item in paths] or list(counts)
    if len(files) > MAX_FILES:
        raise YamlError(f"it lists more than {MAX_FILES} files")
    total = _count(bag.get("message_count"))
    return BagMetadata(
        files=list(dict.fromkeys(name for name in files if name not in _NO_FILES)),
        counts=counts,
        message_count=total,
    )


def _mapping(value: object) -> Mapping[object, object]:
    return value if isinstance(value, Mapping) else {}


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) else []


def _count(value: object) -> int | None:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**63:
        return None
    return value


def _name(path: str) -> str:
    """A path below the bag's folder; only the last part of any other path."""
    parts = PureWindowsPath(path)  # splits at both kinds of slashes
    is_below = not parts.anchor and ".." not in parts.parts
    return "/".join(parts.parts) if is_below else parts.name
