"""Seconds, peak memory and rate of every stage of a run."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


class StageTimer:
    """Measures stages one after the other; `stages` is their entry in run.json."""

    def __init__(self) -> None:
        self.stages: dict[str, dict[str, Any]] = {}
        self._within = 0.0, 0.0
        """Seconds and CPU seconds of stages within the one that is measured."""

    @contextmanager
    def stage(self, name: str, items: int | None = None) -> Iterator[None]:
        """Measure a block, without the stages within it; `items` frames (or candidates) are worked off in it."""
        with suppress(OSError):  # where the system is not Linux, the peak is that of the whole run so far
            Path("/proc/self/clear_refs").write_text("5")
        before, self._within = self._within, (0.0, 0.0)
        began, cpu_began = time.perf_counter(), time.process_time()
        yield
        spent, cpu_spent = time.perf_counter() - began, time.process_time() - cpu_began
        seconds, cpu_seconds = spent - self._within[0], cpu_spent - self._within[1]
        self._within = before[0] + spent, before[1] + cpu_spent
        entry: dict[str, Any] = {
            "seconds": round(seconds, 3),
            "cpu_seconds": round(cpu_seconds, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
        }
        if items is not None:
            entry |= {"items": items, "items_per_second": round(items / max(seconds, 1e-9), 2)}
        self.stages[name] = entry

    def totals(self) -> dict[str, float]:
        return {
            **{
                name: round(sum(stage[name] for stage in self.stages.values()), 3)
                for name in ("seconds", "cpu_seconds")
            },
            "peak_memory_mb": max((stage["peak_memory_mb"] for stage in self.stages.values()), default=0.0),
        }


def peak_memory_mb() -> float:
    """Largest resident memory since the stage began, in MB (10^6 bytes)."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    except (OSError, ValueError):
        pass
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6
