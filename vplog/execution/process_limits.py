"""Limits of a process of its own, which ends where it exceeds one; its exit status tells which."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from vplog.execution.timing import peak_memory_mb

OVER_TIME = -signal.SIGALRM
"""Exit status of a process that took longer: that of a timer of the system, which ends compiled code, too."""
OVER_MEMORY = -signal.SIGUSR2
"""Exit status of a process that took more memory: a signal that ends it and nobody else sends."""
_CHECK_S = 0.25


@contextmanager
def process_limits(time_s: float | None, memory_mb: float | None) -> Iterator[None]:
    """End this process where the block takes longer than `time_s`, or resident memory above `memory_mb` (10^6 bytes);
    None is no limit."""
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(_CHECK_S):
            if memory_mb is not None and peak_memory_mb() > memory_mb:
                os.kill(os.getpid(), signal.SIGUSR2)

    if memory_mb is not None:
        threading.Thread(target=watch, daemon=True).start()
    if time_s is not None:
        signal.setitimer(signal.ITIMER_REAL, time_s)
    try:
        yield
    finally:
        ended.set()
        if time_s is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
