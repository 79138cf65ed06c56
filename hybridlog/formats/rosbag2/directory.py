"""ROS 2 bag directories: `metadata.yaml`, the recorder's description, and the files it lists.

Versions 1 to 9 are parsed alike: every key is optional. Metadata with a value of the wrong type is
not used. The files themselves take precedence over it.
"""

from __future__ import annotations

from pathlib import PureWindowsPath
from typing import TYPE_CHECKING, Annotated, TypeAlias

from msgspec import Meta, Struct, ValidationError, convert, field

from hybridlog.formats.reading import Damage, cannot_open
from hybridlog.formats.yaml_values import YamlError, parse_yaml

if TYPE_CHECKING:
    from pathlib import Path


def read_metadata(folder: Path) -> tuple[BagMetadata | None, list[Damage]]:
    """The metadata of the bag in a folder, None without any, and the damage if it is unreadable."""
    path = folder / NAME
    try:
        with path.open("rb") as file:
            return parse_metadata(file.read(MAX_BYTES + 1).decode(errors="replace")), []
    except (FileNotFoundError, NotADirectoryError):
        return None, []
    except OSError as error:
        reason = f"the metadata cannot be read ({error.strerror})"
    except YamlError as error:
        reason = f"the metadata cannot be used ({error}); the files beside it are read without it"
    return None, [Damage(path, 0, None, reason, 0)]


def locate(folder: Path, metadata: BagMetadata) -> tuple[list[Path], list[Damage]]:
    """The listed files that exist, in order, and damage for others."""
    files: dict[Path, None] = {}
    missing: list[Damage] = []
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
            files[found] = None
        else:
            missing.append(Damage(path, None, None, f"the file is missing; {NAME} lists it", None))
    return [*files], missing


def plain(path: Path) -> str:
    """Name of a file before it was compressed."""
    return path.name.removesuffix(".zstd")


NAME = "metadata.yaml"

MAX_BYTES = 64 << 20
"""Largest metadata; that of 65,535 topics has about 40 MB."""

MAX_FILES = 100_000

_NO_FILES = {"", ".", ".."}
_Count: TypeAlias = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class BagMetadata(Struct, frozen=True):
    """The used part of a bag's metadata.

    Attributes:
        files: Paths of its files in order, below the bag's folder.
        message_count: Total number of messages, None if unknown.
    """

    files: list[str] = field(default_factory=list)
    message_count: int | None = None


class _File(Struct):
    path: str


class _Bag(Struct):
    files: list[_File] | None = None
    relative_file_paths: list[str] | None = None
    message_count: _Count | None = None


class _Document(Struct):
    bag: _Bag = field(name="rosbag2_bagfile_information")


def parse_metadata(text: str) -> BagMetadata:
    """Parse the metadata of a bag."""
    if len(text) > MAX_BYTES:
        raise YamlError(f"it has more than {MAX_BYTES >> 20} MiB")
    try:
        bag = convert(parse_yaml(text), _Document).bag
    except ValidationError as error:
        raise YamlError(f"it does not describe a bag: {error}") from error
    listed = bag.relative_file_paths or [file.path for file in bag.files or []]
    files = [*map(_name, listed)]
    if len(files) > MAX_FILES:
        raise YamlError(f"it lists more than {MAX_FILES} files")
    names = dict.fromkeys(name for name in files if name not in _NO_FILES)
    return BagMetadata([*names], bag.message_count)


def _name(path: str) -> str:
    """A path below the bag's folder; only the last part of any other path."""
    parts = PureWindowsPath(path)  # splits at both kinds of slashes
    is_below = not parts.anchor and ".." not in parts.parts
    return "/".join(parts.parts) if is_below else parts.name
