"""Tasks that run here or in other processes, their results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import TypeVar

from vplog.errors import VplogError, was_interrupted

Task = TypeVar("Task")
Result = TypeVar("Result")

_AHEAD = 64
"""Tasks given out and not yet taken back: enough for any machine, and few in memory."""
_ATTEMPTS = 3
"""At a task whose worker died: one that dies three times will most likely die again."""


def run_tasks(
    work: Callable[[Task], Result], tasks: Iterable[Task], executor: Executor | None
) -> Iterator[tuple[Task, Result | None, str]]:
    """Each task with its result, or with None and why it has none, in one line. Without an executor it is done here."""
    waiting: deque[tuple[Task, Future[Result] | None]] = deque()
    try:
        for task in tasks:
            waiting.append((task, None if executor is None else executor.submit(work, task)))
            if executor is None or len(waiting) == _AHEAD:
                yield _finished(work, *waiting.popleft(), executor)
        while waiting:
            yield _finished(work, *waiting.popleft(), executor)
    finally:
        for _, future in waiting:
            if future is not None:
                future.cancel()


def _finished(
    work: Callable[[Task], Result], task: Task, future: Future[Result] | None, executor: Executor | None
) -> tuple[Task, Result | None, str]:
    error = ""
    for attempt in range(_ATTEMPTS):
        try:
            if executor is None:
                return task, work(task), ""
            if attempt or future is None:
                future = executor.submit(work, task)
            return task, future.result(), ""
        except VplogError as problem:
            return task, None, str(problem)
        except (BrokenExecutor, MemoryError) as problem:  # may go well another time
            error = " ".join(str(problem).split()) or type(problem).__name__
        except OSError as problem:
            return task, None, f"Cannot read or write {problem.filename or 'a file'}: {problem.strerror or problem}."
        except Exception as problem:  # a fault of ours in one task must not stop the others
            if was_interrupted(problem):
                raise
            return task, None, f"Internal error: {type(problem).__name__}: {' '.join(str(problem).split())[:200]}."
    return task, None, f"Its worker died {_ATTEMPTS} times: {error}"
