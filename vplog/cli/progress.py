"""Progress of a verb: bars on a terminal, a line a minute elsewhere, and events as JSON lines for programs."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO

from vplog.cli.printing import print_status
from vplog.errors import ResultError, VplogError, was_interrupted
from vplog.storage.urls import without_secrets

if TYPE_CHECKING:
    from rich.progress import Progress as Bars

    from vplog.batch.worker import DriveState

LINE_EVERY_S = 60.0
"""s between lines on a stderr that is no terminal."""
_EVENT_EVERY_S, _HEARTBEAT_S = 1.0, 5.0
"""s between two events of one stage, at least; and at most, where a stage has nothing to report."""
_MOST_EARLIER = 20
"""Earlier runs that are looked through for the seconds of their stages."""
_REUSED = 0.1
"""A stage that takes less than this share of its earlier time was found in the cache, and says nothing of the speed."""


class Events:
    """A file of JSON lines, each written at once; a reader that has gone is no error."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    def write(self, event: str, **fields: Any) -> None:
        if self._stream is not None:
            line = json.dumps({"event": event, "time_s": round(time.time(), 3), **fields}, ensure_ascii=False)
            try:
                self._stream.write(f"{line}\n")
                self._stream.flush()
            except OSError:
                self._stream = None


@contextmanager
def events_of(arguments: argparse.Namespace) -> Iterator[None]:
    """Events of a verb, as `arguments.events` from here on, from its start to its end, which may be an error."""
    path, words = getattr(arguments, "events", None), arguments.command
    began, arguments.events = time.monotonic(), Events(_open(path) if path is not None else None)
    arguments.events.write("started", verb=" ".join(words[: 2 if words[0] == "map" else 1]))
    state, wrong = "done", None
    try:
        yield
    except BaseException as error:
        state = "interrupted" if was_interrupted(error) else "failed"
        known = isinstance(error, VplogError | OSError)
        wrong = without_secrets(str(error) if known else f"{type(error).__name__}: {error}", words)
        raise
    finally:
        arguments.events.write("finished", state=state, seconds=round(time.monotonic() - began, 3), error=wrong)


def _open(path: Path) -> TextIO:
    try:
        return path.open("w", encoding="utf-8")
    except OSError as error:
        raise ResultError(f"Cannot write {path}: {error.strerror}. Choose another with --events.") from None


@dataclass
class _Stage:
    """One stage as far as it is reported."""

    name: str
    total: int
    began_s: float
    done: int = 0
    seconds: float | None = None
    """s that it took, None until it is finished."""
    reported_s: float = 0.0
    known: int = 0
    """Items that were there when it began, as far as its first report tells."""
    counted_s: float = field(init=False)
    """When the count of its items began, which may begin again."""

    def __post_init__(self) -> None:
        self.counted_s = self.began_s

    def count(self, done: int, total: int) -> None:
        """Take another number of items."""
        if done < self.done and total != self.total:
            self.counted_s, self.known = time.monotonic(), done
        self.done, self.total = done, total

    def rate(self) -> float:
        """Items a second, 0 where unknown."""
        return (self.done - self.known) / max(time.monotonic() - self.counted_s, 1e-9)

    def eta_s(self) -> float | None:
        return (self.total - self.done) / self.rate() if self.done > self.known and self.total > 1 else None


