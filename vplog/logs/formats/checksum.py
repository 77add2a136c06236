"""CRC-32 as MCAP and PNG have it, where there is ISA-L at about 13 GB/s; zlib's of Python 3.11 takes eight times as
long, and on logs with JPEGs as long as unpacking."""

from __future__ import annotations

try:
    from isal.isal_zlib import crc32
except ImportError:  # no wheel for this processor
    from zlib import crc32

__all__ = ["crc32"]
