"""Processes of this machine for one drive each: its memory is given back, and one that dies takes no other along.

pebble's pool starts a new process for each task, kills them all on Ctrl-C and reports which task's process died. With
one more process than jobs, one always has its modules loaded, which takes two seconds, when a drive ends.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import threading
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any, Self, TypeVar

from pebble import ProcessExpired, ProcessPool

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    T = TypeVar("T")

__all__ = ["OwnProcesses", "ProcessExpired"]

_WORK = "vplog.batch.worker"
"""What every process loads first."""


class OwnProcesses:
    """So many processes, each for one task; those without a task end with the block, as do all where it fails."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool: ProcessPool | None = None

    def begin(self) -> ProcessPool:
        """Start the processes where they are not running: they load meanwhile."""
        if self._pool is not None and self._pool.active:
            return self._pool
        self._end()  # pebble gives up a pool where a process is killed that has no task
        # Ctrl-C reaches every process of a terminal; these inherit the mask and are ended by their parent instead.
        # The tracker that Python starts with the first process would take the mask off again.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPool(self._count, 1, _load, context=spawn)
            self._pool.active  # noqa: B018 (starts it)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)  # where a Ctrl-C that waited is raised
        return self._pool

    def submit(self, function: Callable[..., T], *args: Any) -> Future[T]:
        """Call it in a process of its own. The future raises ProcessExpired or BrokenExecutor where that was killed."""
        return self.begin().schedule(function, args)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        if self._pool is not None:
            self._pool.stop()
            self._pool.join()
            self._pool = None


def _load() -> None:
    """What a drive needs; and an end where the batch was killed: this must not go on beside the next one."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    importlib.import_module(_WORK)
