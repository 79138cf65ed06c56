"""The checksum of MCAP: CRC-32 as in zlib, by a library that computes it at memory speed."""

from __future__ import annotations

from isal.isal_zlib import crc32, crc32_combine

__all__ = ["crc32", "crc32_combine"]
