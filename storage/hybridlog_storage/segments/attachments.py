"""Attachments: files that lie in a log beside its messages.

Their content is never held in memory as a whole: it is passed on piece by piece.
"""

from __future__ import annotations

import os
import struct
import weakref
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex
from msgspec import Struct

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import RECORD_HEAD
from hybridlog_storage.segments.compression import FilePart

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer

PIECE = 4 << 20
"""Bytes of content in memory at a time."""
MAX_HEAD = 1 << 20
"""Most bytes of the fields before the content, which hold two texts."""

_TIMES = struct.Struct("<QQ")
_TEXT = struct.Struct("<I")
_SIZE = struct.Struct("<Q")
_CRC = struct.Struct("<I")


class Attachment(Struct, frozen=True):
    """An attachment record of a file; times are ns, 0 if unknown. `data` is in the file.

    Its name need be no valid file name, and need not be unique.
    """

    log_time: int
    create_time: int
    name: str
    media_type: str
    data: FilePart

    def pieces(self) -> Iterator[bytes]:
        """The content, in pieces of at most `PIECE` bytes."""
        part = self.data.again()
        left = len(part)
        while left:
            piece = part.read(PIECE)
            if not piece:
                raise SegmentError(f"{left} bytes of the attachment {self.name!r} are missing")
            left -= len(piece)
            yield piece

    def record(self) -> Iterator[bytes]:
        """Its MCAP record, in pieces."""
        name, media_type = self.name.encode(), self.media_type.encode()
        fields = b"".join(
            (
                _TIMES.pack(self.log_time, self.create_time),
                _TEXT.pack(len(name)),
                name,
                _TEXT.pack(len(media_type)),
                media_type,
                _SIZE.pack(len(self.data)),
            )
        )
        crc = crc32(fields)
        size = len(fields) + len(self.data) + _CRC.size
        yield RECORD_HEAD.pack(Opcode.ATTACHMENT, size) + fields
        for piece in self.pieces():
            crc = crc32(piece, crc)
            yield piece
        yield _CRC.pack(crc)

    def index(self, offset: int, length: int) -> AttachmentIndex:
        """The record of the summary that lists it."""
        return AttachmentIndex(
            offset=offset,
            length=length,
            create_time=self.create_time,
            log_time=self.log_time,
            data_size=len(self.data),
            name=self.name,
            media_type=self.media_type,
        )


def parse_attachment(
    head: Buffer, part: FilePart, *, needs_crc: bool = False
) -> tuple[Attachment, int]:
    """Parse an attachment record; with it comes the size of its fields, bytes.

    `head` is the beginning of its content, up to `MAX_HEAD` bytes, `part` all of it. `needs_crc`
    compares the checksum also where it is 0, which says that there is none.
    """
    try:
        log_time, create_time = _TIMES.unpack_from(head)
        name, at = _text(head, _TIMES.size)
        media_type, at = _text(head, at)
        (size,) = _SIZE.unpack_from(head, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise SegmentError("an attachment record is damaged") from error
    at += _SIZE.size
    if at + size + _CRC.size > len(part):
        raise SegmentError("an attachment record is damaged (its content runs over its end)")
    found = Attachment(log_time, create_time, name, media_type, part.section(at, size))
    (crc,) = _CRC.unpack(part.section(at + size, _CRC.size).read())
    if crc or needs_crc:
        of_content = crc32(memoryview(head)[:at])
        for piece in found.pieces():
            of_content = crc32(piece, of_content)
        if of_content != crc:
            raise SegmentError(f"the checksum of the attachment {name!r} differs")
    return found, at + size + _CRC.size


def _text(head: Buffer, at: int) -> tuple[str, int]:
    """A text behind its length, and where it ends."""
    (size,) = _TEXT.unpack_from(head, at)
    at += _TEXT.size
    if at + size > len(head):
        raise struct.error("the text runs over the end")
    return str(memoryview(head)[at : at + size], "utf-8"), at + size


def reader_of(fd: int) -> Callable[[int, int], bytes]:
    """Reads a file by position, beside its other users and after they have closed it.

    It is closed when nothing refers to the function any more, which takes an offset and a length.
    """
    own = files.duplicate(fd)

    def read(offset: int, size: int) -> bytes:
        return files.pread(own, size, offset)

    weakref.finalize(read, os.close, own).atexit = False
    return read
