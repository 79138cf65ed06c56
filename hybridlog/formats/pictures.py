"""Writes images: a directory with a file a message, or one image."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from hybridlog.drawing.images import picture
from hybridlog.formats.raw import PICTURE_SUFFIXES, DirectoryWriter
from hybridlog.formats.writing import FileWriter, Sink, Target
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.message import Message

_Form = Literal["png", "jpg"]


class PicturesWriter(DirectoryWriter):
    """Writes a directory of images, laid out as payload files are.

    Args:
        target: The directory.
        form: Format of images that are no file yet.
    """

    def __init__(self, target: str | os.PathLike[str], form: _Form) -> None:
        super().__init__(target)
        self._form: _Form = form

    def write(self, message: Message) -> None:
        """Append the image of a message.

        Raises:
            PayloadError: The message has none.
            DefinitionError: No usable definition exists.
            DiskFullError: No space left.
        """
        made = picture(message, form=self._form)
        about = {
            "topic": message.topic,
            "type": message.type,
            "media_type": made.media_type,
            "recording": message.recording,
            "log_time_ns": message.log_time_ns,
            "publish_time_ns": message.publish_time_ns,
            "sequence": message.sequence,
            "length": len(made.data),
        }
        self.add(made.data, made.suffix, about)


class PictureWriter(FileWriter):
    """Writes one image.

    Args:
        target: Path, whose suffix must be that of the image; or a binary stream.
        form: Format of images that are no file yet.

    Raises:
        UsageError: It cannot be written.
    """

    def __init__(self, target: Target, form: _Form) -> None:
        super().__init__()
        self._form: _Form = form
        self._sink = Sink(target)
        self._is_written = False
        self._suffix = suffix_of(target) if isinstance(target, str | os.PathLike) else None

    def write(self, message: Message) -> None:
        """Write the image of a message.

        Raises:
            UsageError: It is the second one, or of another format than the name says.
            PayloadError: The message has none.
            DefinitionError: No usable definition exists.
            DiskFullError: No space left.
        """
        made = picture(message, form=self._form)
        if self._is_written:
            raise UsageError(
                "There are several images: name a directory for them, without a suffix, or choose "
                "one with --at or --limit 1."
            )
        if self._suffix not in {None, made.suffix}:
            raise UsageError(
                f"The image is {made.media_type}: end the name of the file in {made.suffix}, "
                f"not {self._suffix}."
            )
        self._sink.write(made.data)
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


def _open(form: _Form, target: Target) -> PicturesWriter | PictureWriter:
    """A writer of one image for a stream or a name with the suffix of one; else of a directory."""
    if isinstance(target, str | os.PathLike) and suffix_of(target) is None:
        return PicturesWriter(target, form)
    return PictureWriter(target, form)


open_png_writer: Final = partial(_open, "png")
open_jpg_writer: Final = partial(_open, "jpg")