def _bars() -> Bars:
    """Return bars on stderr, a terminal. Rich loads here, which takes 0.1 s."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Eta

    return Progress(
        TextColumn("{task.description:<18}", markup=False),
        BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), Eta(), console=Console(file=sys.stderr),
    )  # fmt: skip


class Progress:
    """Progress on a terminal or as JSON lines: called with (stage, items done, items in all), from any thread, within
    `with`."""

    def __init__(
        self, arguments: argparse.Namespace, stages: tuple[str, ...] = (), earlier: Path | None = None
    ) -> None:
        """`stages` are those that are known beforehand, in order; `earlier` is a folder beside which earlier runs are
        looked for, by whose stages the time to the end is estimated."""
        self._events: Events = arguments.events if isinstance(arguments.events, Events) else Events(None)
        self._known, self._earlier = stages, _earlier_seconds(earlier) if earlier is not None else {}
        if stages and self._earlier:  # the first of them lasts while steps that not every run has are computed
            within = sum(seconds for name, seconds in self._earlier.items() if name not in stages)
            self._earlier[stages[0]] = self._earlier.get(stages[0], 0.0) + within
        self._stages: dict[str, _Stage] = {}
        self._tasks: dict[str, Any] = {}
        self._lock, self._end = threading.Lock(), threading.Event()
        self._line_by_line = not (arguments.json or sys.stderr.isatty())
        self._bars = _bars() if sys.stderr.isatty() and not arguments.json else None

    def __enter__(self) -> Progress:
        if self._bars is not None:
            self._bars.start()
        threading.Thread(target=self._heartbeat, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end.set()
        if self._bars is not None:
            self._bars.stop()
        if error is None:
            with self._lock:
                self._finish_steps()

    def __call__(self, stage: str, done: int, total: int) -> None:
        with self._lock:
            if self._bars is not None:
                self._draw(self._bars, stage, done, total)
            self._follow(stage, done, total)

    def _draw(self, bars: Bars, stage: str, done: int, total: int) -> None:
        if stage not in self._tasks:
            number, of = self._number(stage)
            label = f"{number}/{of} {stage}" if number is not None else stage
            self._tasks[stage] = bars.add_task(label, total=total)
        bars.update(self._tasks[stage], completed=done, total=total)

    def _follow(self, name: str, done: int, total: int) -> None:
        stage, step = self._stages.get(name), name in self._known
        if stage is None or (stage.seconds is not None and done < total):
            if step:
                self._finish_steps()
            stage = self._stages[name] = _Stage(name, total, time.monotonic(), known=done if done > 1 else 0)
            self._write("stage_started", stage, total=total)
        if stage.seconds is not None:
            return
        stage.count(done, total)
        if done >= total and not step:
            self._finish(stage)
        elif done and time.monotonic() - stage.reported_s >= _EVENT_EVERY_S:
            self._write_progress(stage)

    def _finish_steps(self) -> None:
        """The step of a run lasts until the next begins: when all its items are done, there may be more to do."""
        for stage in self._stages.values():
            if stage.seconds is None and stage.name in self._known:
                self._finish(stage)

    def _finish(self, stage: _Stage) -> None:
        stage.seconds = round(time.monotonic() - stage.began_s, 3)
        self._write("stage_finished", stage, total=stage.total, seconds=stage.seconds)

    def _write(self, event: str, stage: _Stage, **fields: Any) -> None:
        number, of = self._number(stage.name)
        self._events.write(event, stage=stage.name, number=number, of=of, **fields)

    def _write_progress(self, stage: _Stage) -> None:
        stage.reported_s = time.monotonic()
        eta = {"eta_s": stage.eta_s(), "total_eta_s": self._total_eta_s(stage)}
        rounded = {name: None if value is None else round(value, 1) for name, value in eta.items()}
        rate = round(stage.rate(), 3)
        self._write("progress", stage, done=stage.done, total=stage.total, per_second=rate, **rounded)

    def _number(self, name: str) -> tuple[int | None, int | None]:
        """Number of a stage among those known, from 1, and their number; that of a part of the work is by its end."""
        name = name.rpartition(": ")[2]
        return (self._known.index(name) + 1, len(self._known)) if name in self._known else (None, None)

    def _total_eta_s(self, stage: _Stage) -> float | None:
        """s to the end: what is left of this stage, and the later ones as in an earlier run, as much faster or slower
        as those that are finished; None where no earlier run is known."""
        from statistics import median

        if stage.name not in self._known or not self._earlier:
            return None
        took = {one.name: one.seconds for one in self._stages.values() if one.seconds is not None}
        pairs = [(took[name], then) for name, then in self._earlier.items() if name in took and then > 0]
        faster = median([now / then for now, then in pairs if now > _REUSED * then] or [1.0])
        later = self._known[self._known.index(stage.name) + 1 :]
        left = stage.eta_s()
        if left is None:
            left = max(faster * self._earlier.get(stage.name, 0.0) - (time.monotonic() - stage.began_s), 0.0)
        return left + faster * sum(self._earlier.get(name, 0.0) for name in later)

    def _heartbeat(self) -> None:
        """Events where a stage has been silent, and lines where there are no bars, until the end."""
        lines_s = time.monotonic()
        while not self._end.wait(min(_HEARTBEAT_S, LINE_EVERY_S)):
            with self._lock:
                running = [stage for stage in self._stages.values() if stage.seconds is None]
                now = time.monotonic()
                for stage in running:
                    if now - stage.reported_s >= _HEARTBEAT_S:
                        self._write_progress(stage)
                if running and self._line_by_line and now - lines_s >= LINE_EVERY_S:
                    lines_s = now
                    print_status(self._line(running[-1]))

    def _line(self, stage: _Stage) -> str:
        (number, of), rate = self._number(stage.name), stage.rate()
        where = f"stage {number} of {of}, {stage.name}" if number is not None else stage.name
        items = f": {stage.done} of {stage.total}, {rate:.3g} a second" if stage.done and stage.total > 1 else ""
        left, all_left = stage.eta_s(), self._total_eta_s(stage)
        etas = [f"{_minutes(left)} left"] if left is not None else [f"for {_minutes(time.monotonic() - stage.began_s)}"]
        return ", ".join(
            [f"{where}{items}", *etas, *([] if all_left is None else [f"{_minutes(all_left)} to the end"])]
        )

    def print_drive(self, drive: DriveState) -> None:
        """An event for each change of a drive of a batch; where there are no bars a line as it ends or is tried again,
        as in the log of a job of the night."""
        about: dict[str, Any] = {"drive": drive.drive, "log": drive.log, "attempt": drive.attempts}
        if drive.state == "started":
            self._events.write("drive_started", **about)
            return
        about |= {"state": drive.state, "seconds": drive.seconds, "peak_memory_mb": drive.peak_memory_mb}
        about |= {"error": without_secrets(drive.error) or None, "fault": drive.fault or None}
        self._events.write("drive_retried" if drive.state == "retried" else "drive_finished", **about)
        if self._line_by_line:
            print_status(
                f"{drive.drive}: {drive.state}, {drive.seconds:.1f} s{f': {drive.error}' if drive.error else ''}"
            )


@contextmanager
def one_stage(arguments: argparse.Namespace, name: str) -> Iterator[None]:
    """The progress of work that is one stage, of which only begin and end are known."""
    with Progress(arguments) as progress:
        progress(name, 0, 1)
        yield
        progress(name, 1, 1)


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 99.5 else f"{seconds / 60:.0f} min"


def _earlier_seconds(out: Path) -> dict[str, float]:
    """Seconds of the stages of the latest run in a folder or beside it that computed all of them; empty without one."""
    from vplog.results.run_record import read_run_json

    found = [out / "run.json", *list(out.absolute().parent.glob("*/run.json"))[:_MOST_EARLIER]]
    for path in sorted(filter(Path.is_file, found), key=lambda path: -path.stat().st_mtime_ns):
        with suppress(VplogError, OSError, AttributeError, KeyError, TypeError, ValueError):
            stages: dict[str, dict[str, Any]] = read_run_json(path)["stages"]
            if stages and all(one["result"] == "computed" for one in stages.values()):
                return {name: float(one["seconds"]) for name, one in stages.items()}
    return {}
