"""Images decoded by idle cores while the log is gone through, before it is known which are asked for.

The first one, since its size is that of all; of those behind it as many as there is time and room for. Of a log of
10 MB that is a tenth of the images, in time that other cores would have idled; of long ones next to nothing.
"""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple, Self

from vplog.cores import allowed
from vplog.logs.containers import part_of
from vplog.logs.frames import Decoded, image_in
from vplog.logs.images import grey, image_size
from vplog.logs.messages import BadMessageError

if TYPE_CHECKING:
    from concurrent.futures import Future

    from vplog.data import Bytes
    from vplog.logs.containers import Block, Channel, Container, Octets, Place
    from vplog.logs.messages import ImageMessage

_THREADS = 3
"""Where there may be one more: one core goes through the log, in about 15 ms for each 10 MB; three others decode some
25 images of 0.5 MP meanwhile. With a fourth the first is slower by more than is saved."""
_MOST_PX = 32 * 2**20
"""Pixels, of a byte each, that are kept until they are asked for: about 60 images of 0.5 MP."""
_WAITING = 4
"""Images that wait for each thread: what is left when the pass ends is work for nothing, but nothing is copied."""
_LARGEST = 4 * 2**20
"""Bytes of a compressed image that may wait, 48 MiB for three threads; those of 12 MP have as many."""


class _Found(NamedTuple):
    frame: str
    size: tuple[int, int]
    """px, width and height."""
    image: Bytes | None
    """None where there is no room for it."""


class EarlyImages:
    """The images of one topic, as far as they are decoded early; none where the topic is None. Close it behind the
    pass: what is begun by then may still be taken."""

    def __init__(self, container: Container, channel: Channel | None, threads: int | None = None) -> None:
        """Without `threads`, one fewer than are allowed: where that is none, none is decoded."""
        threads = min(_THREADS, allowed() - 1) if threads is None else threads
        self._container, self._channel = container, channel if threads else None
        self._pool = ThreadPoolExecutor(max(threads, 1), "vplog-early-image")
        self._begun: dict[Place, Future[_Found | None]] = {}
        self._places = threading.Semaphore(_WAITING * threads)
        self._lock = threading.Lock()
        self._left_px = _MOST_PX

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)

    def offer(self, block: Block) -> None:
        """Begin to decode images of a block, if there is room."""
        if self._channel is None or self._left_px <= 0:
            return
        for row, channel in enumerate(block.channels):
            if channel != self._channel:
                continue
            start, stop, place = block.starts[row], block.stops[row], block.places[row]
            first = not self._begun
            if not first and (stop - start > _LARGEST or not self._places.acquire(blocking=False)):
                return
            whole = stop <= len(block.data)
            data = part_of(block.data, start, stop) if whole else self._container.read(place)
            self._begun[place] = self._pool.submit(self._decode, channel, data, first)

    def frame_and_size(self, place: Place) -> tuple[str, tuple[int, int]] | None:
        """Frame, and width and height of an image; None where it was not decoded. Raises BadMessageError."""
        future = self._begun.get(place)
        found = None if future is None or future.cancelled() else future.result()
        return None if found is None else found[:2]

    def take(self, place: Place) -> Decoded | None:
        """An image, once; None where it was not decoded."""
        future = self._begun.pop(place, None)
        if future is None or future.cancelled() or self._channel is None:
            return None
        try:
            found = future.result()
        except BadMessageError as error:
            return Decoded(self._channel, None, str(error))
        return None if found is None or found.image is None else Decoded(self._channel, found.image, "")

    def forget(self) -> None:
        """Those that were not asked for."""
        self._begun.clear()

    def _decode(self, channel: Channel, data: Octets, first: bool) -> _Found | None:
        try:
            found = image_in(channel, data)
            room = self._has_room(found)
            if not room and not first:
                return None
            image = grey(found)
            return _Found(found.frame, (image.shape[1], image.shape[0]), image if room else None)
        finally:
            if not first:
                self._places.release()

    def _has_room(self, image: ImageMessage) -> bool:
        """Whether its pixels are to be kept. Those that come as they are take no time to decode: none of them is."""
        size = image_size(image.data) if image.compressed else None
        with self._lock:
            if size is not None:
                self._left_px -= size[0] * size[1]
            elif not image.compressed:
                self._left_px = 0
            return size is not None and self._left_px >= 0
