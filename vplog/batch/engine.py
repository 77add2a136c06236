"""Engines of a batch: processes on this machine, one a drive, or a Ray cluster."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from vplog.batch.ray_engine import RayEngine, ray_engine
from vplog.batch.worker import DriveState, Outcome, Task, compute_drive
from vplog.errors import SettingsError, VplogError, is_of_disk
from vplog.execution.process_limits import OVER_MEMORY, OVER_TIME
from vplog.execution.process_pool import OwnProcesses, ProcessExpired
from vplog.storage.urls import shown

Engine: TypeAlias = "LocalEngine | RayEngine"

ENGINES = ("local", "ray")
_KILLED = "Its process was killed, perhaps because memory ran out. Free memory or use fewer --jobs, and run again."


@dataclass(frozen=True)
class BatchOptions:
    """Execution of the drives of a batch. The content of the map depends on `join` alone."""

    jobs: int | None = None
    """Drives at once: one on this machine where not given, over Ray as many as it has cores for."""
    engine: str = "local"
    address: str | None = None
    """HOST:PORT of a Ray cluster; None: one of this machine for the time of the batch."""
    retries: int = 2
    """More attempts at a drive whose worker died: one that dies three times will most likely die again."""
    drive_timeout_s: float | None = None
    """Longest time of an attempt at a drive; it fails, and is not tried again. Of local processes alone."""
    drive_memory_mb: float | None = None
    """Largest resident memory of a drive's process, in MB (10^6 bytes), as `drive_timeout_s`."""
    join: bool = True
    """Whether closures join what the map has at the end."""
    keep_cache: bool = False
    """Whether results of stages stay in MAP/.cache, so that other settings do not need the images again."""
    on_drive: Callable[[DriveState], None] = lambda _: None
    """Called with each drive as it starts, is to be tried again, and ends."""


@contextmanager
def open_engine(options: BatchOptions, threads: int, folder: Path | None = None) -> Iterator[Engine]:
    """The engine of these options, for a writer of a map with this folder; what it started ends with the block. Raises
    SettingsError where there is no such engine."""
    if options.engine not in ENGINES:
        raise SettingsError(f"No engine {options.engine!r}. Engines: {', '.join(ENGINES)}.")
    if options.engine == "ray":
        if (options.drive_timeout_s, options.drive_memory_mb) != (None, None):
            raise SettingsError("--drive-timeout and --drive-memory are for --engine local. Leave them out.")
        with ray_engine(options.address, threads, folder) as engine:
            yield engine
        return
    if options.address is not None:
        raise SettingsError(f"--address {options.address} is that of a Ray cluster. Add --engine ray.")
    with OwnProcesses((options.jobs or 1) + 1) as processes:
        yield LocalEngine(processes, threads)


def as_completed(engine: Engine, tasks: Sequence[Task], options: BatchOptions) -> Iterator[tuple[Task, Outcome, int]]:
    """Yield every drive when it is finished or given up, its outcome, and the number of attempts.

    One that died is tried again when the others have had their turn: whatever it lacked may be there then.
    """
    jobs = options.jobs or 1 if options.engine == "local" else options.jobs
    waiting = deque((task, 1) for task in tasks)
    running: dict[Future[Outcome], tuple[Task, int, float]] = {}
    while waiting or running:
        # without `jobs` one stands in line behind each, so that no core waits for this loop
        while waiting and len(running) < (jobs or 2 * engine.concurrency(waiting[0][0].threads)):
            task, attempt = waiting.popleft()
            options.on_drive(DriveState(task.drive, shown(task.log), "started", attempt))
            running[engine.start(replace(task, began=time.time()))] = task, attempt, time.monotonic()
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            task, attempt, began_s = running.pop(future)
            outcome = _outcome_of(engine, task, future)
            if not outcome.seconds:  # nobody says how long it lived
                outcome = replace(outcome, seconds=round(time.monotonic() - began_s, 3))
            passing = outcome.fault in ("network", "io", "memory", "worker")
            if passing and attempt <= options.retries:
                waiting.append((task, attempt + 1))
                options.on_drive(DriveState.after(task, "retried", attempt, outcome))
            else:
                yield task, outcome, attempt


def _outcome_of(engine: Engine, task: Task, future: Future[Outcome]) -> Outcome:
    """The outcome of an attempt, its run folder fetched."""
    try:
        outcome = future.result()
        if not outcome.error:
            engine.fetch(task, outcome)
    except ProcessExpired as error:
        if error.exitcode == OVER_TIME:
            return Outcome(f"It took longer than {task.time_s:g} s, the --drive-timeout.", "time limit")
        if error.exitcode == OVER_MEMORY:
            return Outcome(f"It took more than {task.memory_mb:g} MB, the --drive-memory.", "memory limit")
        return Outcome(_KILLED, "worker")
    except BrokenExecutor as error:
        return Outcome(str(error) or _KILLED, "worker")
    except OSError as error:  # no process more, or no room for what a machine brings
        return Outcome(f"Cannot begin or fetch the drive: {error.strerror or error}.", "io")
    except VplogError as error:
        return Outcome(str(error), "io" if is_of_disk(error) else "input")
    except Exception as error:  # what a worker cannot even begin with
        return Outcome(f"Internal error: {type(error).__name__}: {' '.join(str(error).split())[:200]}.", "internal")
    return outcome


class LocalEngine:
    """This machine."""

    executor = None

    def __init__(self, processes: OwnProcesses, threads: int) -> None:
        self._processes, self.cores, self.max_cores = processes, threads, threads

    def concurrency(self, threads: int) -> int:
        return 1

    def start(self, task: Task) -> Future[Outcome]:
        return self._processes.submit(compute_drive, task)

    def executor_for(self, threads: int) -> Executor | None:
        """None: this process has the threads itself."""

    def fetch(self, task: Task, outcome: Outcome) -> None:
        """No-op: the folder is local."""
