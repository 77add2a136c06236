"""Where the drives of a batch are computed: on this machine, each in a process of its own, or over a Ray cluster."""

from __future__ import annotations

from collections import deque
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Protocol, TypeVar

from vplog.batch.worker import Outcome, Task, compute_drive
from vplog.errors import SettingsError, VplogError
from vplog.execution.process_pool import OwnProcesses, ProcessExpired

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from concurrent.futures import Executor
    from pathlib import Path

    T = TypeVar("T")

ENGINES = ("local", "ray")
RETRIES = 2
"""More attempts at a drive whose worker died: one that dies three times will most likely die again."""
_KILLED = "Its process was killed, as for want of memory. Make room or use fewer --jobs, and run again."


class Engine(Protocol):
    """Computes drives elsewhere and brings their run folders here."""

    @property
    def executor(self) -> Executor | None:
        """Runs functions of modules on other machines, a core each; None where there are none. A future raises
        BrokenExecutor, with one line, where process or machine died, so that the same may end well another time."""
        ...

    @property
    def cores(self) -> int:
        """Of all machines together."""
        ...

    @property
    def widest(self) -> int:
        """Cores of the largest machine: one drive runs on one."""
        ...

    def at_once(self, threads: int) -> int:
        """Drives with so many threads each that keep it busy."""
        ...

    def start(self, task: Task) -> Future[Outcome]:
        """Begin a drive."""
        ...

    def helpers(self, threads: int) -> Executor | None:
        """For tasks of so many threads that read and write the map; None where they are done here as fast."""
        ...

    def take(self, task: Task, outcome: Outcome) -> None:
        """Have the finished run folder in `task.folder`. Raises BrokenExecutor where it is lost, ResultError."""
        ...


@contextmanager
def opened(
    name: str,
    address: str | None,
    jobs: int,
    threads: int,
    folder: Path | None = None,
    processes: OwnProcesses | None = None,
) -> Iterator[Engine]:
    """The engine of this name, for a writer of a map with this folder; what it started ends with the block.

    `processes` are those of this machine that a caller has begun; there is one more than `jobs` otherwise. Raises
    SettingsError where there is no such engine.
    """
    if name not in ENGINES:
        raise SettingsError(f"No engine {name!r}. Engines: {', '.join(ENGINES)}.")
    if name == "ray":
        from vplog.batch.ray_engine import ray_engine

        with ray_engine(address, threads, folder) as engine:
            yield engine
        return
    if address is not None:
        raise SettingsError(f"--address {address} is that of a Ray cluster. Add --engine ray.")
    with nullcontext(processes) if processes is not None else OwnProcesses(jobs + 1) as own:
        yield LocalEngine(own, threads)


def computed(
    engine: Engine, tasks: Sequence[Task], jobs: int | None, retries: int
) -> Iterator[tuple[Task, Outcome, int]]:
    """Every drive when it is finished or given up, how, and at which attempt; `jobs` of them at once, where given.

    One that died is tried again when the others have had their turn: whatever it lacked may be there then.
    """
    waiting = deque((task, 1) for task in tasks)
    running: dict[Future[Outcome], tuple[Task, int]] = {}
    while waiting or running:
        # without `jobs` one stands in line behind each, so that no core waits for this loop
        while waiting and len(running) < (jobs or 2 * engine.at_once(waiting[0][0].threads)):
            task, attempt = waiting.popleft()
            running[engine.start(task)] = task, attempt
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            task, attempt = running.pop(future)
            outcome = _brought(engine, task, future)
            if outcome.may_pass and attempt <= retries:
                waiting.append((task, attempt + 1))
            else:
                yield task, outcome, attempt


def _brought(engine: Engine, task: Task, future: Future[Outcome]) -> Outcome:
    """What became of an attempt, its run folder at hand."""
    try:
        outcome = future.result()
        if not outcome.error:
            engine.take(task, outcome)
    except ProcessExpired:
        return Outcome(_KILLED, may_pass=True)
    except BrokenExecutor as error:
        return Outcome(str(error), may_pass=True)
    except OSError as error:  # no process more, or no room for what a machine brings
        return Outcome(f"Cannot begin or fetch the drive: {error.strerror or error}.", may_pass=True)
    except VplogError as error:
        return Outcome(str(error))
    except Exception as error:  # what a worker cannot even begin with
        return Outcome(f"Internal error: {type(error).__name__}: {' '.join(str(error).split())[:200]}.")
    return outcome


class LocalEngine:
    """This machine."""

    executor = None

    def __init__(self, processes: OwnProcesses, threads: int) -> None:
        self._processes, self.cores, self.widest = processes, threads, threads

    def at_once(self, threads: int) -> int:
        return 1

    def start(self, task: Task) -> Future[Outcome]:
        return self._processes.submit(compute_drive, task)

    def helpers(self, threads: int) -> Executor | None:
        """This process has the threads itself."""
        return None

    def take(self, task: Task, outcome: Outcome) -> None:
        """No-op: the folder is local."""
