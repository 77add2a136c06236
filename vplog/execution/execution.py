"""Execution of work: number of threads and progress."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from contextvars import copy_context
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

In = TypeVar("In")
Out = TypeVar("Out")
Progress = Callable[[str, int, int], None]
"""(stage, items done, items in all), from any thread."""


def silent(_stage: str, _done: int, _total: int) -> None:
    """No progress is shown."""


@dataclass(frozen=True)
class Execution:
    """Threads and progress of a piece of work. The same bytes come of it whatever they are.

    An exception that `progress` raises ends the work.
    """

    threads: int = 1
    progress: Progress = silent

    def within(self, name: str) -> Execution:
        """For a part of the work, whose stages are reported as `name: stage`."""
        return replace(self, progress=lambda stage, done, total: self.progress(f"{name}: {stage}", done, total))

    def part(self, before: int, total: int) -> Execution:
        """For a part of the items of a stage, of which `before` are done."""
        return replace(self, progress=lambda stage, done, _: self.progress(stage, before + done, total))

    def counted(self, stage: str, items: Iterable[Out], total: int) -> Iterator[Out]:
        """The items; progress is reported as each is given out."""
        for done, item in enumerate(items, start=1):
            self.progress(stage, done, total)
            yield item

    def map(self, work: Callable[[In], Out], items: Iterable[In], ahead: int = 4) -> Iterator[Out]:
        """work(item) of every item, in order, with at most `ahead` items a thread read but not yet given out.

        OpenCV, faiss and BLAS start no threads of their own within `work`.
        """
        waiting: deque[Future[Out]] = deque()
        threads = max(self.threads, 1)
        with _one_blas_thread(), ContextThreads(threads, initializer=_one_thread_each) as pool:
            try:
                for item in items:
                    waiting.append(pool.submit(work, item))
                    if len(waiting) >= ahead * threads:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                for future in waiting:
                    future.cancel()


class ContextThreads(ThreadPoolExecutor):
    """Threads that work with the context variables of the thread that submits: its thread limit and its warnings."""

    def submit(self, function: Callable[..., Out], /, *args: Any, **kwargs: Any) -> Future[Out]:
        return super().submit(copy_context().run, function, *args, **kwargs)


@cache
def _blas() -> ThreadpoolController:
    """The BLAS that numpy has loaded."""
    import numpy  # noqa: F401

    return ThreadpoolController().select(user_api="blas")


def _one_blas_thread() -> AbstractContextManager[object]:
    """BLAS without threads, whose idle ones spin: products of a few ms cost ten times their time.

    Where it has none already, as within another map, nothing is set back: maps end in any order.
    """
    alone = all(library["num_threads"] == 1 for library in _blas().info())
    return nullcontext() if alone else _blas().limit(limits=1)


def _one_thread_each() -> None:
    """Libraries start no threads inside a worker: the pool already fills the cores."""
    import cv2
    import faiss

    cv2.setNumThreads(1)
    faiss.omp_set_num_threads(1)
