"""Warnings of a run, collected by the thread that works for it.

A context variable names the list of the current run, because most functions that warn know nothing of runs.
`ContextThreads` copies the variable to worker threads, so that runs in threads of one process keep their warnings
apart. Logging settings of the caller have no influence on the lists.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_log = logging.getLogger("vplog")
_log.addHandler(logging.NullHandler())  # without a handler of the caller's, nothing is printed
_collected: ContextVar[list[str] | None] = ContextVar("warnings of the current run", default=None)


def warn(text: str) -> None:
    """Add a warning to the innermost block of `collect_warnings` that this thread works for, and log the warning."""
    if (warnings := _collected.get()) is not None:
        warnings.append(text)
    _log.warning("%s", text)


@contextmanager
def collect_warnings() -> Iterator[list[str]]:
    """Give a list that receives the warnings of this thread, and of the `ContextThreads` that it starts, within the
    block."""
    warnings = list[str]()
    before = _collected.set(warnings)
    try:
        yield warnings
    finally:
        _collected.reset(before)
