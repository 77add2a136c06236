"""Threads for NumPy code that releases the GIL. The results never depend on how many there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

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
