"""Frames in, features out: decoding and extraction on all cores, in the order of the log, few frames at a time."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

from vplog.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from vplog.data import Features, Frame
    from vplog.stages import EncodedFrame, Extractor

In = TypeVar("In")
Out = TypeVar("Out")


def map_in_order(pool: Executor, work: Callable[[In], Out], items: Iterable[In], ahead: int) -> Iterator[Out]:
    """work(item) for every item, in order, with at most `ahead` items read but not yet given out."""
    waiting: deque[Future[Out]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()


def extract_frames(
    frames: Iterable[EncodedFrame], extractor: Extractor, threads: int
) -> Iterator[tuple[int, Frame | None, Features | None, str]]:
    """(stamp_ns, frame, features, why not) of every frame in order; frame and features are None where undecodable."""

    def work(encoded: EncodedFrame) -> tuple[int, Frame | None, Features | None, str]:
        try:
            frame = encoded.decode()
        except LogError as error:
            return encoded.stamp_ns, None, None, str(error)
        return encoded.stamp_ns, frame, extractor(frame.image, frame.depth), ""

    with ThreadPoolExecutor(threads, initializer=one_thread_each) as pool:
        yield from map_in_order(pool, work, frames, ahead=2 * threads)


def one_thread_each() -> None:
    """Libraries that would start threads of their own inside a worker must not: the pool already fills the cores."""
    import cv2
    import faiss

    cv2.setNumThreads(1)
    faiss.omp_set_num_threads(1)
