"""Fingerprints of logs, to recognize content without reading all of it."""

from __future__ import annotations

from hashlib import blake2b
from typing import TYPE_CHECKING, NamedTuple

from hybridlog.formats.reading import cannot_open

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

WHOLE = 4 << 20
"""Largest file that is read whole, bytes."""

SAMPLES = 256
SAMPLE_BYTES = 16 << 10


class Fingerprint(NamedTuple):
    """The fingerprint of a log.

    Attributes:
        whole: Of all its files in their order, 32 hexadecimal digits.
        parts: Of each file, as if it were a log of its own.
    """

    whole: str
    parts: tuple[str, ...]


def fingerprint(files: Sequence[Path]) -> Fingerprint:
    """Compute the fingerprint of files in their order; their names do not matter.

    It covers the size of each file and its whole content up to `WHOLE` bytes. Larger files
    are covered by `SAMPLES` evenly spaced samples, the first at the start and the last at
    the end.

    Raises:
        SourceError: A file is missing or cannot be read.
    """
    whole, parts = blake2b(digest_size=16), []
    for path in files:
        part = blake2b(digest_size=16)
        try:
            with path.open("rb", buffering=SAMPLE_BYTES) as file:
                size = file.seek(0, 2)
                _add(size.to_bytes(8, "little"), whole, part)
                if size <= WHOLE:
                    starts, count = [0], size
                else:
                    last = size - SAMPLE_BYTES
                    starts = [last * number // (SAMPLES - 1) for number in range(SAMPLES)]
                    count = SAMPLE_BYTES
                for start in starts:
                    file.seek(start)
                    _add(file.read(count), whole, part)
        except OSError as error:
            raise cannot_open(path, error) from error
        parts.append(part.hexdigest())
    return Fingerprint(whole.hexdigest(), tuple(parts))


def _add(data: bytes, *digests: blake2b) -> None:
    for digest in digests:
        digest.update(data)
