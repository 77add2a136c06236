"""Threads for compiled code that releases the GIL. The results never depend on how many there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from vplog.execution.cores import allowed


class Workers:
    """A few threads, while the `with` lasts: as many as `vplog.execution.cores` allows."""

    def __enter__(self) -> Workers:
        self.count = allowed()
        self._pool: ThreadPoolExecutor | None = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def each(self, work: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Results of `work` for each tuple of arguments, begun and returned in their order."""
        if self.count == 1 or len(tasks) < 2:
            return [work(*task) for task in tasks]
        self._pool = self._pool or ThreadPoolExecutor(self.count)
        return [future.result() for future in [self._pool.submit(work, *task) for task in tasks]]

    def ranges(self, low: int, high: int, at_least: int, by_thread: int = 1) -> list[tuple[int, int]]:
        """low:high in about equal ranges, some for each thread, none shorter than `at_least` unless it is all."""
        count = max(min((high - low) // at_least, self.count * by_thread), 1)
        ends = np.linspace(low, high, count + 1).astype(int).tolist()
        return list(pairwise(ends))
