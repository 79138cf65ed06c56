"""Formats of logs that are read, and of files that are written for other tools.

`LOGS` and `OUTPUTS` list them; a reader or writer is imported when it is used.

Imports: arrays, columns, drawing, query, schema.
"""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from hybridlog.formats.reading import Source
    from hybridlog.formats.writing import Answer, Target

Content: TypeAlias = Literal["lines", "table", "log", "payloads", "points", "pictures", "video"]


class LogFormat(Struct, frozen=True):
    """A format of logs.

    Attributes:
        reader: The `Source`, as `module:name`; called with the path of a file.
        beginnings: First bytes of a file, one of these.
        suffixes: Suffixes of file names in a directory that is searched for logs.
        profile: MCAP profile of the messages, if the format tells.
        needs_suffix: Files without its suffix are no logs in such a directory.
        has_end: A complete file shows at its end that it is complete.
    """

    name: str
    files: str
    reader: str
    beginnings: tuple[bytes, ...]
    suffixes: tuple[str, ...]
    profile: str = ""
    needs_suffix: bool = False
    has_end: bool = False

    def open(self, path: Path) -> Source:
        """Open an uncompressed file."""
        source: Source = resolve_name(self.reader)(path)
        return source


LOGS: Final = (
    LogFormat(
        "ROS 1 bag",
        "ROS 1 bags (.bag, .bag.active)",
        "hybridlog.formats.rosbag1.reader:Rosbag1Source",
        (b"#ROSBAG V", b"#ROSRECORD V"),
        (".bag", ".active"),
        profile="ros1",
        has_end=True,
    ),
    LogFormat(
        "ROS 2 bag (sqlite3)",
        "ROS 2 bags (directories, .db3, .mcap, also with .zstd)",
        "hybridlog.formats.rosbag2.sqlite:SqliteSource",
        (b"SQLite format 3\0",),
        (".db3",),
        profile="ros2",
        needs_suffix=True,
    ),
    LogFormat(
        "MCAP",
        "MCAP files",
        "hybridlog.formats.mcap.reader:McapSource",
        (b"\x89MCAP",),
        (".mcap",),
        has_end=True,
    ),
)
"""Every format of logs."""


class OutputFormat(Struct, frozen=True):
    """An output format.

    Attributes:
        content: What it takes of an `Answer`: `lines` of JSON; tables (`table`); batches of
            messages for a `log`, or for a file a payload (`payloads`); `points` of clouds and
            scans; messages that are images, for `pictures` or a `video`.
        writer: Writes an answer, as `module:name`. Called with an `Answer` and a path or a
            binary stream.
        suffixes: Suffixes of file names, the usual one first; none if it writes a directory.
        is_text: It can be read on a terminal, and written a message at a time.
        is_of_places: It is for poses and places alone.
    """

    content: Content
    writer: str
    suffixes: tuple[str, ...]
    is_text: bool = False
    is_of_places: bool = False

    def write(self, answer: Answer, target: Target, **settings: Any) -> None:
        """Write an answer, all of it or nothing."""
        resolve_name(self.writer)(answer, target, **settings)


OUTPUTS: Final[dict[str, OutputFormat]] = {
    "jsonl": OutputFormat(
        "lines", "hybridlog.formats.jsonl:write_jsonl", (".jsonl", ".ndjson"), is_text=True
    ),
    "json": OutputFormat("lines", "hybridlog.formats.jsonl:write_json", (".json",), is_text=True),
    "csv": OutputFormat("table", "hybridlog.formats.tables:write_csv", (".csv",), is_text=True),
    "parquet": OutputFormat("table", "hybridlog.formats.tables:write_parquet", (".parquet",)),
    "arrow": OutputFormat("table", "hybridlog.formats.tables:write_arrow", (".arrow", ".feather")),
    "npz": OutputFormat("table", "hybridlog.formats.tables:write_npz", (".npz",)),
    "mcap": OutputFormat("log", "hybridlog.formats.mcap.writer:write_mcap", (".mcap",)),
    "bag": OutputFormat("log", "hybridlog.formats.rosbag1.writer:write_bag", (".bag",)),
    "rosbag2": OutputFormat("log", "hybridlog.formats.rosbag2.writer:write_rosbag2", ()),
    "tum": OutputFormat(
        "table", "hybridlog.formats.places:write_tum", (".tum",), is_text=True, is_of_places=True
    ),
    "geojson": OutputFormat(
        "table",
        "hybridlog.formats.places:write_geojson",
        (".geojson",),
        is_text=True,
        is_of_places=True,
    ),
    "ply": OutputFormat("points", "hybridlog.formats.files:write_ply", ()),
    "raw": OutputFormat("payloads", "hybridlog.formats.files:write_raw", ()),
    "png": OutputFormat("pictures", "hybridlog.formats.files:write_png", (".png",)),
    "jpg": OutputFormat("pictures", "hybridlog.formats.files:write_jpg", (".jpg", ".jpeg")),
    "mp4": OutputFormat("video", "hybridlog.formats.mp4:write_mp4", (".mp4",)),
}
"""Every output format by its name for `--format`."""


def formats_of(*contents: Content) -> list[str]:
    """Names of the formats with some kinds of content; without any, of all."""
    return [name for name, each in OUTPUTS.items() if not contents or each.content in contents]


def suffixes_of(names: Iterable[str]) -> dict[str, str]:
    """Some formats by the suffixes of their files."""
    return {suffix: name for name in names for suffix in OUTPUTS[name].suffixes}
