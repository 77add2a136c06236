"""Work on threads: in order, few items ahead, with progress that adds up."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from vplog.execution.cores import limited
from vplog.execution.execution import Execution

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.mark.parametrize("threads", [0, 1, 3, 8])
def test_results_are_in_the_order_of_the_items(threads: int) -> None:
    rng = np.random.default_rng(threads)
    order = rng.permutation(50).tolist()
    turn = threading.Barrier(max(threads, 1))

    def work(item: int) -> int:
        if threads > 1 and item < threads:  # the first ones end together
            turn.wait(10)
        return 2 * order[item]

    assert list(Execution(threads).map(work, range(50))) == [2 * item for item in order]


@pytest.mark.parametrize("ahead", [1, 2, 4])
def test_few_items_are_read_ahead(ahead: int) -> None:
    read = 0

    def items() -> Iterator[int]:
        nonlocal read
        for item in range(100):
            read += 1
            yield item

    given_out = -1
    for given_out, item in enumerate(Execution(3).map(lambda item: item, items(), ahead)):
        assert item == given_out
        assert read - given_out <= 3 * ahead
    assert (read, given_out) == (100, 99)


def test_libraries_start_no_threads_within_a_worker() -> None:
    before = cv2.getNumThreads()
    try:
        assert set(Execution(2).map(lambda _: cv2.getNumThreads(), range(4))) == {1}
    finally:
        cv2.setNumThreads(before)


def test_a_worker_has_one_thread_of_blas_and_the_caller_as_many_as_before() -> None:
    def blas(_: int = 0) -> list[int]:
        return [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]

    np.ones((2, 2)) @ np.ones((2, 2))
    with threadpool_limits(2, "blas"):
        before = blas()
        assert {count for found in Execution(2).map(blas, range(4)) for count in found} <= {1}
        assert blas() == before
        inner = Execution(2).map(blas, range(4))
        next(inner)
        list(Execution(2).map(lambda found: found, inner))  # the one that began first ends first
        assert blas() == before


def test_what_progress_or_work_raises_ends_the_work() -> None:
    done: list[int] = []

    def stop(_stage: str, count: int, _total: int) -> None:
        if count == 3:
            raise KeyboardInterrupt

    execution = Execution(1, stop)
    with pytest.raises(KeyboardInterrupt):
        for item in execution.counted("stage", execution.map(lambda item: item, range(1000)), 1000):
            done.append(item)  # noqa: PERF402 - it is stopped amid
    assert done == [0, 1]
    with pytest.raises(ZeroDivisionError):
        list(Execution(2).map(lambda item: 1 // (item - 5), range(1000)))


def test_progress_of_parts_adds_up_to_that_of_the_whole() -> None:
    reports: list[tuple[str, int, int]] = []
    execution = Execution(2, lambda name, done, total: reports.append((name, done, total))).within("drive")
    for before, count in ((0, 2), (2, 0), (2, 3)):
        list(execution.part(before, 5).counted("extract", range(count), count))
    assert reports == [("drive: extract", done, 5) for done in range(1, 6)]


def test_opencv_has_as_many_threads_afterwards_as_before() -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        with limited(2):
            assert list(Execution(2).map(lambda _: cv2.getNumThreads(), range(4))) == [1] * 4
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)
