"""The checksum of MCAP: CRC-32 as in zlib, computed at memory speed by isal."""

from __future__ import annotations

from isal.isal_zlib import crc32

__all__ = ["crc32"]
