"""Parses `metadata.yaml` of ROS 2 bags, the recorder's description of its files.

Versions 1 to 9 are parsed alike: every key is optional, and a value of the wrong type
counts as missing. The files themselves take precedence over it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PureWindowsPath

from hybridlog.sources.yaml_values import YamlError, parse_yaml

NAME = "metadata.yaml"

MAX_BYTES = 64 << 20
"""Largest metadata; that of 65,535 topics has about 40 MB."""

MAX_FILES = 100_000

_NO_FILES = {"", ".", ".."}
# Keys at any depth; the rest, such as the list of topics, is skipped.
_WANTED = frozenset(
    {
        "compression_mode",
        "files",
        "message_count",
        "path",
        "relative_file_paths",
        "rosbag2_bagfile_information",
        "storage_identifier",
    }
)


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """The used part of a bag's metadata.

    Attributes:
        files: Paths of its files in order, below the bag's folder.
        counts: Number of messages of each file, if stated.
        message_count: Total number of messages, None if unknown.
        packed_messages: Whether each payload is a zstd frame.
    """

    files: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    message_count: int | None = None
    packed_messages: bool = False


def parse_metadata(text: str) -> BagMetadata:
    """Parse the metadata of a bag.

    Raises:
        YamlError: It is not YAML or not that of a bag, or too large.
    """
    if len(text) > MAX_BYTES:
        raise YamlError(f"it has more than {MAX_BYTES >> 20} MiB")
    bag = _mapping(parse_yaml(text, _WANTED))
    # The copy in a database has no outer key.
    bag = bag if "storage_identifier" in bag else _mapping(bag.get("rosbag2_bagfile_information"))
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
    mode = bag.get("compression_mode")
    return BagMetadata(
        files=list(dict.fromkeys(name for name in files if name not in _NO_FILES)),
        counts=counts,
        message_count=total,
        packed_messages=isinstance(mode, str) and mode.lower() == "message",
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
