"""Writers of files for other tools. `FORMATS` lists them; a writer is imported when it is used."""

from __future__ import annotations

from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from hybridlog.export.base import Target

Content: TypeAlias = Literal["lines", "table", "log", "payloads", "pictures"]


@dataclass(frozen=True, slots=True)
class Format:
    """An output format.

    Attributes:
        content: What its writer takes: `lines` of JSON, one a message; Arrow tables (`table`);
            batches of messages for a `log`, or for a file a payload (`payloads`); `pictures`.
        writer: The writer, as `module:name`. Called with a path or a binary stream, and with
            the `schema` of tables.
        suffixes: Suffixes of file names, the usual one first; none if it writes a directory.
        is_text: It can be read on a terminal, and written a message at a time.
        has_profile: The writer takes the MCAP `profile` of the messages, too.
    """

    content: Content
    writer: str
    suffixes: tuple[str, ...]
    is_text: bool = False
    has_profile: bool = False

    def open(self, target: Target, **options: Any) -> Any:
        """Open a writer of `hybridlog.export.base`, according to `content`.

        Raises:
            UsageError: The target cannot be written.
        """
        return resolve_name(self.writer)(target, **options)


FORMATS: Final[dict[str, Format]] = {
    "jsonl": Format(
        "lines", "hybridlog.export.jsonl:JsonlWriter", (".jsonl", ".ndjson"), is_text=True
    ),
    "csv": Format("table", "hybridlog.export.tables:CsvWriter", (".csv",), is_text=True),
    "parquet": Format("table", "hybridlog.export.tables:ParquetWriter", (".parquet",)),
    "arrow": Format("table", "hybridlog.export.tables:ArrowWriter", (".arrow", ".feather")),
    "npz": Format("table", "hybridlog.export.npz:NpzWriter", (".npz",)),
    "mcap": Format("log", "hybridlog.export.mcap:McapWriter", (".mcap",), has_profile=True),
    "bag": Format("log", "hybridlog.export.bag:BagWriter", (".bag",)),
    "raw": Format("payloads", "hybridlog.export.raw:open_raw_writer", ()),
    "png": Format("pictures", "hybridlog.export.pictures:open_pictures_writer", (".png",)),
    "jpg": Format("pictures", "hybridlog.export.pictures:open_pictures_writer", (".jpg", ".jpeg")),
}
"""Every output format by its name for `--format`; pictures are for messages that are images."""


def formats_of(*contents: Content) -> list[str]:
    """Names of the formats with some kinds of content; without any, of all."""
    return [name for name, each in FORMATS.items() if not contents or each.content in contents]


def suffixes_of(names: Iterable[str]) -> dict[str, str]:
    """Some formats by the suffixes of their files."""
    return {suffix: name for name in names for suffix in FORMATS[name].suffixes}


def is_directory(name: str, path: Path) -> bool:
    """True if a format writes a directory with a file a message to this path."""
    if FORMATS[name].content == "pictures":
        from hybridlog.export.pictures import suffix_of

        return suffix_of(path) is None
    return not FORMATS[name].suffixes
