"""The chunks of a file, unpacked: the next ones by other threads, the last ones cached."""

from __future__ import annotations

import itertools
import os
import threading
import time
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import BinaryIO

from vplog.execution.cores import allowed
from vplog.logs.formats.compression import BadChunkError
from vplog.logs.formats.container import RawData

MOST_BYTES = 64 * 2**20
"""Bytes of unpacked chunks that a process caches: neighbouring chunks of image and depth are not unpacked twice."""
_THREADS = 2
"""Threads that read ahead: each unpacks about 1 GB/s, and images are read twice as fast; more cost more than they
save."""
_ALONE_S = 0.02
"""Seconds of unpacking before other threads help: to start them and to hand over costs a few ms."""
_LEAST_BYTES = 64 * 2**10
"""Size of a chunk from which another thread unpacks it: handing over takes as long as some 50 kB."""
_AHEAD_BYTES = 32 * 2**20
"""Bytes of unpacked chunks that wait to be gone through; a chunk larger than that is unpacked when its turn comes."""
_VIEWED = 4 * 2**20
"""Bytes of a chunk up to which its images are not copied: each that waits to be decoded may keep another."""


class _RecentChunks:
    """The chunks last used by any file of the process: a drive may have a hundred files, and each of them chunks."""

    def __init__(self) -> None:
        self._chunks: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: tuple[int, int]) -> bytes | None:
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
            return self._chunks.get(key)

    def put(self, key: tuple[int, int], data: bytes) -> None:
        with self._lock:
            self._bytes += len(data) - len(self._chunks.pop(key, b""))
            self._chunks[key] = data
            while self._bytes > MOST_BYTES and len(self._chunks) > 1:
                self._bytes -= len(self._chunks.popitem(last=False)[1])

    def forget(self, file: int) -> None:
        with self._lock:
            for key in [key for key in self._chunks if key[0] == file]:
                self._bytes -= len(self._chunks.pop(key))


_RECENT = _RecentChunks()
_FILES = itertools.count()


class Chunks:
    """The chunks of one file by number; a damaged one is empty."""

    def __init__(
        self,
        load: Callable[[int], bytes],
        damaged: Callable[[int, BadChunkError], None],
        size: Callable[[int], int],
        packed: Callable[[int], bool],
        threads: bool,
    ) -> None:
        """`load` reads and unpacks one, in any thread where `threads`; for its BadChunkError `damaged` is called in the
        thread of the caller. `size` is its unpacked size, `packed` whether it is cached."""
        self._load, self._damaged, self._size, self._packed = load, damaged, size, packed
        self._threads = min(_THREADS, allowed()) if threads else 0
        self._file = next(_FILES)
        weakref.finalize(self, _RECENT.forget, self._file)

    def __call__(self, number: int) -> bytes:
        recent = _RECENT.get((self._file, number))
        return self._take(number, lambda: self._load(number)) if recent is None else recent

    def part(self, number: int, start: int, stop: int) -> RawData:
        """Bytes of a chunk where they lie, which keeps all of it; a copy of those of a large one."""
        data = self(number)
        return memoryview(data)[start:stop] if len(data) <= _VIEWED else data[start:stop]

    def iterate(
        self, numbers: Iterable[int], in_place: Callable[[int], bool] = lambda _: False
    ) -> Generator[tuple[int, bytes | None]]:
        """Each number with its chunk, None where it is read `in_place`. The next ones are unpacked meanwhile once that
        saves time; reading only the first message of a topic starts no thread."""
        numbers, spent_s, pool = iter(numbers), 0.0, None
        waiting: deque[tuple[int, Future[bytes] | None]] = deque()
        following = next(numbers, None)
        try:
            while waiting or following is not None:
                while following is not None and len(waiting) < (2 * self._threads if pool else 1):
                    size = self._size(following)
                    if waiting and sum(self._size(number) for number, _ in waiting) + size > _AHEAD_BYTES:
                        break
                    handed = _LEAST_BYTES <= size <= _AHEAD_BYTES and not in_place(following)
                    handed = handed and _RECENT.get((self._file, following)) is None
                    waiting.append((following, pool.submit(self._load, following) if pool and handed else None))
                    following = next(numbers, None)
                began_s, (number, future) = time.perf_counter(), waiting.popleft()
                if future is not None:
                    data = self._take(number, future.result)
                else:
                    data = None if in_place(number) else self(number)
                spent_s += time.perf_counter() - began_s
                yield number, data
                if pool is None and self._threads and spent_s >= _ALONE_S:
                    pool = ThreadPoolExecutor(self._threads, "vplog-read-ahead")
        finally:
            if pool is not None:
                pool.shutdown(cancel_futures=True)

    def _take(self, number: int, loaded: Callable[[], bytes]) -> bytes:
        try:
            data = loaded()
        except BadChunkError as error:
            self._damaged(number, error)
            data = b""
        if self._packed(number):
            _RECENT.put((self._file, number), data)
        return data


def reader_at(file: BinaryIO, local: bool) -> Callable[[int, int], bytes]:
    """A function (start, length) that reads bytes of a file; of a local one, from several threads at once."""
    if local and hasattr(os, "pread"):
        number = file.fileno()

        def read_at(start: int, length: int) -> bytes:
            data = os.pread(number, length, start)
            while len(data) < length and (more := os.pread(number, length - len(data), start + len(data))):
                data += more  # one call gives at most 2 GB
            return data

        return read_at
    lock = threading.Lock()

    def seek_and_read(start: int, length: int) -> bytes:
        with lock:
            file.seek(start)
            return file.read(length)

    return seek_and_read
