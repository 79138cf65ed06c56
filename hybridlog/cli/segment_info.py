"""`hybridlog info SEGMENT`: prints the summary of a segment file."""

from __future__ import annotations

from pathlib import Path

from hybridlog.cli import output
from hybridlog_storage.errors import StoreError


def show_segment(path: Path, *, as_json: bool) -> None:
    """Print the summary of a sealed segment.

    Raises:
        StoreError: It is being written, or is no segment of a store.
    """
    from hybridlog_storage.segments.segment_reader import SegmentReader

    stem = path.name.split(".")[0]
    if path.name.endswith(".open"):
        raise StoreError(
            f"{path} is being written, or was left by a crash. Any command on its store, such as "
            "`hybridlog ls --store DIR`, seals segments that a crash left."
        )
    if not path.is_file():
        raise StoreError(f"{path} is no file; a segment is a file that ends in .mcap.")
    _check_magic(path)
    number = int(stem) if stem.isascii() and stem.isdigit() else 0
    with SegmentReader(path, number) as reader:
        summary = reader.summary()
        bytes_all = reader.size
    chunks = summary.chunks
    channels = [
        {
            "topic": channel.topic,
            "type": channel.schema.name if channel.schema is not None else None,
            "messages": summary.counts.get(channel_id, 0),
            "chunks": sum(channel_id in place.channels for place in chunks),
        }
        for channel_id, channel in sorted(summary.channels.items())
    ]
    first = min((place.first for place in chunks), default=None)
    last = max((place.last for place in chunks), default=None)
    if as_json:
        output.print_json(
            {
                "segment": str(path),
                "bytes": bytes_all,
                "recording": summary.recording,
                "end": summary.end,
                "first_ns": first,
                "last_ns": last,
                "chunks": len(chunks),
                "channels": channels,
            }
        )
        return
    from hybridlog.query.times import format_time

    output.print_table(
        [("segment", "left"), (str(path), "left")],
        [
            ("recording", str(summary.recording.get("name"))),
            ("id", str(summary.recording.get("id"))),
            ("start", format_time(first) if first is not None else "-"),
            ("last", format_time(last) if last is not None else "-"),
            ("bytes", output.size(bytes_all)),
            ("chunks", str(len(chunks))),
            ("messages", str(sum(summary.counts.values()))),
        ],
    )
    output.say()
    output.print_table(
        [("topic", "left"), ("type", "left"), ("messages", "right"), ("chunks", "right")],
        [
            (str(c["topic"]), str(c["type"] or ""), str(c["messages"]), str(c["chunks"]))
            for c in channels
        ],
    )


def _check_magic(path: Path) -> None:
    """Tell another file from a damaged segment."""
    from hybridlog_storage.mcap.mcap_scan import MAGIC

    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC))
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror}.") from error
    if begins != MAGIC:
        raise StoreError(
            f"{path} is no segment of a hybridlog store. If it is a log, `hybridlog record {path}` "
            "records it."
        )
