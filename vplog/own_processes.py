"""Processes of this machine for one task each, the next of which loads what it needs while others are at work."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import threading
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    T = TypeVar("T")

_WORK = "vplog.batch_worker"
"""What is loaded ahead: two seconds of the time of a drive."""
_TERMINATE_EVERY_S = 0.1
"""A process that was just about to start is not there yet the first time."""


class OwnProcess:
    """A new process, which begins to load at once and is there for one task."""

    def __init__(self) -> None:
        # Ctrl-C reaches every process of a terminal; this one inherits the mask and is ended by its parent instead.
        # The tracker that Python starts with the first worker would take the mask off again.
        resource_tracker.ensure_running()
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _end_with_parent)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            try:
                self._loaded = self._pool.submit(_load)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)  # where a Ctrl-C that waited is raised
        except BaseException:
            self.end()
            raise

    def run(self, function: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any]) -> T:
        """Call it there, and end the process. Raises BrokenExecutor where that was killed."""
        try:
            with self._pool:
                return self._pool.submit(function, *args, **kwargs).result()
        except BrokenProcessPool:
            raise BrokenExecutor(
                "Its process was killed, as for want of memory. Make room or use fewer --jobs, and run again."
            ) from None

    def loaded(self) -> dict[str, Any] | None:
        """What it computes with, as drive.json has it, when it knows that; None where it was killed."""
        try:
            return self._loaded.result()
        except Exception:  # the task meets it again
            return None

    def end(self) -> None:
        """Without a task."""
        for child in list((self._pool._processes or {}).values()):  # kill_workers of Python 3.14
            child.kill()
        self._pool.shutdown()


_ahead: list[OwnProcess] = []
"""What is begun for the next task."""


@contextmanager
def begun_ahead() -> Iterator[None]:
    """The first process of a batch begins to load while this one does; nobody's at the end of the block, it ends."""
    _ahead.append(OwnProcess())
    try:
        yield
    finally:
        while _ahead:
            _ahead.pop().end()


class OwnProcesses(ThreadPoolExecutor):
    """Runs each task in a process of its own: its memory is given back, and one that dies takes no other along."""

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs)
        self._jobs = jobs
        self._unfinished: set[Future[Any]] = set()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        self._unfinished.add(future := super().submit(self._run, fn, args, kwargs))
        future.add_done_callback(self._unfinished.discard)
        return future

    def _run(self, function: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any]) -> T:
        try:
            process = _ahead.pop()
        except IndexError:
            process = OwnProcess()
        if len(self._unfinished) > self._jobs:  # another stands in line
            _ahead.append(OwnProcess())
        return process.run(function, args, kwargs)

    def __exit__(self, kind: Any, error: Any, at: Any) -> bool | None:
        """Wait for all, or end them where the block failed."""
        if kind is not None:
            self.shutdown(wait=False, cancel_futures=True)
            ended = False
            while not ended:
                try:
                    for child in multiprocessing.active_children():
                        child.terminate()
                    ended = not wait(list(self._unfinished), _TERMINATE_EVERY_S).not_done
                except KeyboardInterrupt:  # once more: else the threads would wait for drives to be done
                    continue
        done = super().__exit__(kind, error, at)
        while _ahead:
            _ahead.pop().end()
        return done


def known_ahead() -> dict[str, Any] | None:
    """What the first process of a batch computes with, the same as this one: it takes a second to tell, in which this
    one does other things. None where none is begun."""
    return _ahead[0].loaded() if _ahead else None


def _load() -> dict[str, Any]:
    """What a drive needs; what it is computed with."""
    return importlib.import_module(_WORK).made_by()


def _end_with_parent() -> None:
    """A worker whose batch was killed must not go on beside the next one."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
