"""Two ways measured in turns, and what is said of them."""

from __future__ import annotations

import statistics
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import cv2
import faiss

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@dataclass(frozen=True)
class Figure:
    """One ratio, with the bar that it has to reach."""

    name: str
    ratio: float
    bar: float | None
    """None where the figure is only told."""
    at_most: bool
    """The ratio may be at most the bar; otherwise at least."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What was measured, on what, and how exact the answers were."""

    @property
    def passed(self) -> bool:
        return self.bar is None or (self.ratio <= self.bar if self.at_most else self.ratio >= self.bar)

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "passed": self.passed}


@dataclass(frozen=True)
class Turns:
    """Seconds of two ways, one after the other, several times."""

    first: list[float]
    second: list[float]

    @property
    def ratio(self) -> float:
        """First to second: the median over the rounds, each a ratio of neighbours in time."""
        return statistics.median(a / b for a, b in zip(self.first, self.second, strict=True))

    @property
    def medians(self) -> tuple[float, float]:
        return statistics.median(self.first), statistics.median(self.second)


def in_turns(
    first: Callable[[], object],
    second: Callable[[], object],
    rounds: int,
    clock: Callable[[], float] = time.process_time,
) -> Turns:
    """Each once unmeasured, so that what is compiled or first touched is not counted, then both `rounds` times."""
    first()
    second()
    turns = Turns([], [])
    for _ in range(rounds):
        turns.first.append(seconds(first, clock))
        turns.second.append(seconds(second, clock))
    return turns


def seconds(work: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """What the work takes by a clock. On one thread that is the processor's time: other programs do not count, and a
    thread that should not be there would."""
    began = clock()
    work()
    return clock() - began


def wall(work: Callable[[], object]) -> float:
    """Seconds by the clock on the wall, which other programs on the machine lengthen."""
    return seconds(work, time.perf_counter)


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV and faiss use one thread inside; numba's kernels never use more."""
    before = cv2.getNumThreads(), faiss.omp_get_max_threads()
    cv2.setNumThreads(1)
    faiss.omp_set_num_threads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before[0])
        faiss.omp_set_num_threads(before[1])
