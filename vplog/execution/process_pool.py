"""Processes of this machine for one drive each: its memory is given back, and one that dies takes no other along.

pebble's pool starts a new process for each task, kills them all on Ctrl-C and reports which task's process died. They
are forks of multiprocessing's server, which has the modules loaded: that takes a CPU second. On macOS, whose libraries
do not survive a fork, each is spawned; with one more process than jobs, one always has its modules when a drive ends.

multiprocessing has such a process import the main module of its parent, since what it is to call may be there: a script
without `if __name__ == "__main__"` would run again in each. Tasks are functions of this package alone, so these
processes are started without.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from multiprocessing import forkserver, resource_tracker
from types import ModuleType
from typing import Any, Self, TypeVar

from pebble import ProcessExpired, ProcessPool

from vplog.errors import SettingsError

if sys.platform == "darwin":
    from multiprocessing.context import SpawnContext as _Context
    from multiprocessing.context import SpawnProcess as _Process
else:
    from multiprocessing.context import ForkServerContext as _Context
    from multiprocessing.context import ForkServerProcess as _Process

T = TypeVar("T")

__all__ = ["OwnProcesses", "Process", "ProcessExpired"]

_WORK = "vplog.batch.worker"
"""Module that the server, or else every process, imports first."""


class Process(_Process):
    """One of a function of this package."""

    _starting = threading.Lock()

    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802 (multiprocessing's name)
        with Process._starting:
            main = sys.modules["__main__"]
            sys.modules["__main__"] = ModuleType("__main__")  # of no file, so that there is none to import
            try:
                if sys.platform != "darwin":
                    _start_server()
                return _Process._Popen(process_obj)
            finally:
                sys.modules["__main__"] = main


def _start_server() -> None:
    """Start the process that is forked, where none is running. Before Python 3.12.7 it does not get `sys.path`."""
    multiprocessing.set_forkserver_preload([_WORK])
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
    try:
        forkserver.ensure_running()
    finally:
        del os.environ["PYTHONPATH"]
        os.environ |= {} if before is None else {"PYTHONPATH": before}


class _Processes(_Context):
    """Its locks keep their names as long as the pool: pebble drops them before it ends processes that look for them."""

    Process = Process

    def __init__(self) -> None:
        self._locks: list[Any] = []

    def RLock(self) -> Any:  # noqa: N802 (multiprocessing's name)
        self._locks.append(super().RLock())
        return self._locks[-1]


class OwnProcesses:
    """So many processes, each for one task; those without a task end with the block, as do all where it fails."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool: ProcessPool | None = None

    def begin(self) -> ProcessPool:
        """Start the processes where they are not running: they load meanwhile."""
        if self._pool is not None and self._pool.active:
            return self._pool
        if multiprocessing.current_process().daemon:
            raise SettingsError(
                "Drives are computed in processes of their own, which a daemonic process, as those of "
                "multiprocessing.Pool, cannot start. Call this from one of concurrent.futures.ProcessPoolExecutor."
            )
        self._end()  # pebble gives up a pool where a process is killed that has no task
        # Ctrl-C reaches every process of a terminal; these inherit the mask and are ended by their parent instead.
        # The tracker that Python starts with the first process would take the mask off again.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._pool = ProcessPool(self._count, 1, _load, [_WORK, dict(os.environ)], _Processes())
            self._pool.active  # noqa: B018 (starts it)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)  # where a Ctrl-C that waited is raised
        return self._pool

    def submit(self, function: Callable[..., T], *args: Any) -> Future[T]:
        """Call it in a process of its own. The future raises ProcessExpired or BrokenExecutor where that was killed."""
        try:
            return self.begin().schedule(function, args)
        except BrokenExecutor as error:  # the server was killed
            future: Future[T] = Future()
            future.set_exception(error)
            return future

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        if self._pool is not None:
            self._pool.stop()
            self._pool.join()
            self._pool = None


def _load(module: str, environment: dict[str, str]) -> None:
    """Import the code of a drive, and watch for the end of the batch: a worker must not go on beside the next one. The
    environment is that of the batch, which may have changed since the server began."""
    os.environ.clear()
    os.environ.update(environment)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    importlib.import_module(module)
