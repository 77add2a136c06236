"""Limit of the work that one file may cause, by its size on disk."""

from __future__ import annotations

import threading

from vplog.errors import LogError

MAX_RATIO = 200
"""Maximum number of unpacked bytes per byte on disk, above FREE_BYTES. Images and numbers compress 1 to 20 fold."""
FREE_BYTES = 64 * 2**20
"""Bytes that anything may unpack to, however small it is: 64 MiB, one large raw image of a single grey."""
MESSAGE_BYTES = 256
"""Bytes that a message counts for beside its own: to list a message takes as long as to unpack these. The densest log
we know has one message per 25 bytes on disk, and MAX_RATIO allows one per 1.4 bytes."""


def max_unpacked(size: int) -> int:
    """Return the number of bytes that `size` bytes on disk may unpack to."""
    return max(FREE_BYTES, MAX_RATIO * size)


class Budget:
    """The unpacked bytes and the messages that one file may hold. Threads may share it."""

    def __init__(self, name: str, size: int) -> None:
        """`name` is what errors call the file, `size` its bytes on disk."""
        self.max_bytes = max_unpacked(size)
        self.max_messages = self.max_bytes // MESSAGE_BYTES
        self._name, self._size = name, size
        self._charged: dict[tuple[str, int], int] = {}
        self._total = 0
        self._lock = threading.Lock()

    def charge_bytes(self, chunk: int, count: int) -> None:
        """Count the bytes of a chunk, once however often it is unpacked. Raises LogError if the file has too many."""
        self._charge("bytes", chunk, count)

    def charge_messages(self, chunk: int, count: int) -> None:
        """Count the messages of a chunk, once however often it is read. Raises LogError if the file has too many."""
        self._charge("messages", chunk, MESSAGE_BYTES * count)

    def _charge(self, kind: str, chunk: int, count: int) -> None:
        with self._lock:
            self._total += count - self._charged.get((kind, chunk), 0)
            self._charged[kind, chunk] = count
            if self._total > self.max_bytes:
                raise self.error()

    def error(self) -> LogError:
        """Return the error for a file that is over its budget."""
        return LogError(
            f"{self._name} claims more content than a log of {self._size} bytes can have: {self.max_bytes >> 20} MiB, "
            f"of which each message takes {MESSAGE_BYTES} bytes. It is damaged or made to exhaust the computer. Copy "
            "or record it again."
        )
