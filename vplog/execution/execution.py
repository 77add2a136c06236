"""How work is executed: on how many threads, and who hears of progress and warnings."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

Progress = Callable[[str, int, int], None]
"""(stage, items done, items in all), from any thread."""


def silent(_stage: str, _done: int, _total: int) -> None:
    """No progress is shown."""


@dataclass(frozen=True)
class Execution:
    """Threads and progress of a piece of work. The same bytes come of it whatever they are."""

    threads: int = 1
    progress: Progress = silent

    def within(self, name: str) -> Execution:
        """For a part of the work, whose stages are told as `name: stage`."""
        return replace(self, progress=lambda stage, done, total: self.progress(f"{name}: {stage}", done, total))


@contextmanager
def logged_warnings(warnings: list[str]) -> Iterator[None]:
    """Appends what the package logs as warnings within the block."""
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: warnings.append(record.getMessage())
    logger = logging.getLogger("vplog")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
