"""Writes images: a directory with a file a message, or one image."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from hybridlog.drawing.images import Picture, picture
from hybridlog.formats.answer import Answer
from hybridlog.formats.raw import PICTURE_SUFFIXES, Directory
from hybridlog.formats.writing import Sink, Target
from hybridlog_storage.errors import DefinitionError, PayloadError, UsageError

if TYPE_CHECKING:
    from hybridlog.message import Message

_Form = Literal["png", "jpg"]


def _write(form: _Form, answer: Answer, target: Target) -> None:
    """Write one image to a stream or a name with the suffix of one; else a directory."""
    suffix = suffix_of(target) if isinstance(target, str | os.PathLike) else None
    if suffix is None and isinstance(target, str | os.PathLike):
        with Directory(target) as folder:
            for message, made in _pictures(form, answer):
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
                folder.add(made.data, made.suffix, about)
        return
    with Sink(target) as sink:
        for _, made in _pictures(form, answer):
            if sink.tell():
                raise UsageError(
                    "There are several images: name a directory for them, without a suffix, or "
                    "choose one with --at or --limit 1."
                )
            if suffix not in {None, made.suffix}:
                raise UsageError(
                    f"The image is {made.media_type}: end the name of the file in {made.suffix}, "
                    f"not {suffix}."
                )
            sink.write(made.data)
        if not sink.tell():
            raise UsageError("There is no image in this answer.")


def _pictures(form: _Form, answer: Answer) -> Iterator[tuple[Message, Picture]]:
    for message in answer.messages:
        try:
            made = picture(message, form=form)
        except (PayloadError, DefinitionError) as error:
            answer.unreadable.append(error)
        else:
            yield message, made


def suffix_of(target: str | os.PathLike[str]) -> str | None:
    """The suffix that an image must have for a file of that name; None for a directory."""
    suffix = Path(target).suffix.lower()
    suffix = {".jpeg": ".jpg", ".tiff": ".tif"}.get(suffix, suffix)
    return suffix if suffix in PICTURE_SUFFIXES else None


write_png: Final = partial(_write, "png")
write_jpg: Final = partial(_write, "jpg")
