"""The few chunks last unpacked, kept while neighbouring messages are read."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

KEPT = 4
"""Chunks kept: image and depth lie in neighbouring chunks, each about 1 MB in common writers."""
MOST_BYTES = 64 * 2**20
"""Bytes above which only the last chunk is kept, whatever their size."""


class ChunkCache:
    """Remembers what `load(number)` gave for the last few numbers."""

    def __init__(self, load: Callable[[int], bytes]) -> None:
        self._load = load
        self._kept: OrderedDict[int, bytes] = OrderedDict()

    def __call__(self, number: int) -> bytes:
        if number not in self._kept:
            self._kept[number] = self._load(number)
            while len(self._kept) > KEPT or (len(self._kept) > 1 and sum(map(len, self._kept.values())) > MOST_BYTES):
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]
