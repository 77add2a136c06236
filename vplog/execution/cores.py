"""Number of threads: the cores that this process may use, or fewer by the user's limit.

The limit is a context variable, as an optimiser takes nothing but a graph, and a log nothing but a path: 85 functions
of `graph/` lie between who knows the limit and the linear algebra that starts threads.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_limit: ContextVar[int | None] = ContextVar("threads allowed", default=None)


def available() -> int:
    """Cores of this machine that the system lets this process use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def allowed() -> int:
    """Threads for work without a number of its own: the limit of `limited`, else one for each core."""
    return _limit.get() or available()


@contextmanager
def limited(threads: int | None) -> Iterator[None]:
    """No more threads than so many for what is done inside; None changes nothing. OpenCV, which is told to start none
    inside, has as many as before afterwards."""
    before, cv2 = _limit.set(threads or _limit.get()), sys.modules.get("cv2")
    started = -1 if cv2 is None else cv2.getNumThreads()  # -1 is its default
    try:
        yield
    finally:
        _limit.reset(before)
        if (cv2 := sys.modules.get("cv2")) is not None:
            cv2.setNumThreads(started)
