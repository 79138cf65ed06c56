"""Writes images: a directory with a file a message, or one image."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.formats.raw import PICTURE_SUFFIXES, DirectoryWriter
from hybridlog.formats.writing import FileWriter, Sink, Target
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.drawing.images import Picture
    from hybridlog.message import Message


class PicturesWriter(DirectoryWriter):
    """Writes a directory of images, laid out as payload files are."""

    def write(self, message: Message, picture: Picture) -> None:
        """Append an image.

        Args:
            message: Where it comes from.
            picture: The file.

        Raises:
            DiskFullError: No space left.
        """
        about = {
            "topic": message.topic,
            "type": message.type,
            "media_type": picture.media_type,
            "recording": message.recording,
            "log_time_ns": message.log_time_ns,
            "publish_time_ns": message.publish_time_ns,
            "sequence": message.sequence,
            "length": len(picture.data),
        }
        self.add(picture.data, picture.suffix, about)


class PictureWriter(FileWriter):
    """Writes one image.

    Args:
        target: Path, whose suffix must be that of the image; or a binary stream.

    Raises:
        UsageError: It cannot be written.
    """

    def __init__(self, target: Target) -> None:
        super().__init__()
        self._sink = Sink(target)
        self._is_written = False
        self._suffix = suffix_of(target) if isinstance(target, str | os.PathLike) else None

    def write(self, _: Message, picture: Picture) -> None:
        """Write the image.

        Raises:
            UsageError: It is the second one, or of another format than the name says.
            DiskFullError: No space left.
        """
        if self._is_written:
            raise UsageError(
                "There are several images: name a directory for them, without a suffix, or choose "
                "one with --at or --limit 1."
            )
        if self._suffix not in {None, picture.suffix}:
            raise UsageError(
                f"The image is {picture.media_type}: end the name of the file in {picture.suffix}, "
                f"not {self._suffix}."
            )
        self._sink.write(picture.data)
        self._is_written = True

    def _finish(self) -> None:
        if not self._is_written:
            raise UsageError("There is no image in this answer.")
        self._sink.commit()

    def _discard(self) -> None:
        self._sink.abort()


def suffix_of(target: str | os.PathLike[str]) -> str | None:
    """The suffix that an image must have for a file of that name; None for a directory."""
    suffix = Path(target).suffix.lower()
    suffix = {".jpeg": ".jpg", ".tiff": ".tif"}.get(suffix, suffix)
    return suffix if suffix in PICTURE_SUFFIXES else None


def open_pictures_writer(target: Target) -> PicturesWriter | PictureWriter:
    """A writer of one image for a stream or a name with the suffix of one; else of a directory."""
    if isinstance(target, str | os.PathLike) and suffix_of(target) is None:
        return PicturesWriter(target)
    return PictureWriter(target)
